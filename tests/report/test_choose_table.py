"""README's table: the cheapest way of each engine that keeps all budgets, or why there is none."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec

from benchmarks.choose_table import choose_table
from mbds_xsim.report.files import results_json
from mbds_xsim.studies.tradeoff import CurveResult, Kind, Point, Tradeoff
from tests.results import curve, tradeoff

_ROOT = Path(__file__).parents[2]


def _point(
    step_s: float, wall_s: float | None, broken: tuple[str, ...] = (), kind: Kind = "done"
) -> Point:
    return Point(
        steps_per_frame=round(0.02 / step_s),
        step_s=step_s,
        kind=kind,
        reason="" if kind == "done" else "gave up",
        wall_s=wall_s,
        error_m=None if wall_s is None else step_s / 100,
        broken=broken,
    )


def _study(*curves: CurveResult) -> Tradeoff:
    left_out = {"pybullet semi-implicit-euler": "pybullet cannot do ball joint"}
    return tradeoff(*curves, left_out=left_out)


_STUDY = _study(
    curve("mujoco", "RK4", _point(0.02, 0.001, ("gap",)), _point(0.01, 0.004), _point(0.005, 0.1)),
    curve("mujoco", "Euler", _point(0.01, 0.005)),
    curve("mujoco", "RK4", _point(0.02, 0.0001), variation="native"),
    curve("dart", "euler", _point(0.002, 0.5), _point(0.001, 1.0)),
    curve("exudyn", "alpha", _point(0.02, 0.1, ("gap", "energy")), _point(0.01, 0.2, ("gap",))),
)


def _cells(table: str) -> dict[str, str]:
    head, _, row, *_ = table.splitlines()
    pairs = zip(head.split("|")[1:-1], row.split("|")[1:-1], strict=True)
    return {heading.strip(): cell.strip() for heading, cell in pairs}


def test_cells_have_the_cheapest_that_keeps_all_budgets_and_the_best_is_bold() -> None:
    cells = _cells(choose_table([_STUDY]))

    assert cells == {
        "scene and budget of its error": "pair<br>≤ 1.0 mm at 1 s",
        "mujoco": "**RK4, 10 ms**<br>100 µm<br>**4.0 ms**",
        "dart": "euler, 2.0 ms<br>20 µm<br>500 ms",
        "exudyn": "–",
        "pybullet": "–",
    }


def test_the_toolkits_own_stepping_never_stands_for_an_engine() -> None:
    extra = msgspec.structs.replace(curve("dart", "RK4", _point(0.02, 0.0001)), own=False)

    assert choose_table([_study(*_STUDY.curves, extra)]) == choose_table([_STUDY])


def test_an_engine_that_steps_nothing_has_the_toolkits_stepping() -> None:
    lent = msgspec.structs.replace(curve("pinocchio", "RK4", _point(0.02, 0.0001)), own=False)

    cells = _cells(choose_table([_study(*_STUDY.curves, lent)]))

    assert cells["pinocchio"] == "**RK4, 20 ms**<br>200 µm<br>**100 µs**"


def test_a_dash_has_its_reason() -> None:
    table = choose_table([_STUDY])

    assert "- exudyn on pair: nearest is alpha at 10 ms, over budget: gap" in table
    assert "- pybullet on pair: pybullet cannot do ball joint" in table
    assert "mujoco on" not in table


def test_an_engine_that_was_not_tried_says_so() -> None:
    other = msgspec.structs.replace(_study(curve("mujoco", "RK4", _point(0.01, 0.1))), scene="two")

    assert "- dart on two: not measured" in choose_table([_STUDY, other])


def test_options_are_marked_and_a_busy_machine_is_told() -> None:
    option = curve("mujoco", "RK4", _point(0.02, 0.002), variation="solver = CG")
    busy = msgspec.structs.replace(_study(*_STUDY.curves, option), busy=2.5)

    assert "**RK4°, 20 ms**" in choose_table([busy])
    assert "Made on a machine, which was busy: times are up to 2.5 ×" in choose_table([busy])
    assert "busy" not in choose_table([_STUDY])


def test_what_did_not_end_says_so() -> None:
    table = choose_table([_study(curve("dart", "euler", _point(0.02, None, kind="crashed")))])

    assert _cells(table)["dart"] == "–"
    assert "- dart on pair: crashed: gave up" in table


def test_scenes_without_a_truth_are_not_said_to_be_judged() -> None:
    limit = msgspec.structs.replace(_STUDY, own_limit=200, reference_ends_s=0.0)
    impact = msgspec.structs.replace(_STUDY, horizon_s=0.38, reference_ends_s=0.39)

    assert "pair<br>≤ 1.0 mm from its own small-step limit at 1 s" in choose_table([limit])
    assert "pair<br>error at 0.38 s, before the first impact" in choose_table([impact])


def test_the_script_puts_it_between_its_marks(tmp_path: Path) -> None:
    (tmp_path / "pair.json").write_bytes(results_json([_STUDY]))
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- choose-table: begin -->\nold\n<!-- choose-table: end -->\nb\n")

    command = [sys.executable, "-m", "benchmarks.choose_table", str(tmp_path), "--into", str(page)]
    subprocess.run(command, cwd=_ROOT, check=True)

    assert page.read_text() == (
        f"a\n<!-- choose-table: begin -->\n{choose_table([_STUDY])}\n"
        "<!-- choose-table: end -->\nb\n"
    )


def test_a_methods_own_limit_is_no_way_of_reaching_it() -> None:
    there = msgspec.structs.replace(_point(1e-3, 0.5), error_m=0.0)
    study = _study(curve("mujoco", "RK4", there, _point(1e-2, 0.01, ("gap",))))
    limit = msgspec.structs.replace(study, own_limit=200)

    assert "nearest is RK4 at 10 ms, over budget: gap" in choose_table([limit])
    assert "over budget" not in choose_table([study])


def test_scenes_on_several_machines_name_each() -> None:
    other = msgspec.structs.replace(_STUDY, scene="trio", machine="another")

    assert f"Made on {_STUDY.machine} (pair); another (trio), with" in choose_table([_STUDY, other])

"""Output of `mbds-xsim tradeoff`, from a hand-made study and through the command."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from mbds_xsim.report.files import link, results_json, rows_csv, write_reports
from mbds_xsim.report.terminal import print_report
from mbds_xsim.studies.tradeoff import Measurement, Point, Ratio, Tradeoff
from mbds_xsim.studies.tradeoff import words as summary
from mbds_xsim.studies.tradeoff.figures import charts_of
from mbds_xsim.studies.tradeoff.present import present, to_png
from tests.command_line import CommandLine
from tests.results import curve, tradeoff


def _point(count: int, wall: float | None, error: float, **other: object) -> Point:
    plain = Point(steps_per_frame=count, step_s=0.02 / count, kind="done", starts=3)
    figures = {"wall_s": wall, "wall_low_s": wall, "wall_high_s": wall, "cpu_s": wall}
    errors = {"error_m": error, "error_weighted_m": error, "gap_m": 1e-6, "energy": 1e-4}
    return msgspec.structs.replace(plain, **(figures | errors | {"setup_s": 0.01} | other))


_FAST = [
    Point(steps_per_frame=1, step_s=0.02, kind="crashed", reason="<b>SIGSEGV</b> & gone"),
    _point(2, 0.01, 1e-3, broken=("gap",), on_front=True),
    _point(4, 0.02, 1e-5, on_front=True),
]
_SLOW = [
    _point(1, 0.5, 1e-2),
    _point(2, 2.0, 1e-4),
    Point(steps_per_frame=4, step_s=0.005, kind="too slow", reason="predicted 40 s a start"),
]


@pytest.fixture
def study() -> Tradeoff:
    return tradeoff(
        curve("mujoco", "RK4", *_FAST, measured_order=3.98),
        curve("dart", "semi-implicit-euler", *_SLOW, measured_order=3.98),
        curve("mujoco", "RK4", _point(2, 0.005, 5e-4), variation="solver = CG"),
        trajectories=(1, 4, 7),
        budget={"error_1s": 1e-3, "error": 1e-2, "gap": 1e-4, "energy_first_order": 1e-2},
        ratios=(
            Ratio(error_m=1e-3, budget=True, wall_s=(0.01, 1.0, 0.005), best=2),
            Ratio(error_m=1e-4, budget=False, wall_s=(0.0141, 2.0, None), best=0),
        ),
        left_out={"exudyn RK44": "exudyn RK44 cannot do ball joint"},
        workers=2,
        busy=1.02,
        measured=12,
        kept=3,
        wall_s=12.0,
    )


def _printed(study: Tradeoff, width: int) -> str:
    stream = io.StringIO()
    print_report(present(study), Console(file=stream, width=width, color_system=None))
    return stream.getvalue()


def test_the_table_compares_costs_at_equal_accuracy(study: Tradeoff) -> None:
    text = _printed(study, 130)

    (fast,) = (line for line in text.splitlines() if re.match(r" *mujoco +RK4", line))
    (slow,) = (line for line in text.splitlines() if re.match(r" *dart", line))
    row = "4.0 (4) 10 ms 2× 1× 5.0 ms: 20 ms 10 µm"
    assert " ".join(fast.split()).endswith(row)
    assert "200×" in slow
    assert "142×" in slow
    assert "mujoco RK4 solver = CG: 0.5 × the cost at the budget" in text
    assert "crashed: <b>SIGSEGV</b> & gone" in text
    assert "too slow: predicted 40 s a start" in text


@pytest.mark.parametrize("width", [80, 104])
def test_the_table_fits_the_terminal(study: Tradeoff, width: int) -> None:
    lines = _printed(study, width).splitlines()

    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)


def test_the_cheapest_within_all_budgets_breaks_none(study: Tradeoff) -> None:
    cheapest = summary.cheapest_within(study)

    assert cheapest is not None
    curve, point = cheapest
    assert (curve.variation, point.wall_s) == ("solver = CG", 0.005)


def test_a_busy_machine_is_told(study: Tradeoff) -> None:
    assert "busy" not in summary.machine_line(study)
    noisy = msgspec.structs.replace(study, busy=2.5)
    assert "it was busy: times are 2.5 × the processor's" in summary.machine_line(noisy)


def test_words_say_how_far_the_error_goes(study: Tradeoff) -> None:
    impact = msgspec.structs.replace(study, reference_ends_s=0.383, horizon_s=0.38)
    at_once = msgspec.structs.replace(study, reference_ends_s=0.0, own_limit=200)

    assert "at 1 s, the worst of 3 medium starts" in summary.describe_error(study)
    assert "before the first impact (0.38 s" in summary.describe_error(impact)
    assert "where an impact comes before 1 s, the budget at 1 s is not" in summary.conclusion(
        impact
    )
    assert "not checked" not in summary.conclusion(study)
    short = msgspec.structs.replace(study, duration_s=0.5, horizon_s=0.5)
    assert "as the scene ends before 1 s, the budget at 1 s is not" in summary.conclusion(short)
    assert [charts_of(each)[0].budget is None for each in (study, short)] == [False, True]
    assert "the method's own run at 200 steps a frame, at 1 s" in summary.describe_error(at_once)
    assert "from its own limit" in summary.conclusion(at_once)


def test_an_impact_after_the_error_is_taken_does_not_move_it(study: Tradeoff) -> None:
    late = msgspec.structs.replace(study, reference_ends_s=1.2)

    assert summary.describe_error(late) == summary.describe_error(study)
    assert "error at 1 s" in [title.split(",")[0] for title in _titles(late)]


def _titles(study: Tradeoff) -> list[str]:
    return [chart.title for chart in charts_of(study)]


def test_reasons_that_differ_in_numbers_are_told_once(study: Tradeoff) -> None:
    reasons = {1: "frame 1: residual 1e-01", 2: "frame 2: residual 1e-02", 4: "a clamp"}
    bad = [_point(n, None, 0.0, kind="failed", reason=reason) for n, reason in reasons.items()]
    failing = msgspec.structs.replace(study, curves=(curve("dart", "RK4", *bad),))

    assert summary.failures(failing) == [
        ("dart RK4", "20 ms, 10 ms", "failed: frame 1: residual 1e-01"),
        ("dart RK4", "5.0 ms", "failed: a clamp"),
    ]


def test_files_are_written(study: Tradeoff, tmp_path: Path) -> None:
    other = msgspec.structs.replace(study, scene="other")
    paths = {kind: tmp_path / f"out.{kind}" for kind in ("html", "markdown")}
    picture = link(tmp_path / "out.png", paths["markdown"])
    reports = [replace(present(study), picture=picture), present(other)]

    write_reports(reports, "Speed against accuracy", **paths)

    page = paths["html"].read_text()
    assert page.count("<svg role=") >= 6
    assert "&lt;b&gt;SIGSEGV" in page
    assert "<b>SIGSEGV" not in page
    assert 'class="curve-1 tip"><title>dart semi-implicit-euler' in page
    assert not re.search(r'(src|href)="(?!#)', page)
    assert to_png([study, other])[:4] == b"\x89PNG"
    text = paths["markdown"].read_text()
    assert "# pair: speed against accuracy" in text
    assert "# other: speed against accuracy" in text
    assert "Cheapest within all budgets: mujoco RK4 solver = CG at 10 ms" in text
    assert text.count("![pair, speed against accuracy](out.png)\n") == text.count("![") == 1
    result = json.loads(results_json([study]))
    assert result["curves"][0]["points"][0]["kind"] == "crashed"
    assert [entry["scene"] for entry in json.loads(results_json([study, other]))] == [
        "pair",
        "other",
    ]


def test_raw_rows_keep_every_repeat_and_version() -> None:
    (line,) = csv.DictReader(io.StringIO(rows_csv(Measurement, [_row()]).decode()))

    assert line["wall_s"] == "0.01 0.02"
    assert json.loads(line["options"]) == {"solver": "CG"}
    assert list(line) == rows_csv(Measurement, []).decode().strip().split(",")
    assert line["broken"] == "error at 1 s; gap"
    assert (line["version"], line["machine"], line["error_m"]) == ("4.0.0", "a, machine", "")


def _row() -> Measurement:
    return Measurement(
        key="k",
        scene="pair",
        engine="mujoco",
        version="4.0.0",
        method="RK4",
        variation="solver = CG",
        options={"solver": "CG"},
        steps_per_frame=2,
        step_s=0.01,
        trajectory=1,
        seed=0,
        machine="a, machine",
        limit_s=30.0,
        kind="done",
        wall_s=(0.01, 0.02),
        broken=("error at 1 s", "gap"),
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "Missing argument 'SCENE…'"),
        (["teapot"], "no scene is called 'teapot'"),
        (["1pendulum", "teapot"], "no scene is called 'teapot'"),
        (["1pendulum", "--engines", "ode"], "no engine is called 'ode'"),
        (["1pendulum", "--starts", "0"], "--starts"),
        (["1pendulum", "--limit", "0"], "--limit"),
        (["1pendulum", "--png", "."], "--png: cannot write ."),
        (["1pendulum", "--csv", "a", "--html", "a"], "both name a"),
    ],
)
def test_bad_input_is_one_line(words: list[str], said: str, run: CommandLine, here: Path) -> None:
    assert said in run("tradeoff", *words).refusal
    assert list(here.iterdir()) == []

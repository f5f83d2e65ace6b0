"""Outputs of a stability study: table, maps, page and rows, and a command for each cell."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mbds_xsim.base.isolate import HERE, Crash, Task, run_tasks
from mbds_xsim.report.files import rows_csv, to_html, to_markdown
from mbds_xsim.studies.stability import FAILED, MapCell, Survey
from mbds_xsim.studies.stability import survey as surveys
from mbds_xsim.studies.stability.present import present, to_png
from mbds_xsim.studies.stability.studies import STUDIES
from mbds_xsim.studies.stability.survey import SurveyPlan, survey
from mbds_xsim.studies.stability.words import (
    LOOKS,
    command_of,
    conclusion,
    facts_of,
    first_failures,
    limit,
)
from tests.command_line import CommandLine

_COUNTS = (2, 10, 50)
_VALUES = (1e2, 1e4)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MBDS_XSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        plan = SurveyPlan(
            STUDIES["stiffness"],
            ("mujoco", "pybullet"),
            values=_VALUES,
            counts=_COUNTS,
            conduct=HERE,
            command="mbds-xsim stability stiffness",
        )
        return survey(plan)


def test_the_table_gives_the_largest_stable_step(sweep: Survey) -> None:
    rk4 = next(panel for panel in sweep.panels if panel.name == "mujoco RK4")

    assert [limit(rk4, row) for row in range(2)] == ["50", "10"]
    table = to_markdown([present(sweep)])
    assert "| engine and method / stiffness [N/m] | 100 | 10000 |" in table
    assert "| mujoco RK4 | 50 | 10 |" in table


def test_what_breaks_is_counted_with_what_is_silent(sweep: Survey) -> None:
    failed = [cell for cell in sweep.cells if cell.failed]
    silent = [cell for cell in failed if cell.silent]

    assert conclusion(sweep).startswith(f"{len(failed)} of {len(sweep.cells)} cells fail, ")
    assert f"{len(silent)} of them without a word" in conclusion(sweep)
    lines = dict(first_failures(sweep))
    assert "without a word from the engine" in lines["pybullet semi-implicit-euler"]


def test_what_an_engine_cannot_do_makes_it_no_stabler(sweep: Survey) -> None:
    best = sweep.panels[0]
    refused = msgspec.structs.replace(best.cells[0][0], outcome="refused")
    unable = msgspec.structs.replace(
        best, engine="unable", cells=tuple(tuple(refused for _ in row) for row in best.cells)
    )
    sentence = conclusion(msgspec.structs.replace(sweep, panels=(unable, *sweep.panels)))
    assert sentence.split("; ")[1] == conclusion(sweep).split("; ")[1]


def test_what_ran_out_of_time_is_not_measured(sweep: Survey) -> None:
    panel = next(panel for panel in sweep.panels if panel.name == "mujoco RK4")

    def late(outcomes: Sequence[Sequence[str]]) -> Survey:
        cells = tuple(
            tuple(msgspec.structs.replace(c, outcome=o) for c, o in zip(row, names, strict=True))
            for row, names in zip(panel.cells, outcomes, strict=True)
        )
        return msgspec.structs.replace(sweep, panels=(msgspec.structs.replace(panel, cells=cells),))

    ends = ["timed out"] * len(panel.cells[0])
    some = late([["stable", *ends[1:]], ends])
    assert limit(some.panels[0], 0) == f"{1e3 * sweep.steps_s[0]:g}"
    assert limit(some.panels[0], 1) == "not measured"
    assert dict(first_failures(some))["mujoco RK4"].startswith(
        f"not measured {2 * len(ends) - 1}×, of"
    )
    sentence = conclusion(late([ends, ends]))
    assert sentence.startswith(f"0 of {2 * len(ends)} cells fail, ")
    assert f"{2 * len(ends)} are not measured (out of time: give more by --limit)" in sentence
    assert sentence.endswith("none is stable")


def test_every_outcome_has_its_own_look() -> None:
    assert FAILED | {"stable", "off course", "refused", "timed out"} == set(LOOKS)
    assert len({look.colour for look in LOOKS.values()}) == len(LOOKS)
    assert len({look.letter for look in LOOKS.values()}) == len(LOOKS)


def test_the_page_needs_nothing_else_and_names_every_cell(sweep: Survey) -> None:
    page = to_html([present(sweep)] * 2, "")

    assert not re.search(r"(src|href)=[\"']?https?:", page)
    assert page.count("<svg ") == 2 * len(sweep.panels)
    assert page.count('class="curve-0 tip"') == 2 * len(_VALUES) * len(_COUNTS)
    wrong = next(cell for cell in sweep.cells if cell.failed)
    assert command_of(wrong, sweep) in page.replace("&amp;", "&")
    assert "http" not in page.replace("http://www.w3.org", "")


def test_the_picture_is_one(sweep: Survey) -> None:
    assert to_png([sweep]).startswith(b"\x89PNG")


def test_a_cell_a_line(sweep: Survey) -> None:
    rows = list(csv.DictReader(io.StringIO(rows_csv(MapCell, sweep.cells, "silent").decode())))

    assert len(rows) == len(sweep.cells)
    assert {row["silent"] for row in rows} == {"True", "False"}
    assert [float(row["step_s"]) for row in rows] == [cell.step_s for cell in sweep.cells]


def test_a_cell_is_told_with_what_why_and_how_to_see_it_again(sweep: Survey) -> None:
    cell = next(c for c in sweep.cells if c.engine == "mujoco" and c.told == "engine")

    lines = dict(facts_of(cell, sweep))

    assert lines["who told"] == "the engine"
    assert "QACC" in lines["in its words"]
    assert lines["again"].startswith("mbds-xsim stability stiffness --engines mujoco --methods ")


@pytest.fixture(autouse=True)
def _wide(in_process: None, monkeypatch: pytest.MonkeyPatch) -> None:
    del in_process
    monkeypatch.setenv("COLUMNS", "200")


def test_the_studies_are_listed(run: CommandLine) -> None:
    ended = run("stability", "--list")

    assert ended.code == 0
    for name in STUDIES:
        assert name in ended.out


@pytest.mark.parametrize(
    "words",
    [
        ("--json", "s.json"),
        ("--json", "-"),
        ("--open",),
        ("--out", "maps"),
        ("--engines", "mujoco"),
        ("--step", "0"),
        ("--settings", "native"),
        ("--fresh",),
        ("--workers", "1"),
        ("--limit", "60"),
        ("--no-cache",),
    ],
)
def test_the_list_of_studies_takes_no_other_options(
    run: CommandLine, here: Path, words: tuple[str, ...]
) -> None:
    ended = run("stability", "--list", *words)

    assert (ended.code, ended.out) == (2, "")
    assert ended.err == (
        f"mbds-xsim: {words[0]}: got it, but --list only prints names; leave it out\n"
    )
    assert list(here.iterdir()) == []


def test_the_command_of_a_cell_runs_it_again(run: CommandLine, sweep: Survey) -> None:
    cell = next(c for c in sweep.cells if c.told == "engine")
    words = command_of(cell, sweep).split()[1:]

    ended = run(*words, "--json", "-")
    assert ended.code == 0
    (panel,) = json.loads(ended.out)["panels"]
    assert panel["cells"][0][0]["outcome"] == cell.outcome
    assert panel["cells"][0][0]["reason"] == cell.reason
    assert cell.reason in " ".join(run(*words).out.split())


def test_the_command_of_a_cell_has_its_settings_and_all_digits(
    run: CommandLine, sweep: Survey
) -> None:
    euler = next(c for c in sweep.cells if (c.method, c.profile) == ("Euler", "matched"))
    cell = msgspec.structs.replace(euler, value=100.0625, step_s=0.1 / 7)

    ended = run(*command_of(cell, sweep).split()[1:], "--json", "-")

    assert ended.code == 0
    (panel,) = json.loads(ended.out)["panels"]
    assert panel["profile"] == "matched"
    ((again,),) = panel["cells"]
    assert (again["value"], again["step_s"]) == (100.0625, pytest.approx(0.1 / 7, rel=1e-11))


def test_a_file_in_the_place_of_the_folder_is_refused_before_anything_runs(
    run: CommandLine, here: Path
) -> None:
    (here / "maps").write_text("")

    message = run("stability", "spin", "--engines", "mujoco", "--quick", "--out", "maps").refusal

    assert "--out" in message
    assert "maps" in message
    assert "mujoco" not in message


def test_a_folder_gets_every_file_of_a_study(run: CommandLine, here: Path) -> None:
    ended = run(
        "stability", "friction", "--engines", "mujoco", "--methods", "Euler", "--settings",
        "matched", "--quick", "--out", "maps",
    )  # fmt: skip

    assert ended.code == 0
    assert "friction: largest stable step [ms]" in ended.out
    assert "coefficient of friction" in ended.out
    names = sorted(path.name for path in (here / "maps").iterdir())
    assert names == [f"friction.{end}" for end in ("csv", "html", "json", "md", "png")]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("steps",), "study"),
        (("spin", "--step", "0.03"), "step: got 0.03 s"),
        (("spin", "--value", "fast"), "--value: got 'fast'"),
        (("spin", "--methods", "RK5"), "RK5"),
        (("spin", "--settings", "usual"), "usual"),
    ],
)
def test_wrong_words_are_told_in_one_line(
    run: CommandLine, words: tuple[str, ...], told: str
) -> None:
    assert told in run("stability", *words).refusal


def test_a_value_without_a_reference_is_told(
    sweep: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))

    def failing(tasks: list[Task], **options: Any) -> list[Any]:
        if tasks and tasks[0].function is surveys._truth:
            return [Crash("no answer within 1 s") for _ in tasks]
        return run_tasks(tasks, **options)

    monkeypatch.setattr(surveys, "run_tasks", failing)
    plan = SurveyPlan(
        STUDIES["stiffness"], ("mujoco",), ("RK4",), values=(1e2,), counts=(10,), conduct=HERE
    )

    blind = survey(plan)

    assert blind.unknown == {"100": "no answer within 1 s"}
    assert blind.cells[0].error is None
    assert blind.cells[0].key not in {cell.key for cell in sweep.cells}

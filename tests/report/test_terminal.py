"""A validation shown on the terminal."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from mbds_xsim.base.files import read_file
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.measure.result import Validation, from_plain
from mbds_xsim.report import blocks
from mbds_xsim.report.files import to_markdown
from mbds_xsim.report.terminal import SIGNS, Outlet, print_blocks, print_report
from mbds_xsim.studies.shift.present import present as present_shift
from mbds_xsim.studies.tradeoff import Tradeoff
from mbds_xsim.studies.tradeoff.present import present as present_tradeoff
from mbds_xsim.studies.validate.present import present
from mbds_xsim.studies.validate.words import cells_of

from .conftest import Case


def printed(validation: Validation, width: int) -> str:
    console = Console(width=width, _environ={})
    with console.capture() as capture:
        print_report(present(validation), console)
    return capture.get()


@pytest.mark.parametrize("width", [80, 120])
def test_nothing_is_cut_off(case: Case, width: int) -> None:
    text = printed(case.validation, width)

    assert "…" not in text
    assert max(len(line) for line in text.splitlines()) <= width


@pytest.mark.parametrize("columns", ["0", "1", "20", "60"])
def test_no_figure_is_cut_off_where_columns_are_few(
    case: Case, columns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    console = Outlet(stderr=False)
    with console.capture() as capture:
        print_report(present(case.validation), console)

    wanted, shown = printed(case.validation, 80).splitlines(), capture.get().splitlines()
    row = wanted[1 + next(k for k, line in enumerate(wanted) if "──" in line)]
    assert row.split() in [line.split() for line in shown] or columns == "0"
    assert capture.get().strip()


_REPORTS = Path(__file__).parents[2] / "reports"
_STORED = {
    "2ladder.json": lambda text: present(msgspec.json.decode(text, type=Validation)),
    "tradeoff/simplecubli.json": lambda text: present_tradeoff(
        msgspec.json.decode(text, type=Tradeoff)
    ),
    "shift/5pendulum-worth.json.gz": lambda text: present_shift(
        from_plain(msgspec.json.decode(text), Shift)
    ),
}


def _bare_tables(report: blocks.Report) -> list[blocks.Table]:
    """Return the tables of a terminal with nothing but headings and cells."""
    whole = [block for block in report.blocks if isinstance(block, blocks.Table)]
    for section in report.blocks:
        if isinstance(section, blocks.Section) and "terminal" in section.on:
            whole += [block for block in section.blocks if isinstance(block, blocks.Table)]
    return [
        replace(
            each, title="", note="", most=None, grouped=False,
            rows=tuple(replace(row, reasons=()) for row in each.rows),
        )
        for each in whole
    ]  # fmt: skip


def _shown(table: blocks.Table, width: int) -> str:
    console = Console(width=width, _environ={}, markup=False, highlight=False, emoji=False)
    with console.capture() as capture:
        print_blocks([table], console)
    return capture.get()


@pytest.mark.parametrize("width", [80, 104, 120, 160])
@pytest.mark.parametrize("name", _STORED)
def test_every_sign_of_every_cell_is_shown(name: str, width: int) -> None:
    tables = _bare_tables(_STORED[name](read_file(_REPORTS / name)))
    assert tables
    for table in tables:
        shown = [k for k, column in enumerate(table.columns) if column.narrow or width >= 104]
        cells = [row.cells[k] for row in table.rows for k in shown]
        words = [table.columns[k].heading for k in shown]
        words += [f"{cell.text}{SIGNS.get(cell.mark, '')}" for cell in cells]
        text = _shown(table, width)
        assert Counter("".join(text.split())) - Counter("─" * len(text)) == Counter(
            "".join("".join(words).split())
        )
        figures = [row.cells[k].text for row in table.rows for k in shown if k]
        assert [each for each in figures if len(each) < 16 and each not in text] == []


def test_a_table_that_is_short_of_room_folds_headings_then_words_never_figures() -> None:
    columns = (
        blocks.Column("what it is", words=True),
        *(blocks.Column("a long heading") for _ in range(6)),
    )
    table = blocks.Table(columns, (blocks.row_of(("one two three", *["123.4 mm"] * 6), "pass"),))

    wide, narrow = _shown(table, 120).splitlines(), _shown(table, 80).splitlines()

    assert any(line.split()[:3] == ["what", "it", "is"] for line in wide)
    row = " ".join(["one two three", *["123.4 mm"] * 6])
    assert any(" ".join(line.split()) == row for line in wide)
    assert max(len(line) for line in narrow) <= 80
    assert any(line.count("123.4 mm") == 6 for line in narrow)


def test_the_method_is_left_out_where_space_is_short(case: Case) -> None:
    assert "generalised-alpha" in printed(case.validation, 120)
    assert "generalised-alpha" not in printed(case.validation, 80)


def test_each_engine_has_a_row_for_each_profile(case: Case) -> None:
    rows = printed(case.validation, 120).splitlines()

    pybullet = next(k for k, row in enumerate(rows) if row.strip().startswith("pybullet"))
    assert rows[pybullet].split()[:2] == ["pybullet", "native"]
    assert rows[pybullet + 1].split()[0] == "matched"


def test_a_failure_says_why(case: Case) -> None:
    lines = printed(case.validation, 120).splitlines()

    reason = next(line for line in lines if "pybullet native:" in line)
    assert reason.startswith("✗")
    assert "trajectory 2 ended at frame 60" in reason
    assert "more)" in reason


def test_the_last_line_is_the_verdict(case: Case) -> None:
    last = printed(case.validation, 120).strip().splitlines()[-1]

    assert last.split()[:2] == ["FAIL", "2pendulum:"]
    assert "3 trajectories of seed 0" in last


def test_figures_over_their_budget_stand_out(one_engine: Case) -> None:
    (result,) = one_engine.validation.engines
    replace = msgspec.structs.replace
    gap = next(finding for finding in result.findings if finding.check == "gap")
    broken = replace(gap, figure=0.5, passed=False)
    far = replace(result, constraint_gap_m=0.5, findings=(broken,))
    near = replace(result, constraint_gap_m=1e-6)

    assert "\x1b[1;31m" in _cell_styles(one_engine.validation, far)
    assert "\x1b[1;31m" not in _cell_styles(one_engine.validation, near)


def _cell_styles(validation: Validation, result: object) -> str:
    console = Console(width=120, force_terminal=True, color_system="standard")
    with console.capture() as capture:
        alone = msgspec.structs.replace(validation, engines=(result,), verdict="pass")
        print_report(present(alone), console)
    rows = capture.get().splitlines()
    return next(row for row in rows if row.lstrip().startswith("mujoco"))


def test_a_crashed_engine_has_a_row_without_figures(with_crash: Case) -> None:
    text = printed(with_crash.validation, 120)

    row = next(line for line in text.splitlines() if line.strip().startswith("pybullet"))
    assert row.split().count("–") == 6
    assert "pybullet matched: the engine ended with signal 11" in text


def test_without_a_reference_and_without_failures(one_engine: Case) -> None:
    validation = msgspec.structs.replace(
        one_engine.validation, reference=None, names=("mujoco matched",), matrix_m=((0.0,),)
    )

    text = printed(validation, 120)

    assert "reference: none" in text
    assert "odd one out: none, nothing to compare" in text


def test_what_a_check_could_not_judge_is_told(one_engine: Case) -> None:
    (result,) = one_engine.validation.engines
    why = "trajectory 0: not measurable, because the coarsest run of the check stopped at frame 6"
    first, *rest = result.findings
    noted = msgspec.structs.replace(first, passed=True, note=why)
    result = msgspec.structs.replace(result, findings=(noted, *rest))
    validation = msgspec.structs.replace(one_engine.validation, engines=(result,))

    assert why in " ".join(printed(validation, 120).split())
    assert why in to_markdown([present(validation)])
    assert why not in to_markdown([present(one_engine.validation)])


def test_text_that_looks_like_markup_is_printed_as_it_is(one_engine: Case) -> None:
    (result,) = one_engine.validation.engines
    validation = msgspec.structs.replace(
        one_engine.validation,
        engines=(msgspec.structs.replace(result, reasons=("bodies[0] left [red]",)),),
    )

    assert "bodies[0] left [red]" in printed(validation, 120)


def test_what_is_over_its_budget_has_a_sign_without_colours_too(case: Case) -> None:
    cells = [c for result in case.validation.engines for c in cells_of(result, case.validation)]
    over = [cell.text for cell in cells if cell.mark == "over"]

    text = printed(case.validation, 120)

    assert over
    assert all(f"{cell}✗" in text for cell in over)
    failed = sum(result.verdict == "fail" for result in case.validation.engines)
    assert text.count("✗") == len(over) + 2 * failed


def test_a_figure_that_its_check_lets_pass_as_uncertain_has_no_sign(one_engine: Case) -> None:
    (result,) = one_engine.validation.engines
    replace = msgspec.structs.replace
    energy = next(finding for finding in result.findings if finding.check == "energy")
    vague = replace(energy, figure=0.55, passed=True)
    wide = replace(result, energy_balance=0.55, findings=(vague,))

    assert vague.budget is not None
    assert vague.figure > vague.budget
    assert [c.mark for c in cells_of(wide, one_engine.validation) if c.text == "0.55"] == [""]


def test_lines_that_are_left_out_are_counted_and_stand_in_the_json() -> None:
    """Every command that leaves lines out has `--json`, but `verify` no page."""
    lines = blocks.Remarks.of((str(k), "wrong") for k in range(3)).lines
    console = Console(width=120)
    with console.capture() as capture:
        print_blocks([blocks.Remarks(lines, most) for most in (2, 1)], console)

    assert "and: 1 more line, which --json lists" in capture.get()
    assert "and: 2 more lines, which --json lists" in capture.get()

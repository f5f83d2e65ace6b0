"""A validation shown on the terminal."""

from __future__ import annotations

import msgspec
import pytest
from rich.console import Console

from mbds_xsim.measure.result import Validation
from mbds_xsim.report.files import to_markdown
from mbds_xsim.report.terminal import Outlet, print_report
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
    far = msgspec.structs.replace(result, constraint_gap_m=0.5)
    near = msgspec.structs.replace(result, constraint_gap_m=1e-6)

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

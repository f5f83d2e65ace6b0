"""An audit on the terminal: each check's figure beside what is allowed, and what did not run."""

from __future__ import annotations

from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.counted import counted
from mbds_xsim.dataset.audit import Audited
from mbds_xsim.report import quantity
from mbds_xsim.result import FindingResult

__all__ = ["print_audited"]


def print_audited(audited: Audited, console: Console) -> None:
    """Print the checks that ran, what was taken for granted, what failed, what did not run."""
    console.print(
        f"{audited.file}: {audited.scene}, "
        f"{counted(audited.trajectories, 'trajectory')} of "
        f"{counted(audited.steps, 'step')} of {audited.frame_s:g} s; "
        f"given: {', '.join(audited.given)}",
        highlight=False,
        soft_wrap=True,
    )
    for line in audited.taken:
        console.print(Text(f"· {line}", style="dim"), soft_wrap=True)
    console.print(_table(audited))
    for reason in audited.reasons:
        console.print(Text(f"✗ {reason}", style="red"), soft_wrap=True)
    left = sorted(audited.not_checked.items(), key=lambda pair: pair[1])
    for reason, names in groupby(left, key=lambda pair: pair[1]):
        console.print(
            f"not checked: {', '.join(name for name, _ in names)}: {reason}",
            highlight=False,
            soft_wrap=True,
        )
    passed = audited.verdict == "pass"
    verdict = (
        "every check that ran holds"
        if passed
        else f"{counted(len(audited.reasons), 'check')} out of budget"
    )
    console.print(Text(verdict, style="bold green" if passed else "bold red"))


def _table(audited: Audited) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("check", no_wrap=True)
    for heading in ("worst", "budget", "trajectory", "frame"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("where")
    table.add_column("", no_wrap=True)
    for finding in audited.findings:
        table.add_row(*_cells(finding))
    return table


def _cells(finding: FindingResult) -> tuple[str | Text, ...]:
    judged = finding.budget is not None
    mark = Text("✓", "bold green") if finding.passed else Text("✗", "bold red")
    return (
        finding.check,
        quantity.with_unit(finding.figure, finding.unit),
        quantity.with_unit(finding.budget, finding.unit) if judged else "shown",
        str(finding.trajectory),
        str(finding.frame),
        finding.where,
        mark if judged else "",
    )

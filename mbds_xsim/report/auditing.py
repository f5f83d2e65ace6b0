"""An audit on the terminal: each check's figure beside what is allowed, and what did not run."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.counted import counted
from mbds_xsim.dataset.audit import Audited
from mbds_xsim.report import quantity
from mbds_xsim.result import FindingResult

__all__ = ["HEADINGS", "cells", "conclusion", "left_out", "print_audited"]

HEADINGS = ("check", "worst", "budget", "trajectory", "frame", "where", "")


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
    for reason, names in left_out(audited):
        console.print(f"not checked: {names}: {reason}", highlight=False, soft_wrap=True)
    style = "bold green" if audited.verdict == "pass" else "bold red"
    console.print(Text(conclusion(audited), style=style), soft_wrap=True)


def conclusion(audited: Audited) -> str:
    """Say whether the trajectories hold."""
    held = sum(finding.budget is not None for finding in audited.findings)
    motions = f"{counted(audited.trajectories, 'trajectory')} of {audited.scene}"
    if audited.verdict == "pass":
        return f"every check that ran holds ({held}, on {motions})"
    broken = ", ".join(f.check for f in audited.findings if not f.passed)
    return f"{counted(len(audited.reasons), 'check')} out of budget on {motions}: {broken}"


def left_out(audited: Audited) -> Iterator[tuple[str, str]]:
    """Give reasons why checks did not run, each with their names."""
    left = sorted(audited.not_checked.items(), key=lambda pair: pair[1])
    for reason, names in groupby(left, key=lambda pair: pair[1]):
        yield reason, ", ".join(name for name, _ in names)


def _table(audited: Audited) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for heading in HEADINGS:
        figure = heading in ("worst", "budget", "trajectory", "frame")
        table.add_column(heading, justify="right" if figure else "left", no_wrap=heading != "where")
    for finding in audited.findings:
        *told, mark = cells(finding)
        table.add_row(*told, Text(mark, "bold green" if finding.passed else "bold red"))
    return table


def cells(finding: FindingResult) -> tuple[str, ...]:
    """Give a check's row."""
    judged = finding.budget is not None
    figure, budget = quantity.beside(finding.figure, finding.budget, finding.unit)
    return (
        finding.check,
        figure,
        budget if judged else "shown",
        str(finding.trajectory),
        str(finding.frame),
        finding.where,
        "" if not judged else "✓" if finding.passed else "✗",
    )

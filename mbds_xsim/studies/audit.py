"""Report of an audit: each check's figure next to its budget, and the checks that did not run."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

from mbds_xsim.base.text import counted
from mbds_xsim.dataset.audit import Audited
from mbds_xsim.measure.result import FindingResult
from mbds_xsim.report import blocks, quantity
from mbds_xsim.report.themed import GREY, INK

_LEAST = 1e-6
"""Smallest share of a budget that is drawn; smaller ones are drawn as this one."""
_COLUMNS = ("check", ">worst", ">budget", ">trajectory", ">frame", "where", "")


def present(audited: Audited, command: str) -> blocks.Report:
    """Report whether the trajectories keep the budgets of all checks that ran."""
    return blocks.Report(
        title=audited.file,
        what=audited.verdict,
        description=f"{audited.scene}, {counted(audited.trajectories, 'trajectory')} of "
        f"{counted(audited.steps, 'step')} of {audited.frame_s:g} s; given: "
        f"{', '.join(audited.given)}",
        conclusion=_conclusion(audited),
        blocks=tuple(_blocks(audited)),
        command=command,
        verdict="pass" if audited.verdict == "pass" else "fail",
    )


def _blocks(audited: Audited) -> Iterator[blocks.Block]:
    yield blocks.Remarks.of(("taken for granted", line) for line in audited.taken)
    note = "worst of all trajectories and frames, beside what is allowed"
    yield blocks.table_of(_COLUMNS, map(_row, audited.findings), note=note)
    judged = [finding for finding in audited.findings if finding.budget]
    if judged:
        yield blocks.FigureGroup((_shares(judged),))
    broken = (blocks.Remark("broken", reason, "fail") for reason in audited.reasons)
    yield blocks.Remarks(tuple(broken))
    yield blocks.Remarks.of(_skipped_checks(audited))


def _conclusion(audited: Audited) -> str:
    count = sum(finding.budget is not None for finding in audited.findings)
    motions = f"{counted(audited.trajectories, 'trajectory')} of {audited.scene}"
    if audited.verdict == "pass":
        return f"every check that ran holds ({count}, on {motions})"
    broken = ", ".join(f.check for f in audited.findings if not f.passed)
    return f"{counted(len(audited.reasons), 'check')} out of budget on {motions}: {broken}"


def _skipped_checks(audited: Audited) -> Iterator[tuple[str, str]]:
    """List the checks that did not run, grouped by reason."""
    pairs = sorted(audited.not_checked.items(), key=lambda pair: pair[1])
    for reason, names in groupby(pairs, key=lambda pair: pair[1]):
        yield f"not checked: {', '.join(name for name, _ in names)}", reason


def _row(finding: FindingResult) -> tuple[blocks.Cell | str, ...]:
    judged = finding.budget is not None
    figure, budget = quantity.beside(
        finding.figure, finding.budget, finding.unit, passed=finding.passed
    )
    mark = blocks.Cell("", "pass" if finding.passed else "fail") if judged else blocks.Cell("")
    return (
        finding.check,
        figure,
        budget if judged else "shown",
        str(finding.trajectory),
        str(finding.frame),
        finding.where,
        mark,
    )


def _shares(judged: list[FindingResult]) -> blocks.Figure:
    """Draw the share of its budget that each check uses."""
    shares = [max(f.figure / (f.budget or 1.0), _LEAST) for f in judged]

    def draw(axes: Any) -> None:
        places = range(len(judged))
        for place, share, one in zip(places, shares, judged, strict=True):
            axes.plot([_LEAST, share], [place, place], color=GREY, lw=3, solid_capstyle="butt")
            axes.plot(share, place, "|" if one.passed else "x", color=INK, ms=9, mew=2)
        axes.axvline(1.0, color=INK, lw=1.0)
        axes.set_xscale("log")
        axes.set_yticks(places, [finding.check for finding in judged])
        axes.invert_yaxis()
        axes.set_xlabel("worst over budget; × is broken")

    summary = ", ".join(
        f"{f.check} {quantity.number(share)}" for f, share in zip(judged, shares, strict=True)
    )
    return blocks.chart(f"shares of the budgets: {summary}", draw, (7.0, 0.9 + 0.26 * len(judged)))

"""An audit as one page that needs nothing else."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from mbds_xsim.dataset.audit import Audited
from mbds_xsim.report import quantity, themed
from mbds_xsim.report.auditing import HEADINGS, cells, conclusion, left_out
from mbds_xsim.report.table import Table
from mbds_xsim.report.template import rendered
from mbds_xsim.report.themed import GREY, INK
from mbds_xsim.result import FindingResult

__all__ = ["to_html"]

_LEAST = 1e-6
"""Smaller shares of a budget are drawn as this one."""
_WORDS = (0, 5, 6)


def to_html(audited: Audited, command: str) -> str:
    """Give the page.

    Args:
        audited: What was found.
        command: That made it.
    """
    judged = [finding for finding in audited.findings if finding.budget]
    rows = tuple(cells(finding) for finding in audited.findings)
    note = "Worst of all trajectories and frames, beside what is allowed; ✓ held, ✗ broken"
    return rendered(
        "tables.html",
        title=audited.file,
        verdict=audited.verdict,
        made_by="audit",
        leads=[conclusion(audited)],
        charts=[_shares(judged)] if judged else [],
        tables=[Table("Checks", note, HEADINGS, rows, _WORDS)],
        remarks=[
            *(("Broken", reason) for reason in audited.reasons),
            *(("Taken for granted", line) for line in audited.taken),
            *((f"Not checked: {names}", reason) for reason, names in left_out(audited)),
        ],
        command=command,
    )


def _shares(judged: list[FindingResult]) -> Markup:
    """Draw how much of its budget each check takes."""
    shares = [max(f.figure / (f.budget or 1.0), _LEAST) for f in judged]

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        places = range(len(judged))
        for place, share in zip(places, shares, strict=True):
            axes.plot([_LEAST, share], [place, place], color=GREY, lw=3, solid_capstyle="butt")
            axes.plot(share, place, "x" if share > 1.0 else "|", color=INK, ms=9, mew=2)
        axes.axvline(1.0, color=INK, lw=1.0)
        axes.set_xscale("log")
        axes.set_yticks(places, [finding.check for finding in judged])
        axes.invert_yaxis()
        axes.set_xlabel("worst over budget; right of the line is broken (×)")

    told = ", ".join(
        f"{f.check} {quantity.number(share)}" for f, share in zip(judged, shares, strict=True)
    )
    return themed.svg(f"shares of the budgets: {told}", draw, (7.0, 0.9 + 0.26 * len(judged)), {})

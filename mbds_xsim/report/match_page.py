"""Matched settings as one page that needs nothing else."""

from __future__ import annotations

from mbds_xsim.report.match_summary import (
    HEADINGS,
    WORDS,
    cells,
    conclusion,
    figures_of,
    left_out,
    remarks,
)
from mbds_xsim.report.table import Table
from mbds_xsim.report.template import rendered
from mbds_xsim.study.match import Match

__all__ = ["to_html"]


def to_html(matches: list[Match]) -> str:
    """Give the page."""
    met = all(found.meets_budget for match in matches for found in match.engines)
    return rendered(
        "tables.html",
        title=f"Matched settings of {', '.join(match.scene for match in matches)}",
        verdict="pass" if met else "fail",
        made_by="match",
        leads=[conclusion(match) for match in matches],
        charts=[],
        tables=[
            Table(match.scene, figures_of(match), HEADINGS, tuple(map(cells, match.engines)), WORDS)
            for match in matches
        ],
        remarks=[line for match in matches for line in (*remarks(match), *left_out(match))],
        command=matches[0].command,
    )

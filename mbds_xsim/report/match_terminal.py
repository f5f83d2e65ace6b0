"""Matched settings on the terminal: what was found, what it costs, what it replaces."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report.match_summary import (
    HEADINGS,
    WORDS,
    cells,
    conclusion,
    figures_of,
    left_out,
    remarks,
)
from mbds_xsim.study.match import Match

__all__ = ["print_match"]


def print_match(match: Match, console: Console) -> None:
    """Print one line an engine, and what fails where a budget is not met."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for place, heading in enumerate(HEADINGS):
        table.add_column(heading, justify="left" if place in WORDS else "right", no_wrap=True)
    for found in match.engines:
        mark = Text("✓ holds", "bold green") if found.meets_budget else Text("✗", "bold red")
        table.add_row(*cells(found)[:-1], mark)
    console.print()
    console.print(Text(conclusion(match), style="bold"), soft_wrap=True)
    console.print(table)
    for name, text in remarks(match):
        console.print(Text(f"· {name}: {text}"))
    for name, text in left_out(match):
        console.print(Text(f"· {name}: {text}", style="dim"))
    console.print(Text(f"· {figures_of(match)}"))

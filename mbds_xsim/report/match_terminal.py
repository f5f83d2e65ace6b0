"""Matched settings on the terminal: what was found, what it costs, what it replaces."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.report import quantity
from mbds_xsim.study.match import Found, Match

__all__ = ["print_match"]

_HEADINGS = ("engine", "method", "step", "cost", "err 1 s", "gap", "energy", "until now", "×")


def print_match(match: Match, console: Console) -> None:
    """Print one line an engine, and what fails where a budget is not met."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for heading in _HEADINGS:
        text = heading in ("engine", "method", "until now")
        table.add_column(heading, justify="left" if text else "right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for found in match.engines:
        mark = Text("✓ holds", "bold green") if found.meets_budget else Text("✗", "bold red")
        table.add_row(*_cells(found), mark)
    console.print()
    console.print(Text(match.scene, style="bold"))
    console.print(table)
    for found in match.engines:
        if found.options:
            options = ", ".join(f"{key} = {value}" for key, value in found.options.items())
            console.print(Text(f"· {found.engine}: {options}"))
        if not found.meets_budget:
            console.print(Text(f"✗ {found.engine}, the best it does: {found.reasons[0]}"))
    for reason in match.left_out.values():
        console.print(Text(f"· left out: {reason}", style="dim"))
    console.print(
        Text(
            f"· figures of {match.held_out} held-out starts of each interval (seed "
            f"{match.held_out_seed}); searched with {match.trajectories} (seed {match.seed}); × is "
            "the processor time over that of the settings until now"
        )
    )


def _cells(found: Found) -> tuple[str, ...]:
    return (
        found.engine,
        found.method,
        quantity.span(found.step_s),
        quantity.span(found.wall_per_simulated_s),
        quantity.length(found.error_1s_m),
        quantity.length(found.constraint_gap_m),
        quantity.number(found.energy_balance),
        f"{found.used_method}, {found.used_steps_per_frame} a frame",
        quantity.number(found.cost_ratio),
    )

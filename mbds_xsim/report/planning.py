"""What a data set will cost, on the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from mbds_xsim.counted import counted
from mbds_xsim.dataset.estimate import CostPlan, Estimate
from mbds_xsim.report import quantity

__all__ = ["print_plan"]

_SIZES = ((1e15, "PB"), (1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1.0, "B"))
_TIMES = ((8766.0, "years"), (24.0, "days"), (1.0, "h"), (1 / 60, "min"), (1 / 3600, "s"))
_NUMBERS = ("each", "simulate", "check", "core-h", "wall", "size")


def print_plan(plan: CostPlan, console: Console) -> None:
    """Print one line an engine."""
    console.print(
        f"{plan.scene}: {counted(plan.trajectories, 'trajectory')} on "
        f"{counted(plan.workers, 'core')}",
        highlight=False,
    )
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("variant", no_wrap=True)
    for heading in (*_NUMBERS, "published"):
        table.add_column(heading, justify="right", no_wrap=True)
    for estimate in plan.estimates:
        table.add_row(*_cells(estimate))
    console.print(table)
    for estimate in plan.estimates:
        if estimate.failure:
            console.print(f"✗ {estimate.variant}: {estimate.failure}", highlight=False)
    for engine, reason in plan.left_out.items():
        console.print(f"{engine} left out: {reason}", highlight=False)
    known = [one.measured for one in plan.estimates if one.measured is not None]
    if known:
        spread = max(one.spread for one in known)
        console.print(
            f"measured on 2 × {known[0].sample} trajectories each, which differ by up to "
            f"{spread:.0%}; core time and size of each are this machine's, the "
            "published share is the sample's",
            highlight=False,
            soft_wrap=True,
        )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    one = estimate.measured
    if one is None or estimate.core_hours is None:
        return (estimate.variant, *[quantity.NONE] * (len(_NUMBERS) + 1))
    return (
        estimate.variant,
        quantity.span(one.trajectory_s),
        f"{one.shares['simulate_s']:.0%}",
        f"{one.shares['check_s']:.0%}",
        quantity.number(estimate.core_hours),
        _scaled(estimate.wall_hours or 0.0, _TIMES),
        _scaled(estimate.bytes or 0.0, _SIZES),
        f"{one.published} of {2 * one.sample}",
    )


def _scaled(value: float, units: tuple[tuple[float, str], ...]) -> str:
    """Write with the largest unit that gives a number from 1 on."""
    size, unit = next((one for one in units if value >= one[0]), units[-1])
    return f"{value / size:.3g} {unit}"

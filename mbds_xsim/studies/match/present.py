"""Matched settings of a scene as a report."""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.base.counted import counted
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column, Remarks, Report, table_of
from mbds_xsim.studies.match.search import Found, Match

_COLUMNS = (
    "engine",
    "method",
    ">step",
    Column("cost", "Wall time per simulated second and trajectory"),
    Column("err 1 s", "Worst RMS particle error at 1 s over the low and medium starts"),
    Column("gap", "Worst distance between the anchor points of a joint"),
    Column("energy", "Worst energy balance over the energy scale"),
    Column("until now", "The settings in use before", words=True),
    Column("×", "Processor time over that of the settings until now"),
    "",
)


def present(match: Match) -> Report:
    """Say who keeps the budgets, and at what cost."""
    met = all(found.meets_budget for found in match.engines)
    return Report(
        title=match.scene,
        what="within budgets" if met else "budgets missed",
        conclusion=_conclusion(match),
        blocks=(
            table_of(_COLUMNS, map(_row, match.engines), note=_figures_of(match)),
            Remarks.of(_remarks(match)),
        ),
        command=match.command,
        made=match.machine,
        verdict="pass" if met else "fail",
    )


def _conclusion(match: Match) -> str:
    """Say in one sentence who keeps the budgets, and who does so at the least cost."""
    met = [found for found in match.engines if found.meets_budget]
    missed = [found.engine for found in match.engines if not found.meets_budget]
    if not met:
        return "no engine keeps all budgets"
    best = min(met, key=lambda found: found.wall_per_simulated_s)
    but = f"; not {', '.join(missed)}" if missed else ""
    return (
        f"{len(met)} of {counted(len(match.engines), 'engine')} within all budgets{but}; cheapest "
        f"is {best.engine} {best.method} at {quantity.span(best.step_s)}, "
        f"{quantity.span(best.wall_per_simulated_s)} a simulated second"
    )


def _row(found: Found) -> tuple[Cell | str, ...]:
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
        Cell("holds", "pass") if found.meets_budget else Cell("misses", "fail"),
    )


def _remarks(match: Match) -> Iterator[tuple[str, str]]:
    """Give options that were found, what fails where a budget is not met, and who is left out."""
    for found in match.engines:
        if found.options:
            options = ", ".join(f"{key} = {value}" for key, value in found.options.items())
            yield found.engine, options
        if not found.meets_budget:
            yield f"{found.engine}, the best it does", found.reasons[0]
    yield from (("left out", reason) for reason in match.left_out.values())


def _figures_of(match: Match) -> str:
    return (
        f"figures of {match.held_out} held-out starts of each interval (seed "
        f"{match.held_out_seed}); searched with {match.trajectories} (seed {match.seed})"
    )

"""What a search for settings found, for terminal and page alike."""

from __future__ import annotations

from mbds_xsim.counted import counted
from mbds_xsim.report import quantity
from mbds_xsim.study.match import Found, Match

__all__ = ["HEADINGS", "WORDS", "cells", "conclusion", "figures_of", "left_out", "remarks"]

HEADINGS = ("engine", "method", "step", "cost", "err 1 s", "gap", "energy", "until now", "×", "")
WORDS = (0, 1, 7, 9)
"""Columns of words."""


def conclusion(match: Match) -> str:
    """Say in one sentence who keeps the budgets, and who does so at the least cost."""
    met = [found for found in match.engines if found.meets_budget]
    missed = [found.engine for found in match.engines if not found.meets_budget]
    if not met:
        return f"{match.scene}: no engine keeps all budgets"
    best = min(met, key=lambda found: found.wall_per_simulated_s)
    cost = quantity.span(best.wall_per_simulated_s)
    who = ", ".join(missed)
    but = f"; not {who}" if missed else ""
    return (
        f"{match.scene}: {len(met)} of {counted(len(match.engines), 'engine')} within all budgets"
        f"{but}; cheapest is {best.engine} {best.method} at {quantity.span(best.step_s)}, "
        f"{cost} a simulated second"
    )


def cells(found: Found) -> tuple[str, ...]:
    """Give an engine's row."""
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
        "✓" if found.meets_budget else "✗",
    )


def remarks(match: Match) -> list[tuple[str, str]]:
    """Give options that were found, and what fails where a budget is not met, by engine."""
    found: list[tuple[str, str]] = []
    for engine in match.engines:
        if engine.options:
            options = ", ".join(f"{key} = {value}" for key, value in engine.options.items())
            found.append((engine.engine, options))
        if not engine.meets_budget:
            found.append((f"{engine.engine}, the best it does", engine.reasons[0]))
    return found


def left_out(match: Match) -> list[tuple[str, str]]:
    """Give who cannot do the scene, and why."""
    return [("left out", reason) for reason in match.left_out.values()]


def figures_of(match: Match) -> str:
    """Say what the figures are of."""
    return (
        f"figures of {match.held_out} held-out starts of each interval (seed "
        f"{match.held_out_seed}); searched with {match.trajectories} (seed {match.seed}); × is "
        "the processor time over that of the settings until now"
    )

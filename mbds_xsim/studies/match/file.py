"""Matched settings, with the figures they gave, as a file for `mbds_xsim.simulate.choice`."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

import tomli_w

from mbds_xsim.base.errors import InputError
from mbds_xsim.studies.match.search import Found, Match

_HEAD = """\
# Settings whose trajectories are published: the cheapest of each engine that keep all budgets of
# the scene on {held_out} held-out starts of each interval. Found by
# {command}
# on {machine}. `found` has the figures of the held-out trajectories.

"""


def stored_path(scene: str) -> Path:
    """Say where the settings of a built-in scene stand."""
    return Path(str(files("mbds_xsim_scenes"))) / "matched" / f"{scene}.toml"


def matched_toml(match: Match, before: str = "") -> str:
    """Give the file; engines that were not searched keep what the file had before.

    Raises:
        InputError: What was there before cannot be read.
    """
    try:
        tables: dict[str, Any] = tomllib.loads(before)
    except tomllib.TOMLDecodeError as error:
        msg = f"the settings that are there cannot be read ({error}); name another file with --out"
        raise InputError(msg) from error
    tables |= {found.engine: _table(found) for found in match.engines}
    head = _HEAD.format(
        held_out=match.held_out, command=" ".join(match.command.split()), machine=match.machine
    )
    return head + tomli_w.dumps(tables)


def _table(found: Found) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "method": found.method,
        "steps_per_frame": found.steps_per_frame,
    }
    if found.options:
        settings["options"] = dict(found.options)
    figures = {
        "version": found.version,
        "meets_budget": found.meets_budget,
        "reason": found.reasons[0] if found.reasons else None,
        "trajectories": found.held_out,
        "wall_per_simulated_s": _short(found.wall_per_simulated_s),
        "error_1s_m": _short(found.error_1s_m),
        "error_weighted_m": _short(found.error_weighted_m),
        "constraint_gap_m": _short(found.constraint_gap_m),
        "energy_balance": _short(found.energy_balance),
    }
    return settings | {"found": {key: value for key, value in figures.items() if value is not None}}


def _short(value: float | None) -> float | None:
    """Three digits are all that such a figure has."""
    return None if value is None else float(f"{value:.3g}")

"""Matched settings: as they are stored with the figures that they gave, and as a report."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import read_file
from mbds_xsim.base.text import counted
from mbds_xsim.measure.result import FIGURES
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Cell, Column, Remarks, Report, table_of

SCHEMA = "mbds-xsim/match/1"


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """What the search found for one engine."""

    engine: str
    version: str
    method: str
    steps_per_frame: int
    step_s: float
    options: dict[str, float | int | bool | str]
    meets_budget: bool
    """On the held-out trajectories; else these settings are the best it does."""
    reasons: tuple[str, ...]
    """What fails, where the budget is not met."""
    held_out: int
    """Trajectories that were not searched with."""
    wall_per_simulated_s: float
    cpu_per_simulated_s: float
    error_1s_m: float | None
    error_weighted_m: float | None
    constraint_gap_m: float | None
    energy_balance: float | None
    used_method: str
    """Of the settings in use until now."""
    used_steps_per_frame: int
    cost_ratio: float | None
    """Processor time over that of the settings in use, on the trajectories of the search; None
    where those failed or these were not tried there."""
    trials: int


class Match(msgspec.Struct, frozen=True, kw_only=True):
    """Matched settings of a scene."""

    schema: str
    scene: str
    command: str
    seed: int
    held_out_seed: int
    trajectories: int
    """Starts of each interval that were searched with."""
    held_out: int
    """Starts of each interval that were held out."""
    machine: str
    engines: tuple[Found, ...]
    left_out: dict[str, str]
    fingerprint: str = ""
    """Stands for the scene's physics and starts; empty in results of earlier versions."""


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
    note = (
        f"figures of {counted(match.held_out, 'held-out start')} of each interval (seed "
        f"{match.held_out_seed}); searched with {match.trajectories} (seed {match.seed})"
    )
    return Report(
        title=match.scene,
        what="within budgets" if met else "budgets missed",
        conclusion=_conclusion(match),
        blocks=(
            table_of(_COLUMNS, map(_row, match.engines), note=note),
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


_HEAD = """\
# Settings whose trajectories are published: the cheapest of each engine that keep all budgets of
# the scene on {held_out} of each interval. Found by
# {command}
# on {machine}. `found` has the figures of the held-out trajectories.

"""


def stored_path(scene: str) -> Path:
    """Say where the settings of a built-in scene stand."""
    return Path(str(files("mbds_xsim_scenes"))) / "matched" / f"{scene}.toml"


def settings_there(path: Path) -> str:
    """Read the file that settings are to be written to; "" where there is none.

    Raises:
        InputError: It is no file of settings, and would be lost.
    """
    try:
        text = read_file(path).decode() if path.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        msg = f"--out: {path} is there and cannot be read ({error}); name another file"
        raise InputError(msg) from error
    _tables_of(text)
    return text


def _tables_of(text: str) -> dict[str, Any]:
    try:
        tables: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        msg = f"the settings that are there cannot be read ({error}); name another file with --out"
        raise InputError(msg) from error
    for key, table in tables.items():
        if key != "name" and not (isinstance(table, dict) and "method" in table):
            msg = f"what is there is no file of settings: it has {key!r}; name another with --out"
            raise InputError(msg)
    return tables


def matched_toml(match: Match, before: str = "") -> str:
    """Give the file; engines that were not searched keep what the file had before.

    Raises:
        InputError: What was there before cannot be read.
    """
    tables = _tables_of(before)
    tables |= {found.engine: _table(found) for found in match.engines}
    head = _HEAD.format(
        held_out=counted(match.held_out, "held-out start"),
        command=" ".join(match.command.split()),
        machine=match.machine,
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
        **{name: _short(getattr(found, name)) for name in FIGURES},
    }
    return settings | {"found": {key: value for key, value in figures.items() if value is not None}}


def _short(value: float | None) -> float | None:
    """Three digits are all that such a figure has."""
    return None if value is None else float(f"{value:.3g}")

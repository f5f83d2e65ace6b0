"""Matched settings, as stored with their figures, and as a report."""

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


class MatchedSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that the search found for one engine, with their figures."""

    engine: str
    version: str
    method: str
    steps_per_frame: int
    step_s: float
    options: dict[str, float | int | bool | str]
    meets_budget: bool
    """Whether the held-out trajectories keep all budgets; if not, nothing better was found."""
    reasons: tuple[str, ...]
    """Failures, if the budget is not met."""
    held_out: int
    """Number of trajectories that the search did not use."""
    wall_per_simulated_s: float
    cpu_per_simulated_s: float
    error_1s_m: float | None
    error_weighted_m: float | None
    constraint_gap_m: float | None
    energy_balance: float | None
    used_method: str
    """Method of the settings in use before the search."""
    used_steps_per_frame: int
    cost_ratio: float | None
    """Processor time over that of the settings in use, on the trajectories of the search; None if
    the settings in use failed there or the new ones were not tried there."""
    trials: int


class Match(msgspec.Struct, frozen=True, kw_only=True):
    """Matched settings of a scene."""

    schema: str
    scene: str
    command: str
    seed: int
    held_out_seed: int
    trajectories: int
    """Number of starts per interval that the search used."""
    held_out: int
    """Number of starts per interval that were held out; 0 if the scene has only one start."""
    machine: str
    engines: tuple[MatchedSettings, ...]
    left_out: dict[str, str]
    fingerprint: str = ""
    """Hash of the scene's physics and starts; empty in results of earlier versions."""


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
    """Report which engines keep the budgets, and at what cost."""
    met = all(result.meets_budget for result in match.engines)
    note = f"figures of {_verified_on(match)}"
    if match.held_out:
        note += (
            f" (seed {match.held_out_seed}); searched with {match.trajectories} (seed {match.seed})"
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


def _verified_on(match: Match) -> str:
    if not match.held_out:
        return "the only start, with which the search was made"
    return f"{counted(match.held_out, 'held-out start')} of each interval"


def _conclusion(match: Match) -> str:
    """Summarise in one sentence which engines keep the budgets, and which is the cheapest."""
    met = [result for result in match.engines if result.meets_budget]
    missed = [result.engine for result in match.engines if not result.meets_budget]
    if not met:
        return "no engine keeps all budgets"
    best = min(met, key=lambda result: result.wall_per_simulated_s)
    rest = f"; not {', '.join(missed)}" if missed else ""
    return (
        f"{len(met)} of {counted(len(match.engines), 'engine')} within all budgets{rest}; cheapest "
        f"is {best.engine} {best.method} at {quantity.span(best.step_s)}, "
        f"{quantity.span(best.wall_per_simulated_s)} a simulated second"
    )


def _row(result: MatchedSettings) -> tuple[Cell | str, ...]:
    return (
        result.engine,
        result.method,
        quantity.span(result.step_s),
        quantity.span(result.wall_per_simulated_s),
        quantity.length(result.error_1s_m),
        quantity.length(result.constraint_gap_m),
        quantity.number(result.energy_balance),
        f"{result.used_method}, {result.used_steps_per_frame} a frame",
        quantity.number(result.cost_ratio),
        Cell("holds", "pass") if result.meets_budget else Cell("misses", "fail"),
    )


def _remarks(match: Match) -> Iterator[tuple[str, str]]:
    """Yield the options found, the first failure where a budget is missed, and engines left out."""
    for result in match.engines:
        if result.options:
            options = ", ".join(f"{key} = {value}" for key, value in result.options.items())
            yield result.engine, options
        if not result.meets_budget:
            yield f"{result.engine}, the best it does", result.reasons[0]
    yield from (("left out", reason) for reason in match.left_out.values())


_HEAD = """\
# Settings whose trajectories are published: the cheapest of each engine that keep all budgets of
# the scene on {verified_on}. Found by
# {command}
# on {machine}. `found` has the figures of these trajectories.

"""


def stored_path(scene: str) -> Path:
    """Return the path of the matched settings of a built-in scene."""
    return Path(str(files("mbds_xsim_scenes"))) / "matched" / f"{scene}.toml"


def settings_there(path: Path) -> str:
    """Read the file to which settings will be written; "" if there is none.

    Raises:
        InputError: The file is unreadable or not one of settings; it must not be overwritten.
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
    """Return the file's text; engines that were not searched keep their settings in `before`.

    Raises:
        InputError: `before` is no file of settings.
    """
    tables = _tables_of(before)
    tables |= {result.engine: _table(result) for result in match.engines}
    head = _HEAD.format(
        verified_on=_verified_on(match),
        command=" ".join(match.command.split()),
        machine=match.machine,
    )
    return head + tomli_w.dumps(tables)


def _table(result: MatchedSettings) -> dict[str, Any]:
    settings: dict[str, Any] = {"method": result.method, "steps_per_frame": result.steps_per_frame}
    if result.options:
        settings["options"] = dict(result.options)
    figures = {
        "version": result.version,
        "meets_budget": result.meets_budget,
        "reason": result.reasons[0] if result.reasons else None,
        "trajectories": result.held_out,
        "wall_per_simulated_s": _short(result.wall_per_simulated_s),
        **{name: _short(getattr(result, name)) for name in FIGURES},
    }
    return settings | {"found": {key: value for key, value in figures.items() if value is not None}}


def _short(value: float | None) -> float | None:
    """Round a figure to three digits, as it has no more significant ones."""
    return None if value is None else float(f"{value:.3g}")

"""Matched settings as they are stored, with the figures that they gave."""

from __future__ import annotations

import msgspec

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

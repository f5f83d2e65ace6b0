"""The part of stored results that is compared, as it stands in their files.

Every figure may be null, as which numbers that are not finite are written; what other versions
wrote besides is passed over.
"""

from __future__ import annotations

import msgspec

__all__ = ["StoredEngine", "StoredFinding", "StoredFound", "StoredMatch", "StoredValidation"]

Options = dict[str, float | int | bool | str]


class StoredFinding(msgspec.Struct, frozen=True):
    """Of `result.FindingResult`."""

    check: str
    unit: str
    figure: float | None
    budget: float | None
    passed: bool
    figures: tuple[float | None, ...]


class StoredEngine(msgspec.Struct, frozen=True):
    """Of `result.EngineResult`."""

    engine: str
    version: str
    profile: str
    method: str
    step_s: float
    options: Options
    verdict: str
    reasons: tuple[str, ...]
    error_max_m: float | None
    agreement_time_s: float | None
    wall_per_simulated_s: float | None
    setup_s: float | None
    coordinates: int | None
    constraints: int | None
    findings: tuple[StoredFinding, ...]
    failures: tuple[str, ...]


class StoredValidation(msgspec.Struct, frozen=True):
    """Of `result.Validation`."""

    scene: str
    command: str
    seed: int
    trajectories: tuple[int, ...]
    length_m: float
    budget: dict[str, float]
    engines: tuple[StoredEngine, ...]
    left_out: dict[str, str]
    versions: dict[str, str]
    machine: str
    fingerprint: str = ""


class StoredFound(msgspec.Struct, frozen=True):
    """Of `match.Found`."""

    engine: str
    version: str
    method: str
    steps_per_frame: int
    step_s: float
    options: Options
    meets_budget: bool
    reasons: tuple[str, ...]
    wall_per_simulated_s: float | None
    cpu_per_simulated_s: float | None
    error_1s_m: float | None
    error_weighted_m: float | None
    constraint_gap_m: float | None
    energy_balance: float | None


class StoredMatch(msgspec.Struct, frozen=True):
    """Of `match.Match`."""

    scene: str
    command: str
    seed: int
    held_out_seed: int
    trajectories: int
    held_out: int
    machine: str
    engines: tuple[StoredFound, ...]
    left_out: dict[str, str]
    fingerprint: str = ""

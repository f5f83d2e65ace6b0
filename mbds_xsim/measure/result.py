"""Results of `validate`: the documented JSON (`docs/validate-json.md`) and the data of pages.

`Validation` holds figures only and is what the JSON file contains. `Evidence` holds the
underlying arrays, for the page's plots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.frame import frame_of
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

S = TypeVar("S", bound=msgspec.Struct)
Verdict = str
"""Verdict: pass, warn or fail."""

SCHEMA = "mbds-xsim/validate/1"


class FindingResult(msgspec.Struct, frozen=True):
    """One check on all trajectories of one engine."""

    check: str
    unit: str
    figure: float
    """Worst figure over the trajectories; NaN is written as null."""
    budget: float | None
    """Budget of the figure; None if it is shown but not judged."""
    passed: bool
    trajectory: int
    """Index of the worst trajectory."""
    frame: int
    where: str
    figures: tuple[float | None, ...]
    """One figure per trajectory; None if missing or not finite."""
    note: str
    """Further observations, such as the uncertainty or the value delivered; empty if none."""


FIGURES = ("error_1s_m", "error_weighted_m", "constraint_gap_m", "energy_balance")
"""Figures of an engine's accuracy, as field names of its result."""


class EngineResult(msgspec.Struct, frozen=True):
    """One engine at one profile of settings: a row of the table."""

    engine: str
    version: str
    profile: str
    method: str
    family: str
    order: int
    step_s: float
    options: dict[str, float | int | bool | str]
    verdict: Verdict
    reasons: tuple[str, ...]
    """One line for each failure or warning, the most informative first."""
    error_1s_m: float | None
    """Worst RMS particle error at 1 s over the low and medium trajectories [m]."""
    error_max_m: float | None
    """Worst RMS particle error over all frames and trajectories, unweighted [m]."""
    error_weighted_m: float | None
    """Largest error / max(1, G) over times with growth G < 100 [m]."""
    constraint_gap_m: float | None
    energy_balance: float | None
    agreement_time_s: float | None
    """Earliest time at which an error passes 1 % of the scene's length; None if never."""
    wall_per_simulated_s: float | None
    """Wall time per simulated second and trajectory, without set-up."""
    setup_s: float | None
    coordinates: int | None
    constraints: int | None
    findings: tuple[FindingResult, ...]
    failures: tuple[str, ...]
    """One line for each trajectory that ended early, or for a crash of the whole engine."""
    rtol: float | None = None
    """Relative tolerance of a method that chooses its steps, which may be as long as `step_s`."""


class ReferenceResult(msgspec.Struct, frozen=True):
    """Accuracy and time of the reference itself."""

    rtol: float
    constraint_gap_m: float
    energy_balance: float
    cached: int
    """Number of trajectories that came from the cache."""
    wall_s: float
    known_s: tuple[float | None, ...] = ()
    """Time of the first impact without a unique solution, per trajectory [s]; None if none."""


class EnsembleResult(msgspec.Struct, frozen=True):
    """Two engine results (or the reference) as samples of distributions; shown, not judged."""

    one: str
    other: str
    time_s: float
    """Time of the comparison [s]."""
    distance: float
    """Energy distance relative to its largest possible value, 0 to 1."""
    p_value: float
    """Probability of at least this distance if both are samples of one distribution."""
    count: int
    """Number of trajectories that both have."""


class Validation(msgspec.Struct, frozen=True):
    """Complete result of a validation, as written to JSON."""

    schema: str
    scene: str
    description: str
    verdict: Verdict
    wall_s: float
    command: str
    seed: int
    trajectories: tuple[int, ...]
    """Indices of the trajectories; index i has interval i mod 3 of low, medium, high."""
    length_m: float
    budget: dict[str, float]
    engines: tuple[EngineResult, ...]
    left_out: dict[str, str]
    """Engines that cannot simulate the scene, each with the reason."""
    reference: ReferenceResult | None
    names: tuple[str, ...]
    """Rows and columns of `matrix_m`: engine results in order, then the reference."""
    matrix_m: tuple[tuple[float, ...], ...]
    """Pairwise RMS particle distance at `matrix_s`, worst over low and medium trajectories [m]."""
    odd_one_out: str | None
    """The entry that stands apart from all other method families, if one does."""
    versions: dict[str, str]
    machine: str
    matrix_s: float = 1.0
    """Time of the comparison in `matrix_m`: 1, or the last frame before it [s]."""
    ensembles: tuple[EnsembleResult, ...] = ()
    """Pairs that no longer agree at the end, with 20 trajectories or more."""
    fingerprint: str = ""
    """Fingerprint of the scene's physics and starts; empty in results of earlier versions."""
    spent_s: dict[str, float] = {}
    """Elapsed time of all processes by purpose [s]: engines, reference, its compiler, the search,
    checks, and the start of processes with all their imports."""

    def to_frame(self) -> Any:
        """Return a `pandas.DataFrame` with one row per engine and settings."""
        return frame_of(self.engines)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Arrays behind a validation, with engine results in the order of `Validation.engines`."""

    scene: Scene
    batch: Batch
    trajectories: tuple[Trajectory | None, ...]
    """One trajectory per engine result; None if the engine crashed."""
    reference: Trajectory
    growth: Array
    """Sensitivity G, shape (trajectory, frame)."""
    errors: tuple[Array | None, ...]
    """RMS particle error of each engine result [m], shape (trajectory, frame)."""
    series: tuple[dict[str, Array], ...]
    """Series (trajectory, frame) by check, per engine result; budgets are in the findings."""


def from_plain(value: Any, kind: type[S]) -> S:
    """Make a result from decoded JSON, in which non-finite numbers are null.

    Raises:
        msgspec.ValidationError: The data does not fit the type.
    """
    return msgspec.convert(_with_nan(value, kind), kind)


def _with_nan(value: Any, kind: Any) -> Any:
    """Replace null by NaN where a type allows only numbers."""
    if value is None:
        return math.nan if kind is float else None
    if isinstance(value, list):
        inner = (get_args(kind) or (None,))[0]
        return [_with_nan(item, inner) for item in value]
    if isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        hints = get_type_hints(kind)
        return {key: _with_nan(item, hints.get(key)) for key, item in value.items()}
    return value

"""What `validate` found: the documented JSON (`docs/validate-json.md`) and what pages are made of.

`Validation` holds figures only and is what the JSON file contains. `Evidence` holds the arrays
behind them, for the page's plots.
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
"""pass, warn or fail."""

SCHEMA = "mbds-xsim/validate/1"


class FindingResult(msgspec.Struct, frozen=True):
    """One check on all trajectories of one engine."""

    check: str
    unit: str
    figure: float
    """Worst over the trajectories; NaN is written as null."""
    budget: float | None
    """None: shown, not judged."""
    passed: bool
    trajectory: int
    """Index of the worst trajectory."""
    frame: int
    where: str
    figures: tuple[float | None, ...]
    """One a trajectory; None where there is none, or it is not finite."""
    note: str
    """What else the check saw: how much it resolves, what was delivered; empty where nothing."""


FIGURES = ("error_1s_m", "error_weighted_m", "constraint_gap_m", "energy_balance")
"""Figures of an engine's accuracy, as fields of its result."""


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
    """One line for each thing that failed or warned, most telling first."""
    error_1s_m: float | None
    """Worst RMS particle error at 1 s over the low and medium trajectories [m]."""
    error_max_m: float | None
    """Worst RMS particle error over all frames and trajectories, undivided [m]."""
    error_weighted_m: float | None
    """Worst of error / max(1, G) over times with growth G < 100 [m]."""
    constraint_gap_m: float | None
    energy_balance: float | None
    agreement_time_s: float | None
    """Earliest time at which an error passes 1 % of the scene's length; None: never."""
    wall_per_simulated_s: float | None
    """Wall time per simulated second and trajectory, set-up apart."""
    setup_s: float | None
    coordinates: int | None
    constraints: int | None
    findings: tuple[FindingResult, ...]
    failures: tuple[str, ...]
    """One line for each trajectory that ended early, or for a crash of the whole engine."""
    rtol: float | None = None
    """Relative tolerance of a method that chooses its steps; they may go over a whole `step_s`."""


class ReferenceResult(msgspec.Struct, frozen=True):
    """How good the reference itself is."""

    rtol: float
    constraint_gap_m: float
    energy_balance: float
    cached: int
    """Trajectories that came from the cache."""
    wall_s: float
    known_s: tuple[float | None, ...] = ()
    """First impact that leaves no unique solution, one a trajectory [s]; None: no such one."""


class EnsembleResult(msgspec.Struct, frozen=True):
    """Two engine results (or the reference) as samples of distributions; shown, not judged."""

    one: str
    other: str
    time_s: float
    """Instant that is compared [s]."""
    distance: float
    """Energy distance over its largest possible value, 0 to 1."""
    p_value: float
    """Probability of so large a distance if both are draws of one distribution."""
    count: int
    """Trajectories that both have."""


class Validation(msgspec.Struct, frozen=True):
    """The whole of a validation, as written to JSON."""

    schema: str
    scene: str
    description: str
    verdict: Verdict
    wall_s: float
    command: str
    seed: int
    trajectories: tuple[int, ...]
    """Indices that were drawn; index i has the interval low, medium, high of i mod 3."""
    length_m: float
    budget: dict[str, float]
    engines: tuple[EngineResult, ...]
    left_out: dict[str, str]
    """Engines that cannot do the scene, each with the reason."""
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
    """1, or the last frame before it [s]."""
    ensembles: tuple[EnsembleResult, ...] = ()
    """Pairs that no longer agree at the end, with 20 trajectories or more."""
    fingerprint: str = ""
    """Stands for the scene's physics and starts; empty in results of earlier versions."""
    spent_s: dict[str, float] = {}
    """Where the time went, in seconds of processes: engines, the reference, its compiler, the
    search of settings, checks, and the start of processes with all that they import."""

    def to_frame(self) -> Any:
        """Give a `pandas.DataFrame` with a row for each engine at each settings."""
        return frame_of(self.engines)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Arrays behind a validation. Engine results by their place in `Validation.engines`."""

    scene: Scene
    batch: Batch
    trajectories: tuple[Trajectory | None, ...]
    """One an engine result; None where the engine crashed."""
    reference: Trajectory
    growth: Array
    """Sensitivity G, shape (trajectory, frame)."""
    errors: tuple[Array | None, ...]
    """RMS particle error of each engine result [m], shape (trajectory, frame)."""
    series: tuple[dict[str, Array], ...]
    """Per engine result: check name to series (trajectory, frame), budgets in the findings."""


def from_plain(what: Any, kind: type[S]) -> S:
    """Make a result of decoded JSON, in which numbers that are not finite are null.

    Raises:
        msgspec.ValidationError: It is something else.
    """
    return msgspec.convert(_with_nan(what, kind), kind)


def _with_nan(what: Any, kind: Any) -> Any:
    """Put NaN for null where a type has numbers only."""
    if what is None:
        return math.nan if kind is float else None
    if isinstance(what, list):
        inner = (get_args(kind) or (None,))[0]
        return [_with_nan(one, inner) for one in what]
    if isinstance(what, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        hints = get_type_hints(kind)
        return {key: _with_nan(one, hints.get(key)) for key, one in what.items()}
    return what

"""What `ablate` finds: from changes of motion to verdicts, and how large a model must be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks import agreement
from mbds_xsim.measure.result import Evidence
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.constraints import constraint_rows, degrees_of_freedom, dense_jacobian
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Settings
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.studies.ablate.effects import Effect

SCHEMA = "mbds-xsim/ablate/1"

Need = Literal["needed", "not needed", "not resolvable", "not possible"]
"""The change is above the floor, or where engines have parted clearly above their distance; below
the floor; not to be told, as motions can be compared, or last, for less than 1 s; there is no such
scene, start or simulation."""


class Floor(msgspec.Struct, frozen=True):
    """What a change must exceed: the engines' own disagreement, or the budget if that is larger."""

    disagreement_1s_m: float | None
    """Largest RMS particle distance of two engines at 1 s, low and medium starts [m]; None where
    motions cannot be compared for so long."""
    disagreement_m: float
    """The same over all starts and judged frames, over max(1, growth) [m]."""
    budget_1s_m: float
    budget_m: float

    @property
    def at_1s(self) -> float:
        """What a change at 1 s must exceed [m]."""
        return max(self.disagreement_1s_m or 0.0, self.budget_1s_m)

    @property
    def overall(self) -> float:
        """What a growth-weighted change must exceed [m]."""
        return max(self.disagreement_m, self.budget_m)


class WeakenedEffect(msgspec.Struct, frozen=True):
    """One effect, dropped or halved."""

    effect: str
    factor: float
    """0: dropped, 0.5: halved."""
    left: str
    """What is left without the effect."""
    verdict: Need
    sentence: str
    change_1s_m: float | None = None
    """RMS particle change at 1 s, worst of the low and medium starts [m]."""
    change_1s_median_m: float | None = None
    change_m: float | None = None
    """Largest RMS particle change over max(1, growth), worst of the starts [m]."""
    change_median_m: float | None = None
    over_floor: float | None = None
    """The larger of the two changes over its floor."""
    over_disagreement: float | None = None
    """The larger of the two changes over the engines' disagreement."""


class Size(msgspec.Struct, frozen=True):
    """The native model of one engine, and what it has more than the scene needs."""

    engine: str
    coordinates: int
    """Velocity coordinates."""
    constraints: int
    contact_pairs: int
    more_coordinates: int
    """Beyond joint coordinates (in the plane, beyond the degrees of freedom)."""
    more_constraints: int
    """Beyond the independent conditions of closed loops."""
    more_pairs: int
    """Beyond contact spheres."""


class Ablation(msgspec.Struct, frozen=True, kw_only=True):
    """A scene's effects."""

    schema: str = SCHEMA
    scene: str
    description: str
    judge: str
    """What simulated both scenes: the reference, or an engine with its method and step."""
    judged_s: tuple[float, float]
    """Shortest and longest time over which a start was compared [s]."""
    ends: str
    """What ends the comparison before the last frame; empty where nothing does."""
    duration_s: float
    length_m: float
    floor: Floor
    floor_engines: tuple[str, ...]
    """Engines whose disagreement is the floor."""
    failed: dict[str, str]
    """Engines that failed on these starts, with the first reason; they are no part of the floor
    unless fewer than two pass."""
    left_out: dict[str, str]
    """Engines that cannot do the scene, with the reason."""
    rows: tuple[WeakenedEffect, ...]
    degrees_of_freedom: int
    joint_coordinates: int
    """Fewest coordinates of a model that opens closed loops."""
    loop_conditions: int
    """Independent conditions that close them."""
    contact_spheres: int
    sizes: tuple[Size, ...]
    trajectories: tuple[int, ...]
    seed: int
    versions: dict[str, str]
    machine: str
    command: str
    wall_s: float


_INSTANT = 1.0
_APART = 0.01  # of the scene's length, as for the agreement time


@dataclass(frozen=True, eq=False)
class Window:
    """Over which frames of each start changes are judged, and how."""

    judged: Mask
    """Shape (start, frame)."""
    weight: Array
    """What changes are divided by, max(1, growth); shape (start, frame)."""
    time: Array
    apart: Array
    """Largest distance of two engines [m], shape (start, frame)."""
    regular: Mask
    """Starts that are judged at 1 s: all but those of the high interval, shape (start,)."""
    ends: str
    """What ends the comparison before the last frame; empty where nothing does."""

    @property
    def spans(self) -> Array:
        """Time over which each start is compared [s], shape (start,)."""
        return np.asarray(self.time[self.judged.sum(axis=1) - 1])

    @property
    def reaches(self) -> bool:
        """Whether any start is compared for 1 s, or all of a shorter scene."""
        return bool(self.spans.max() >= min(_INSTANT, self.time[-1]) * (1 - 1e-9))

    def at_instant(self, error: Array) -> Array:
        """Give errors at 1 s [m] of the regular starts that are judged there, shape (any,)."""
        frame = int(np.argmin(np.abs(self.time - _INSTANT)))
        if abs(self.time[frame] - _INSTANT) > 1e-9:
            return np.zeros(0)
        return np.asarray(error[self.regular & self.judged[:, frame], frame])

    @property
    def frames(self) -> int:
        """Frames that are looked at: all that are judged, and the first second."""
        second = int(np.searchsorted(self.time, _INSTANT * (1 - 1e-9)))
        return min(max(int(self.judged.sum(axis=1).max()), second + 1), len(self.time))

    def beyond(self, error: Array) -> float:
        """Give the errors over the engines' distance at 1 s, whether judged or not: the median."""
        frame = min(int(np.searchsorted(self.time, _INSTANT * (1 - 1e-9))), len(self.time) - 1)
        known = np.isfinite(error[:, frame]) & (self.apart[:, frame] > 0)
        ratio = error[known, frame] / self.apart[known, frame]
        return float(np.median(ratio)) if ratio.size else 0.0

    def weighted(self, error: Array) -> Array:
        """Give the largest weighted error of each start over the judged frames [m], (start,)."""
        return np.asarray(np.nanmax(np.where(self.judged, error / self.weight, 0.0), axis=1))


def window_of(evidence: Evidence, apart: Array) -> Window:
    """Settle where motions can be compared.

    With a reference to the end: as long as disturbances grow less than a hundredfold. Where
    contact leaves no unique solution: until the engines are 1 % of the scene's length apart.
    """
    known = evidence.reference.known
    growth = np.where(np.isfinite(evidence.growth), evidence.growth, 1.0)
    calm, ends = growth < agreement.CHAOS, "chaos"
    if not known.all():
        calm &= apart <= _APART * evidence.scene.length
        ends = "engines part by 1 % of the length in contact"
    judged = np.logical_and.accumulate(calm, axis=1)
    interval = [evidence.batch.interval(row) for row in range(len(evidence.batch))]
    return Window(
        judged=judged,
        weight=np.maximum(1.0, growth),
        time=evidence.reference.time,
        apart=apart,
        regular=np.array([name != "high" for name in interval]),
        ends="" if judged.all() else ends,
    )


def disagreement(scene: Scene, runs: list[Trajectory]) -> Array:
    """Compute the largest RMS particle distance of two runs [m], shape (start, frame).

    Where a run has ended it no longer counts; 0 where fewer than two are left.
    """
    mechanism = Mechanism.of(scene)
    pairs = [agreement.particle_error(mechanism, *pair) for pair in combinations(runs, 2)]
    if not pairs:
        return np.zeros((len(runs[0]), len(runs[0].time)))
    return np.asarray(np.max(np.nan_to_num(pairs, nan=0.0), axis=0))


def floor_of(scene: Scene, window: Window, apart: Array) -> Floor:
    """Give what a change must exceed."""
    at_one = window.at_instant(apart)
    return Floor(
        disagreement_1s_m=float(at_one.max()) if at_one.size else None,
        disagreement_m=float(window.weighted(apart).max()),
        budget_1s_m=scene.budget.error_1s * scene.length,
        budget_m=scene.budget.error * scene.length,
    )


_CLEARLY = 3.0
"""A change so many times the engines' distance shows even where these have parted."""


def row_of(
    effect: Effect, factor: float, change: Array, window: Window, floor: Floor, lost: str
) -> WeakenedEffect:
    """Hold a change to the floor.

    Args:
        effect: What was weakened.
        factor: How much of it was left.
        change: RMS particle change [m], shape (start, frame); NaN where a run had ended.
        window: Where it is judged.
        floor: What it must exceed.
        lost: Why the ablated runs ended early; empty where none did.
    """
    at_one, weighted = window.at_instant(change), window.weighted(change)
    at_one = at_one[np.isfinite(at_one)]
    worst_one = float(at_one.max()) if at_one.size else None
    worst = float(weighted.max())
    excess = max(worst / floor.overall, (worst_one or 0.0) / floor.at_1s)
    apart = max(
        _over(worst, floor.disagreement_m), _over(worst_one or 0.0, floor.disagreement_1s_m)
    )
    beyond, seen = window.beyond(change), np.isfinite(change)
    seen[:, 0] = True
    known = replace(window, judged=window.judged & seen)
    verdict = _verdict(excess, beyond, known)
    told = _sentence(verdict, excess, apart, beyond, window)
    if verdict == "not resolvable" and window.reaches:
        told = f"{_share(excess)} until what is left without it ends"
    return WeakenedEffect(
        effect=effect.name,
        factor=factor,
        left=effect.dropped,
        verdict=verdict,
        sentence="; ".join(filter(None, (told, lost))),
        change_1s_m=worst_one,
        change_1s_median_m=float(np.median(at_one)) if at_one.size else None,
        change_m=worst,
        change_median_m=float(np.median(weighted)),
        over_floor=excess,
        over_disagreement=apart if np.isfinite(apart) else None,
    )


def impossible(effect: Effect, factor: float, reason: str) -> WeakenedEffect:
    """Give the row of an effect that this scene cannot be without."""
    return WeakenedEffect(effect.name, factor, effect.dropped, "not possible", reason)


def _over(change: float, disagreement: float | None) -> float:
    if not change or disagreement is None:
        return 0.0
    return change / disagreement if disagreement else np.inf


def _verdict(excess: float, beyond: float, window: Window) -> Need:
    if excess > 1.0 or (not window.reaches and beyond > _CLEARLY):
        return "needed"
    return "not needed" if window.reaches else "not resolvable"


def _sentence(verdict: Need, excess: float, apart: float, beyond: float, window: Window) -> str:
    if excess > 1.0:
        return f"motion changes by {_told(excess)} × the floor"
    share = _share(excess)
    if not window.reaches:
        instant = min(_INSTANT, float(window.time[-1]))
        past = f"{share} until {window.ends}; {_told(beyond)} × their distance at {instant:g} s"
        return past if verdict == "needed" else f"{past}, clear is {_CLEARLY:g} ×"
    return f"{share}, though {_told(apart)} × what engines differ by" if apart > 1.0 else share


def _share(excess: float) -> str:
    return f"{_told(excess)} of the floor" if excess else "no change"


def _told(ratio: float) -> str:
    return f"{ratio:.0f}" if 10 <= ratio < 1e4 else f"{ratio:.2g}"


_FREEDOMS = {"fixed": 0, "hinge": 1, "slider": 1, "ball": 3}
_FREE = 6
_IN_LINE, _IN_PLANE = (0, 4), (0, 2, 4)
"""Coordinates of a body that moves along x and rolls, or in x and z and turns about y."""


@dataclass(frozen=True)
class Least:
    """The smallest model of a scene."""

    degrees_of_freedom: int
    coordinates: int
    """Of the spanning tree; in one and two dimensions the degrees of freedom."""
    conditions: int
    """Independent conditions of the loops."""
    spheres: int


def least_size(scene: Scene) -> Least:
    """Count what a model cannot do without."""
    mechanism = Mechanism.of(scene)
    if scene.dimension < 3:
        freedom = _planar_freedom(mechanism, _IN_LINE if scene.dimension == 1 else _IN_PLANE)
        return Least(freedom, freedom, 0, count_pairs(mechanism))
    freedom = degrees_of_freedom(mechanism)
    tree = [link.joint for link in mechanism.links]
    coordinates = sum(_FREE if joint is None else _FREEDOMS[joint.kind] for joint in tree)
    return Least(freedom, coordinates, coordinates - freedom, count_pairs(mechanism))


def native_size(scene: Scene, engine: str, settings: Settings) -> ModelSize:
    """Load a scene and tell the size of the engine's model."""
    with load_adapter(engine).open(scene, settings) as run:
        return run.size


def compared(engine: str, size: ModelSize, least: Least) -> Size:
    """Tell what a model has more than the smallest."""
    return Size(
        engine=engine,
        coordinates=size.coordinates,
        constraints=size.constraints,
        contact_pairs=size.contact_pairs,
        more_coordinates=size.coordinates - least.coordinates,
        more_constraints=size.constraints - least.conditions,
        more_pairs=size.contact_pairs - least.spheres,
    )


def _planar_freedom(mechanism: Mechanism, moving: tuple[int, ...]) -> int:
    """Degrees of freedom at the reference pose of bodies that move in some coordinates only."""
    count = mechanism.body_count
    still = np.zeros((count, 3))
    native = np.broadcast_to(rotation.IDENTITY, (count, 4))
    rows = constraint_rows(mechanism, mechanism.com, native, still, still)
    if not len(rows.parent):
        return len(moving) * count
    columns = [6 * body + k for body in range(count) for k in moving]
    jacobian = dense_jacobian(rows, count)[:, columns]
    return len(columns) - int(np.linalg.matrix_rank(jacobian, rtol=1e-9))

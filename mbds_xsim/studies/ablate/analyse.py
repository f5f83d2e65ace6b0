"""Results of `ablate`: verdicts on changes of motion, and the size that a model needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.isolate import Task, run_tasks
from mbds_xsim.checks import agreement
from mbds_xsim.measure.result import Evidence
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.constraints import constraint_rows, degrees_of_freedom, dense_jacobian
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Settings
from mbds_xsim.simulate.choice import Contender
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import size_of
from mbds_xsim.studies.ablate.effects import Effect

SCHEMA = "mbds-xsim/ablate/1"

Need = Literal["needed", "not needed", "not resolvable", "not possible"]
"""Verdict on an effect, in this order: its change is above the floor (or clearly above the distance
of engines that have parted); it is below the floor; motions last, or can be compared, for less
than 1 s; there is no such scene, start or simulation."""


class Floor(msgspec.Struct, frozen=True):
    """Threshold of a change: the engines' own disagreement, or the budget if that is larger."""

    disagreement_1s_m: float | None
    """Largest RMS particle distance of two engines at 1 s, low and medium starts [m]; None if
    motions cannot be compared for so long."""
    disagreement_m: float
    """Largest such distance, over max(1, growth), of all starts and judged frames [m]."""
    budget_1s_m: float
    budget_m: float

    @property
    def at_1s(self) -> float:
        """Threshold of a change at 1 s [m]."""
        return max(self.disagreement_1s_m or 0.0, self.budget_1s_m)

    @property
    def overall(self) -> float:
        """Threshold of a growth-weighted change [m]."""
        return max(self.disagreement_m, self.budget_m)


class WeakenedEffect(msgspec.Struct, frozen=True):
    """One effect, dropped or halved."""

    effect: str
    factor: float
    """Remaining share of the effect: 0 if dropped, 0.5 if halved."""
    left: str
    """Description of the model without the effect."""
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
    """Size of one engine's native model, and its excess over what the scene needs."""

    engine: str
    coordinates: int
    """Number of velocity coordinates."""
    constraints: int
    contact_pairs: int
    more_coordinates: int
    """Excess over joint coordinates (in one and two dimensions, over the degrees of freedom)."""
    more_constraints: int
    """Excess over the independent conditions of closed loops."""
    more_pairs: int
    """Excess over the pairs that may touch in the scene."""


class Ablation(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an ablation: the effects of one scene."""

    schema: str = SCHEMA
    scene: str
    description: str
    judge: str
    """Simulator of both scenes: the reference, or an engine with its method and step."""
    judged_s: tuple[float, float]
    """Shortest and longest time over which a start was compared [s]."""
    ends: str
    """Reason why the comparison ends before the last frame; empty if it does not."""
    duration_s: float
    length_m: float
    floor: Floor
    floor_engines: tuple[str, ...]
    """Engines whose disagreement is the floor."""
    failed: dict[str, str]
    """Engines that failed on these starts, with the first reason; they do not count in the floor
    unless fewer than two pass."""
    left_out: dict[str, str]
    """Engines that cannot simulate the scene, with the reason."""
    rows: tuple[WeakenedEffect, ...]
    degrees_of_freedom: int
    joint_coordinates: int
    """Fewest coordinates of a model that opens closed loops."""
    loop_conditions: int
    """Number of independent conditions that close the loops."""
    contact_spheres: int
    sizes: tuple[Size, ...]
    trajectories: tuple[int, ...]
    seed: int
    versions: dict[str, str]
    machine: str
    command: str
    wall_s: float


_APART = 0.01  # part of the scene's length, as for the agreement time


@dataclass(frozen=True, eq=False)
class Window:
    """Frames of each start in which changes are judged, and their weights."""

    judged: Mask
    """Whether each frame is judged, shape (start, frame)."""
    weight: Array
    """Divisor of changes, max(1, growth), shape (start, frame)."""
    time: Array
    apart: Array
    """Largest distance of two engines [m], shape (start, frame)."""
    regular: Mask
    """Starts that are judged at 1 s: all but those of the high interval, shape (start,)."""
    ends: str
    """Reason why the comparison ends before the last frame; empty if it does not."""

    @property
    def spans(self) -> Array:
        """Time over which each start is compared [s], shape (start,)."""
        return np.asarray(self.time[self.judged.sum(axis=1) - 1])

    @property
    def second(self) -> int:
        """Frame that stands for 1 s; a shorter scene does not have it."""
        return agreement.second(self.time[1])

    @property
    def instant(self) -> int:
        """Frame that stands for 1 s, or the last."""
        return min(self.second, len(self.time) - 1)

    @property
    def reaches(self) -> bool:
        """Whether any start is compared for 1 s, or for all of a shorter scene."""
        return bool(self.judged.sum(axis=1).max() > self.instant)

    def at_instant(self, error: Array) -> Array:
        """Return errors at 1 s [m] of the regular starts that are judged there, shape (count,)."""
        if self.second >= len(self.time):
            return np.zeros(0)
        return np.asarray(error[self.regular & self.judged[:, self.second], self.second])

    @property
    def frames(self) -> int:
        """Number of frames needed: all that are judged, and the first second."""
        return max(int(self.judged.sum(axis=1).max()), self.instant + 1)

    def beyond(self, error: Array) -> float:
        """Return the median ratio of error to engines' distance at 1 s, whether judged or not."""
        error, apart = error[:, self.instant], self.apart[:, self.instant]
        known = np.isfinite(error) & (apart > 0)
        ratio = error[known] / apart[known]
        return float(np.median(ratio)) if ratio.size else 0.0

    def weighted(self, error: Array) -> Array:
        """Return the largest weighted error of each start over the judged frames [m], (start,)."""
        return np.asarray(np.nanmax(np.where(self.judged, error / self.weight, 0.0), axis=1))


def window_of(evidence: Evidence, apart: Array) -> Window:
    """Determine how long motions can be compared.

    They can as long as disturbances grow less than a hundredfold. If contact leaves no unique
    solution, engines must also be within 1 % of the scene's length of each other.
    """
    known = evidence.reference.known
    growth = np.where(np.isfinite(evidence.growth), evidence.growth, 1.0)
    calm, ends = growth < agreement.CHAOS, "chaos"
    if not known.all():
        calm &= apart <= _APART * evidence.scene.length
        ends = "engines part by 1 % of the length in contact"
    judged = np.logical_and.accumulate(calm, axis=1)
    return Window(
        judged=judged,
        weight=np.maximum(1.0, growth),
        time=evidence.reference.time,
        apart=apart,
        regular=evidence.batch.regular,
        ends="" if judged.all() else ends,
    )


def disagreement(scene: Scene, runs: list[Trajectory]) -> Array:
    """Compute the largest RMS particle distance of two runs [m], shape (start, frame).

    A run that has ended no longer counts; the distance is 0 if fewer than two are left.
    """
    mechanism = Mechanism.of(scene)
    pairs = [agreement.particle_error(mechanism, *pair) for pair in combinations(runs, 2)]
    if not pairs:
        return np.zeros((len(runs[0]), len(runs[0].time)))
    return np.asarray(np.max(np.nan_to_num(pairs, nan=0.0), axis=0))


def floor_of(scene: Scene, window: Window) -> Floor:
    """Compute the thresholds that a change must exceed."""
    at_one = window.at_instant(window.apart)
    return Floor(
        disagreement_1s_m=float(at_one.max()) if at_one.size else None,
        disagreement_m=float(window.weighted(window.apart).max()),
        budget_1s_m=scene.budget.error_1s * scene.length,
        budget_m=scene.budget.error * scene.length,
    )


_CLEARLY = 3.0
"""Ratio to the engines' distance from which a change is clear even after they have parted."""


def row_of(
    effect: Effect, factor: float, change: Array, window: Window, floor: Floor, lost: str
) -> WeakenedEffect:
    """Compare a change with the floor, and return the row of its effect.

    Args:
        effect: Effect that was weakened.
        factor: Remaining share of the effect.
        change: RMS particle change [m], shape (start, frame); NaN where a run had ended.
        window: Frames in which it is judged.
        floor: Thresholds that it must exceed.
        lost: Why the ablated runs ended early; empty if none did.
    """
    at_one, weighted = window.at_instant(change), window.weighted(change)
    at_one = at_one[np.isfinite(at_one)]
    worst_one = float(at_one.max()) if at_one.size else None
    worst = float(weighted.max())
    excess = max(worst / floor.overall, (worst_one or 0.0) / floor.at_1s)
    apart = max(
        _over(worst, floor.disagreement_m), _over(worst_one or 0.0, floor.disagreement_1s_m)
    )
    beyond, finite = window.beyond(change), np.isfinite(change)
    finite[:, 0] = True
    finite_window = replace(window, judged=window.judged & finite)
    verdict = _verdict(excess, beyond, finite_window)
    sentence = _sentence(verdict, excess, apart, beyond, window)
    if verdict == "not resolvable" and window.reaches:
        sentence = f"{_share(excess)} until what is left without it ends"
    return WeakenedEffect(
        effect=effect.name,
        factor=factor,
        left=effect.dropped,
        verdict=verdict,
        sentence="; ".join(filter(None, (sentence, lost))),
        change_1s_m=worst_one,
        change_1s_median_m=float(np.median(at_one)) if at_one.size else None,
        change_m=worst,
        change_median_m=float(np.median(weighted)),
        over_floor=excess,
        over_disagreement=apart if np.isfinite(apart) else None,
    )


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
        return f"motion changes by {_digits(excess)} × the floor"
    share = _share(excess)
    if not window.reaches:
        instant = float(window.time[window.instant])
        text = f"{share} until {window.ends}; {_digits(beyond)} × their distance at {instant:g} s"
        return text if verdict == "needed" else f"{text}, clear is {_CLEARLY:g} ×"
    return f"{share}, though {_digits(apart)} × what engines differ by" if apart > 1.0 else share


def _share(excess: float) -> str:
    return f"{_digits(excess)} of the floor" if excess else "no change"


def _digits(ratio: float) -> str:
    return f"{ratio:.0f}" if 10 <= ratio < 1e4 else f"{ratio:.2g}"


_FREEDOMS = {"fixed": 0, "hinge": 1, "slider": 1, "ball": 3}
_FREE = 6
_IN_LINE, _IN_PLANE = (0, 4), (0, 2, 4)
"""Coordinates of a body that moves along x and rolls, or in x and z and turns about y."""


@dataclass(frozen=True)
class Least:
    """The smallest model of a scene, in the fields of an `Ablation`."""

    degrees_of_freedom: int
    joint_coordinates: int
    """Coordinates of the spanning tree; in one and two dimensions, the degrees of freedom."""
    loop_conditions: int
    contact_spheres: int


def least_size(scene: Scene) -> Least:
    """Compute the size of the smallest model of a scene."""
    mechanism = Mechanism.of(scene)
    if scene.dimension < 3:
        freedom = _planar_freedom(mechanism, _IN_LINE if scene.dimension == 1 else _IN_PLANE)
        return Least(freedom, freedom, 0, count_pairs(mechanism))
    freedom = degrees_of_freedom(mechanism)
    tree = [link.joint for link in mechanism.links]
    coordinates = sum(_FREE if joint is None else _FREEDOMS[joint.kind] for joint in tree)
    return Least(freedom, coordinates, coordinates - freedom, count_pairs(mechanism))


def sizes_of(
    scene: Scene, contenders: Sequence[Contender], least: Least, workers: int | None
) -> Iterator[Size]:
    """Compare the engines' models with the smallest one; engines that report none are left out."""
    tasks = [Task(_native_size, (scene, c.engine, c.settings)) for c in contenders]
    for contender, size in zip(contenders, run_tasks(tasks, workers=workers), strict=True):
        if isinstance(size, ModelSize):
            yield Size(
                engine=contender.engine,
                coordinates=size.coordinates,
                constraints=size.constraints,
                contact_pairs=size.contact_pairs,
                more_coordinates=size.coordinates - least.joint_coordinates,
                more_constraints=size.constraints - least.loop_conditions,
                more_pairs=size.contact_pairs - least.contact_spheres,
            )


def _native_size(scene: Scene, engine: str, settings: Settings) -> ModelSize:
    with load_adapter(engine).open(scene, settings) as run:
        return size_of(run)


def _planar_freedom(mechanism: Mechanism, moving: tuple[int, ...]) -> int:
    """Count the degrees of freedom at the reference pose, if bodies move in `moving` only."""
    count = mechanism.body_count
    rows = constraint_rows(mechanism, BodyStates.at_reference(mechanism))
    if not len(rows.parent):
        return len(moving) * count
    columns = [6 * body + k for body in range(count) for k in moving]
    jacobian = dense_jacobian(rows, count)[:, columns]
    return len(columns) - int(np.linalg.matrix_rank(jacobian, rtol=1e-9))

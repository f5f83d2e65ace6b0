"""What "stable" means here, and what breaks first where a run is not.

A run is *stable* if it comes to its end, its numbers are finite, and at every frame

- its energy balance is within 10 % of the energy scale (with contact: energy rises by no more than
  that above what impacts explain),
- no joint is open by more than 1 % of the scene's length, or 0.01 rad between its axes,
- no contact sphere is in the ground by more than 1 % of that length,
- and at the end its particles have gone at least a tenth of the way they should have gone.

A stable run is *off course* if its RMS particle error passes 10 % of the scene's length.

What is seen at the earliest frame is what broke first, and of several at one frame the one listed
first in `Outcome`s' order of gravity: apart, sunk, energy, stuck. A run that ended early without
any of these before is told as that.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import isolate
from mbds_xsim.checks import agreement
from mbds_xsim.checks.energy import damper_loss, energy_of, input_work
from mbds_xsim.checks.finding import Record
from mbds_xsim.checks.joints import angle_gap, gap
from mbds_xsim.checks.overlap import penetration
from mbds_xsim.checks.passivity import passivity
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.timed import recorded
from mbds_xsim.studies.stability.rows import Outcome, Told

Array = NDArray[np.float64]

_ENERGY = 0.1  # of the energy scale
_OPEN = 0.01  # of the scene's length, and [rad]
_SUNK = 0.01  # of the scene's length
_FROZEN = 0.1  # of the way that is due
_OFF = 0.1  # of the scene's length

CRITERIA = (
    f"stable: came to its end with finite numbers, energy balance within {_ENERGY:.0%} of its scale"
    f" (contact: no such rise), joints closed to {_OPEN:.0%} of the scene's length or {_OPEN:g} rad"
    f", spheres no deeper in the ground than {_SUNK:.0%} of it, a tenth of the way gone that is "
    f"due. Off course: stable, with an RMS particle error above {_OFF:.0%} of the length"
)


@dataclass(frozen=True)
class Verdict:
    """What became of a run, with the figures behind it."""

    outcome: Outcome
    told: Told
    reason: str
    broke_s: float | None
    ended_s: float
    energy: float | None
    gap: float | None
    sunk: float | None
    way: float | None
    error: float | None


@dataclass(frozen=True, eq=False)
class Signs:
    """What may tell that a run broke, each (frame,), NaN where nothing is known."""

    energy: Array
    """Deviation over its scale, with its sign."""
    gap: Array
    """Over the scene's length, or [rad]."""
    sunk: Array
    """Over the scene's length."""
    way: Array
    """Over that which is due."""
    error: Array
    """Of the particles, over the scene's length."""

    def broken(self) -> dict[Outcome, NDArray[np.bool_]]:
        """Say at which frames which limit is passed, in the order of gravity."""
        return {
            "comes apart": self.gap > _OPEN,
            "sinks in": self.sunk > _SUNK,
            "gains energy": self.energy > _ENERGY,
            "loses energy": self.energy < -_ENERGY,
            "stuck": _to_the_end(self.way, self.way < _FROZEN),
        }

    def off_course(self) -> dict[Outcome, int]:
        """Give the first frame at which the particles are too far off, if any."""
        off = self.error > _OFF
        return {"off course": int(off.argmax())} if off.any() else {}

    def figures(self) -> dict[str, float | None]:
        """Give the worst of each, and the way at the end, by their names in a verdict."""
        worst = {k: _extreme(getattr(self, k)) for k in ("energy", "gap", "sunk", "error")}
        end = float(self.way[-1])
        return {**worst, "way": end if np.isfinite(end) else None}


def part_of_way(gone: Array, due: Array, length: float) -> Array:
    """Give the part of the way due [m] that is gone, where that is worth comparing; (frame,)."""
    return np.where(due > _OFF * length, gone / due, np.nan)


def judge(
    scene: Scene,
    batch: Batch,
    trajectory: Trajectory,
    truth: Trajectory | None,
    method: Method,
    step: float,
) -> Verdict:
    """Judge one run.

    Args:
        scene: What was simulated.
        batch: The one start.
        trajectory: What the engine made of it.
        truth: The reference, if there is one; where it ends, so does the comparison.
        method: How it was made.
        step: Integration step [s].
    """
    record = Record(scene, batch, trajectory, method, step)
    reference = None if truth is None else Record(scene, batch, truth)
    with np.errstate(all="ignore"):
        signs = Signs(
            _energy(record, reference),
            _opened(record),
            _sunk(record),
            _way(record, reference),
            _error(record, reference),
        )
    failure = trajectory.failures[0]
    first = {what: int(flags.argmax()) for what, flags in signs.broken().items() if flags.any()}
    outcome: Outcome = "stable"
    if first:
        outcome = min(first, key=lambda what: first[what])
    elif failure is not None or not record.finite.all():
        outcome = meaning(failure)
        first = {outcome: int(record.finite[0].sum())}
    elif first := signs.off_course():
        outcome = "off course"
    time = trajectory.time
    return Verdict(
        outcome=outcome,
        told=who_told(failure),
        reason="" if failure is None else " ".join(failure.reason.split()),
        broke_s=float(time[min(first[outcome], len(time) - 1)]) if first else None,
        ended_s=float(time[max(0, int(record.finite[0].sum()) - 1)]),
        **signs.figures(),
    )


def _energy(record: Record, truth: Record | None) -> Array:
    """Deviation over the scale, with its sign; with contact the unexplained rise; (frame,)."""
    if record.scene.contacts:
        found = passivity(record)
        return _nothing(record) if found is None else found.series[0]
    energy = energy_of(record)
    balance = energy.total - energy.total[:, :1] - input_work(record) + damper_loss(record)[0]
    # A run that blows up would be measured by its own blow-up.
    scale = (energy if truth is None else energy_of(truth)).scale
    return np.asarray(balance[0] / scale[0])


def _opened(record: Record) -> Array:
    """Largest gap over the length, or angle [rad], (frame,)."""
    distance, angle = gap(record), angle_gap(record)
    parts = [_nothing(record)]
    parts += [distance.series[0] / record.scene.length] if distance is not None else []
    parts += [angle.series[0]] if angle is not None else []
    return np.asarray(np.fmax.reduce(parts))


def _sunk(record: Record) -> Array:
    found = penetration(record)
    return _nothing(record) if found is None else found.series[0]


def _way(record: Record, truth: Record | None) -> Array:
    """Way of the particles over that of the reference, where that is worth comparing; (frame,)."""
    if truth is None:
        return _nothing(record)
    return part_of_way(_gone(record), _gone(truth), record.scene.length)


def _gone(record: Record) -> Array:
    """Mean way of the particles from the start on [m], (frame,)."""
    markers = agreement.markers_of(record.mechanism, record.trajectory)[0]
    steps = np.linalg.norm(np.diff(markers, axis=0), axis=-1).mean(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _to_the_end(known: Array, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep what is seen from some frame to the last one that is known."""
    kept = np.logical_and.accumulate((seen | np.isnan(known))[::-1])[::-1]
    return np.asarray(kept & seen)


def _error(record: Record, truth: Record | None) -> Array:
    if truth is None:
        return _nothing(record)
    apart = agreement.particle_error(record.mechanism, record.trajectory, truth.trajectory)
    return np.asarray(apart[0] / record.scene.length)


def _nothing(record: Record) -> Array:
    return np.full(record.steps + 1, np.nan)


def _extreme(series: Array) -> float | None:
    """Value of the largest size, None where there is none."""
    known = series[np.isfinite(series)]
    return float(known[np.abs(known).argmax()]) if len(known) else None


# How the words of engines begin that adapters hand on; every other reason is an adapter's own.
_ENGINES_WORDS = re.compile(
    r"DART: |WARNING|Nan, Inf or huge value|Inertia matrix is too close to singular|"
    r"Newton's method stopped|the linear solver failed|\w*(Error|Exception)\b"
)
# The first that is found counts.
_MEANINGS: tuple[tuple[str, Outcome], ...] = (
    (r"blow-up|speed passes|not finite|not a number|huge value|[Nn]on-finite", "blows up"),
    (r"in the ground", "sinks in"),
    (r"\bcuts\b", "clamped"),
    (r"Newton|linear solver|SolverError|solver failed|solved to", "gives up"),
)


def who_told(failure: Failure | None) -> Told:
    """Tell whether a failure is in an engine's own words or those of its adapter's watch."""
    if failure is None:
        return "nobody"
    return "engine" if _ENGINES_WORDS.match(failure.reason) else "adapter"


def meaning(failure: Failure | None) -> Outcome:
    """Tell what a failure is about."""
    reason = "" if failure is None else failure.reason
    return next((what for words, what in _MEANINGS if re.search(words, reason)), "ends early")


@dataclass(frozen=True)
class Judged:
    """A run's verdict, and what it took."""

    verdict: Verdict
    wall_s: float


def run_cells(
    scene: Scene,
    batch: Batch,
    engine: str,
    settings: Sequence[Settings],
    truth: Trajectory | None,
    patience: float,
) -> list[Judged]:
    """Run cells one after the other in this process, as many as are begun within a time [s].

    It is that of the processor, and begins when the engine is there.

    Raises:
        InputError: The engine cannot do the scene or some settings are not allowed.
    """
    registry.load_adapter(engine)
    isolate.begin()
    begin = time.process_time()
    done: list[Judged] = []
    for one in settings:
        if done and time.process_time() - begin > patience:
            break
        done.append(run_cell(scene, batch, engine, one, truth))
    return done


def run_cell(
    scene: Scene, batch: Batch, engine: str, settings: Settings, truth: Trajectory | None
) -> Judged:
    """Simulate one start in this process and judge it.

    Raises:
        InputError: The engine cannot do the scene or the settings are not allowed.
    """
    adapter = registry.load_adapter(engine)
    with adapter.open(scene, settings) as run:
        begin = time.perf_counter()
        trajectory = recorded(run, batch)
        wall = time.perf_counter() - begin
    method = adapter.methods[settings.method]
    return Judged(judge(scene, batch, trajectory, truth, method, settings.step), wall)

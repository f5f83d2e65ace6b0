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
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks import agreement
from mbds_xsim.checks.conservation import energy_of, input_work
from mbds_xsim.checks.integrity import angle_gap, gap
from mbds_xsim.checks.joint_work import losses
from mbds_xsim.checks.passivity import passivity, penetration
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.simulator import Signs, Simulator, part_of_way
from mbds_xsim.studies.stability import Outcome, Told

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


def judge(signs: Signs, failure: Failure | None = None) -> dict[str, Any]:
    """Give what became of a run, and the figures behind it, as fields of a cell.

    A failure is what it ended by, if it did not come to its end.
    """
    begin, frames, end = signs.begin, len(signs.time), int(signs.finite.sum())
    broken = {what: flags[begin:] for what, flags in _broken(signs).items()}
    first = {what: int(flags.argmax()) + begin for what, flags in broken.items() if flags.any()}
    if failure is not None or end < frames:
        first.setdefault(meaning(failure), end)
    off = signs.error > _OFF
    if not first and off.any():
        first = {"off course": int(off.argmax())}
    outcome: Outcome = min(first, key=lambda what: first[what]) if first else "stable"
    return {
        "outcome": outcome,
        "told": who_told(failure),
        "reason": "" if failure is None else " ".join(failure.reason.split()),
        "broke_s": float(signs.time[min(first[outcome], frames - 1)]) if first else None,
        "ended_s": float(signs.time[max(0, end - 1)]),
        "way": _extreme(signs.way[-1:]),
        **{name: _extreme(getattr(signs, name)) for name in ("energy", "gap", "sunk", "error")},
    }


def _broken(signs: Signs) -> dict[Outcome, Mask]:
    """Say at which frames which limit is passed, in the order of gravity."""
    return {
        "comes apart": signs.gap > _OPEN,
        "sinks in": signs.sunk > _SUNK,
        "gains energy": signs.energy > _ENERGY,
        "loses energy": signs.energy < -_ENERGY,
        "stuck": _to_the_end(signs.way, signs.way < _FROZEN),
    }


def signs_of(record: Record, truth: Trajectory | None) -> Signs:
    """Give what shows in the motion of one start's bodies.

    Where the reference ends, if there is one, so does the comparison.
    """
    reference = None if truth is None else Record(record.scene, record.batch, truth)
    with np.errstate(all="ignore"):
        return Signs(
            time=record.trajectory.time,
            finite=record.finite[0],
            energy=_energy(record, reference),
            gap=_opened(record),
            sunk=_sunk(record),
            way=_way(record, reference),
            error=_error(record, reference),
        )


def _energy(record: Record, truth: Record | None) -> Array:
    """Deviation over the scale, with its sign; with contact the unexplained rise; (frame,)."""
    if record.scene.contacts:
        found = passivity(record)
        return _nothing(record) if found is None else found.series[0]
    energy = energy_of(record)
    balance = energy.total - energy.total[:, :1] - input_work(record) + losses(record)[0]
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


def _to_the_end(known: Array, seen: Mask) -> Mask:
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
    """Tell what a failure is about; where nobody gave one, numbers are not finite."""
    if failure is None:
        return "blows up"
    found = (what for words, what in _MEANINGS if re.search(words, failure.reason))
    return next(found, "ends early")


def run_cell(
    simulator: Simulator, scene: Scene, batch: Batch, count: int, truth: Trajectory | None
) -> dict[str, Any]:
    """Simulate one start in this process, judge it, and give the fields of its cell.

    Raises:
        InputError: The simulator cannot do the scene, or lacks the reference.
    """
    ran = simulator.simulate(scene, batch, count, truth, often=False)
    motion = ran.motion
    if isinstance(motion, Signs):
        found = judge(motion)
    else:
        record = Record(scene, batch, motion, ran.method, ran.step)
        found = judge(signs_of(record, truth), motion.failures[0])
    return found | {"wall_s": ran.wall_s[0]}

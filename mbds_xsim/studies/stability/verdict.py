"""Definition of "stable", and of what breaks first in a run that is not.

A run is *stable* if it reaches its end, its numbers are finite, and at every frame

- its energy balance is within 10 % of the energy scale (with contact: energy rises by no more than
  that above what impacts explain),
- no joint is open by more than 1 % of the scene's length, or 0.01 rad between its axes,
- no contact sphere is in the ground by more than 1 % of that length,
- and at the end its particles have covered at least a tenth of the path that is due.

A stable run is *off course* if its RMS particle error passes 10 % of the scene's length.

The outcome is the sign seen at the earliest frame; of several at one frame, it is the gravest:
comes apart, then sinks in, energy, stuck. A run that ended early with none of these before has the
outcome that its failure stands for.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.checks.conservation import energy_of, input_work
from mbds_xsim.checks.integrity import angle_gap, gap
from mbds_xsim.checks.joint_work import losses
from mbds_xsim.checks.passivity import passivity, penetration
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.simulator import Signs, Simulator, part_of_way
from mbds_xsim.studies.stability import Outcome, Reporter

_ENERGY = 0.1  # of the energy scale
_GAP = 0.01  # of the scene's length, and [rad]
_DEPTH = 0.01  # of the scene's length
_LEAST_WAY = 0.1  # of the path length that is due
_OFF = 0.1  # of the scene's length

CRITERIA = (
    f"stable: came to its end with finite numbers, energy balance within {_ENERGY:.0%} of its scale"
    f" (contact: no such rise), joints closed to {_GAP:.0%} of the scene's length or {_GAP:g} rad"
    f", spheres no deeper in the ground than {_DEPTH:.0%} of it, a tenth of the way gone that is "
    f"due. Off course: stable, with an RMS particle error above {_OFF:.0%} of the length"
)


def judge(signs: Signs, failure: Failure | None = None) -> dict[str, Any]:
    """Return the outcome of a run and its figures, as fields of a cell.

    `failure` is the one that ended the run, if it did not reach its end.
    """
    begin, frames, end = signs.begin, len(signs.time), int(signs.finite.sum())
    broken = {sign: flags[begin:] for sign, flags in _exceeded_limits(signs).items()}
    first = {sign: int(flags.argmax()) + begin for sign, flags in broken.items() if flags.any()}
    if failure is not None or end < frames:
        first.setdefault(meaning(failure), end)
    off = signs.error > _OFF
    if not first and off.any():
        first = {"off course": int(off.argmax())}
    outcome: Outcome = min(first, key=lambda sign: first[sign]) if first else "stable"
    return {
        "outcome": outcome,
        "told": reporter_of(failure),
        "reason": "" if failure is None else " ".join(failure.reason.split()),
        "broke_s": float(signs.time[min(first[outcome], frames - 1)]) if first else None,
        "ended_s": float(signs.time[max(0, end - 1)]),
        "way": _extreme(signs.way[-1:]),
        **{name: _extreme(getattr(signs, name)) for name in ("energy", "gap", "sunk", "error")},
    }


def _exceeded_limits(signs: Signs) -> dict[Outcome, Mask]:
    """Mark the frames at which each limit is exceeded, the gravest first."""
    return {
        "comes apart": signs.gap > _GAP,
        "sinks in": signs.sunk > _DEPTH,
        "gains energy": signs.energy > _ENERGY,
        "loses energy": signs.energy < -_ENERGY,
        "stuck": _to_the_end(signs.way, signs.way < _LEAST_WAY),
    }


def signs_of(record: Record, truth: Trajectory | None) -> Signs:
    """Measure the signs of instability in the motion of one start's bodies.

    The comparison with the reference, if there is one, ends where the reference ends; the way
    covered is NaN where the one that is due is too short.
    """
    reference = None if truth is None else Record(record.scene, record.batch, truth)
    way = error = _nothing(record)
    with np.errstate(all="ignore"):
        if reference is not None:
            length = record.scene.length
            way = part_of_way(_path_length(record), _path_length(reference), length)
            run, due = record.trajectory, reference.trajectory
            error = agreement.particle_error(record.mechanism, run, due)[0] / length
        return Signs(
            time=record.trajectory.time,
            finite=record.finite[0],
            energy=_energy(record, reference),
            gap=_joint_gap(record),
            sunk=_series(record, penetration(record)),
            way=way,
            error=error,
        )


def _energy(record: Record, truth: Record | None) -> Array:
    """Signed energy deviation over the scale; with contact, the unexplained rise; (frame,)."""
    if record.scene.contacts:
        return _series(record, passivity(record))
    energy = energy_of(record)
    balance = energy.total - energy.total[:, :1] - input_work(record) + losses(record)[0]
    # Over its own energy scale, a blow-up would look small.
    scale = (energy if truth is None else energy_of(truth)).scale
    return np.asarray(balance[0] / scale[0])


def _joint_gap(record: Record) -> Array:
    """Largest gap of a joint over the length, or angle between its axes [rad]; (frame,)."""
    distance = _series(record, gap(record)) / record.scene.length
    return np.asarray(np.fmax(distance, _series(record, angle_gap(record))))


def _series(record: Record, finding: Finding | None) -> Array:
    """Series of a check, NaN if it does not apply; (frame,)."""
    return _nothing(record) if finding is None else finding.series[0]


def _path_length(record: Record) -> Array:
    """Mean path length of the particles from the start on [m]; (frame,)."""
    markers = agreement.markers_of(record.mechanism, record.trajectory)[0]
    steps = np.linalg.norm(np.diff(markers, axis=0), axis=-1).mean(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _to_the_end(known: Array, flags: Mask) -> Mask:
    """Keep the flags that hold from some frame up to the last known one."""
    lasting = np.logical_and.accumulate((flags | np.isnan(known))[::-1])[::-1]
    return np.asarray(lasting & flags)


def _nothing(record: Record) -> Array:
    return np.full(record.steps + 1, np.nan)


def _extreme(series: Array) -> float | None:
    """Return the value of the largest magnitude, None if none is finite."""
    known = series[np.isfinite(series)]
    return float(known[np.abs(known).argmax()]) if len(known) else None


# Beginnings of engines' messages that adapters pass on; any other reason is an adapter's own.
_ENGINES_WORDS = re.compile(
    r"DART: |WARNING|Nan, Inf or huge value|Inertia matrix is too close to singular|"
    r"Newton's method stopped|the linear solver failed|\w*(Error|Exception)\b"
)
# The first match counts.
_MEANINGS: tuple[tuple[str, Outcome], ...] = (
    (r"blow-up|speed passes|not finite|not a number|huge value|[Nn]on-finite", "blows up"),
    (r"in the ground", "sinks in"),
    (r"\bcuts\b", "clamped"),
    (r"Newton|linear solver|SolverError|solver failed|solved to", "gives up"),
)


def reporter_of(failure: Failure | None) -> Reporter:
    """Return who reported a failure: the engine in its own words, or its adapter's watch."""
    if failure is None:
        return "nobody"
    return "engine" if _ENGINES_WORDS.match(failure.reason) else "adapter"


def meaning(failure: Failure | None) -> Outcome:
    """Return the outcome that a failure stands for; without one, numbers are not finite."""
    if failure is None:
        return "blows up"
    outcomes = (outcome for pattern, outcome in _MEANINGS if re.search(pattern, failure.reason))
    return next(outcomes, "ends early")


def run_cell(
    simulator: Simulator, scene: Scene, batch: Batch, count: int, truth: Trajectory | None
) -> dict[str, Any]:
    """Simulate one start in this process, judge it, and return the fields of its cell.

    Raises:
        InputError: The simulator cannot simulate the scene, or lacks the reference.
    """
    ran = simulator.simulate(scene, batch, count, truth, often=False)
    motion = ran.motion
    if isinstance(motion, Signs):
        fields = judge(motion)
    else:
        record = Record(scene, batch, motion, ran.method, ran.step)
        fields = judge(signs_of(record, truth), motion.failures[0])
    return fields | {"wall_s": ran.wall_s[0]}

"""Do recorded positions and velocities describe the same motion, at the same times?"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.mismatch import Mismatch, mismatch_of, projected
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate import rounding

_NOISE = 1e-4  # share of the largest speed; solvers' tolerances leave up to 4e-5
_LAG = 0.1  # share of a step: a fifth of the half step that must show
_METHOD = 5.0  # largest error of order 2, over step² · jerk (measured: 4.1)
_ERRORS = 3.0  # standard errors
_REST = 1e-3  # share of the speed that gravity adds in a frame; what is never faster is at rest
_FAINT = 1e-12  # share of gravity; smaller accelerations are rounding, and show no lag


@check("kinematics", _NOISE)
def kinematics(record: Record) -> Figures | None:
    """Measure how far displacements are off the integral of velocities; None if nothing flies.

    The figure is the difference over a step, as RMS velocity over the largest RMS speed: over the
    mass of all bodies, and over points at the ends of each body, so that a body that turns counts
    by what it carries. Subtracted are the resolution of the frames, the error of a method of the
    declared order, and the rounding of places in each step.
    """
    mismatch = _mismatch(record)
    if mismatch is None:
        return None
    if mismatch.frame[0] == 1 and (record.mechanism.loops or record.mechanism.distances):
        mismatch = dataclasses.replace(mismatch, residual=_started(record, mismatch))
    points, step = mismatch.points, _step(record)
    steps = max(1, round(record.frame / step))
    rounded = rounding.step_error(record.method, steps) * record.scene.length / record.frame

    def beyond(measure: Callable[[Array], Array], jerk: Array, blur: Array) -> Array:
        """Return the mismatch beyond known errors, over the largest speed."""
        # Methods of order 1 follow a modified flow to second order; those above 2 have errors that
        # are higher in the rate at which accelerations change.
        pull = np.maximum(measure(mismatch.acceleration), np.finfo(float).tiny)
        rate = np.minimum(step * jerk / pull, 1.0)
        own = _METHOD * step**2 * jerk * rate ** max(record.order - 2, 0)
        rest = np.maximum(measure(mismatch.residual) - (blur + rounded) - own, 0.0)
        return np.asarray(rest) / _largest(measure(mismatch.velocity), record)

    whole = beyond(points.rms, mismatch.jerk, mismatch.blur)
    each = beyond(points.each, mismatch.jerk_each, mismatch.blur_each)
    bodies = record.scene.bodies
    series = np.full((*record.finite.shape, 1 + len(bodies)), np.nan)
    series[:, mismatch.frame] = np.concatenate([whole[..., None], each], axis=-1)
    speed = _largest(points.rms(mismatch.velocity), record)
    resolved = np.median(np.nan_to_num(mismatch.blur / speed))
    if _skips(record):
        series[:, 0] = 0.0
    note = f"frames resolve {resolved:.1g} of the largest speed"
    return Figures(series, ["", *(body.name for body in bodies)], note)


def _started(record: Record, mismatch: Mismatch) -> Array:
    """Subtract from the first step's mismatch what closing loops by impulses does to the start."""
    residual = mismatch.residual.copy()
    rows = np.flatnonzero(np.isfinite(residual[:, 0]).all(axis=(1, 2, 3)))
    if len(rows):
        native = record.bodies.native[rows, 0]
        change = mismatch.points.as_bodies(residual[rows, 0], native)
        change = _unexplained_by_loops(record, rows, change)
        residual[rows, 0] = mismatch.points.as_points(*change, native)
    return residual


@check("velocity lag", lambda record: _LAG * _step(record), "s")
def velocity_lag(record: Record) -> Figures | None:
    """Measure the time shift between velocities and positions [s]; None without flight.

    It is the slope of the mismatch over the accelerations from changing joint rates, by least
    squares over the steps, weighted by their resolution. The other accelerations are a second
    regressor: velocities that are late together with their places lag in both, late joint rates in
    the first alone. The declared lag of the method is removed before.
    """
    mismatch = _mismatch(record)
    if mismatch is None:
        return None
    faint = mismatch.unclear + _FAINT * record.usual_pull
    mismatch = dataclasses.replace(mismatch, unclear=faint)
    lag, uncertainty = _slope(mismatch, _LAG * _step(record))
    if _skips(record):
        lag = np.nan_to_num(lag)
    note = f"known to {np.max(uncertainty):.1g} s"
    return Figures(record.at_end(np.abs(lag)[:, None]), note=note, uncertainty=uncertainty)


def _mismatch(record: Record) -> Mismatch | None:
    """Return the mismatch; None if contact, friction or drives leave no step to check."""
    if record.steps < 1 or (_skips(record) and not np.isfinite(mismatch_of(record).blur).any()):
        return None
    return mismatch_of(record)


def _skips(record: Record) -> bool:
    """Return whether some steps may be left out, or all steps of some trajectories."""
    mechanism = record.mechanism
    return bool(mechanism.has_impacts or mechanism.frictional or mechanism.drives)


def _step(record: Record) -> float:
    return record.frame if record.step is None else record.step


def _slope(mismatch: Mismatch, resolution: float) -> tuple[Array, Array]:
    """Compute the slope of the mismatch over acceleration [s], and its uncertainty, (trajectory,).

    The uncertainty is that of the blur plus three standard errors from the scatter of the steps.
    """
    known = np.isfinite(mismatch.blur)
    blur = np.where(known, mismatch.blur, 0.0)
    size = np.where(known, mismatch.points.rms(mismatch.acceleration), 0.0)
    floor = resolution * np.linalg.norm(size, axis=1, keepdims=True) / np.sqrt(size.shape[1])
    weight = known / np.maximum(blur**2 + floor**2, np.finfo(float).tiny)

    def inner(one: Array, other: Array) -> Array:
        return np.where(known, weight * mismatch.points.inner(one, other), 0.0)

    # Changes below the resolution show no lag.
    unclear = np.sum(weight * np.where(known, mismatch.unclear, 0.0) ** 2, axis=1)
    least = np.maximum(unclear, np.finfo(float).tiny)

    def square_of(regressor: Array) -> Array:
        return np.maximum(inner(regressor, regressor).sum(axis=1), least)

    def slope_over(regressor: Array, vectors: Array) -> Array:
        return inner(vectors, regressor).sum(axis=1) / square_of(regressor)

    other = mismatch.acceleration - mismatch.rate_acceleration
    rates = mismatch.rate_acceleration
    rates = rates - _each(slope_over(other, rates)) * other
    slope = slope_over(rates, mismatch.residual)
    rest = mismatch.residual - _each(slope) * rates
    rest = rest - _each(slope_over(other, rest)) * other
    square = square_of(rates)
    error = np.sqrt(np.sum(inner(rest, rates) ** 2, axis=1))
    blurred = np.sum(weight * blur * np.where(known, mismatch.points.rms(rates), 0.0), axis=1)
    lag = np.where(known.any(axis=1), slope, np.nan)
    return lag, (blurred + _ERRORS * error) / square


def _each(values: Array) -> Array:
    """Expand values of trajectories, to multiply vectors of points with them."""
    return values[:, None, None, None, None]


def _largest(speeds: Array, record: Record) -> Array:
    """Return the largest speed of each trajectory, at least that of rest, (trajectory, 1, …)."""
    rest = _REST * record.frame * record.usual_pull
    axes = tuple(range(1, speeds.ndim))
    return np.maximum(np.nanmax(speeds, axis=axes, keepdims=True, initial=0.0), rest)


def _unexplained_by_loops(
    record: Record, rows: Index, change: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Subtract what an impulse of the loops' constraints explains from changes of velocities.

    An engine that closes loops by impulses keeps them closed where a step begins, not where it
    ends, so that the loops' effect on velocities comes a step late. The drawn start has no such
    delay: in the first step velocities change by an additional impulse.

    That change is allowed by the tree's joints, and orthogonal to all motions of the closed
    mechanism in the metric of kinetic energy. It is at most what the loops' own forces do in a
    step.

    Changes are linear [m/s] and angular [rad/s], shape (row, body, 3).
    """
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference import accelerations

    mechanism, start = record.mechanism, record.bodies[rows, 0]
    joints = tuple(joint for joint in mechanism.joints if joint not in mechanism.loops)
    tree = dataclasses.replace(mechanism, joints=joints, loops=(), distances=())
    changed = BodyStates(start.position, start.native, *change)
    open_loops, closed = (projected(each, changed) for each in (tree, mechanism))
    impulse = (
        open_loops.velocity - closed.velocity,
        open_loops.angular_velocity - closed.angular_velocity,
    )
    load = record.batch.force[rows, 0], record.torque[rows, 0]
    pulls = (accelerations(each, start, *load) for each in (tree, mechanism))
    forced = [_step(record) * (a - b) for a, b in zip(*pulls, strict=True)]
    most, size = (_size(mechanism, start, *each) for each in (forced, impulse))
    share = np.minimum(1.0, most / np.maximum(size, np.finfo(float).tiny))[:, None, None]
    linear, angular = (a - share * b for a, b in zip(change, impulse, strict=True))
    return linear, angular


def _size(mechanism: Mechanism, start: BodyStates, linear: Array, angular: Array) -> Array:
    """Return the square root of twice the kinetic energy, shape (trajectory,)."""
    own = rotation.rotate(rotation.conjugate(start.native), angular)
    turning = np.einsum("tbi,bij,tbj->t", own, mechanism.inertia, own)
    return np.asarray(np.sqrt(np.einsum("b,tbi,tbi->t", mechanism.mass, linear, linear) + turning))

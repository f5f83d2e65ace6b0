"""How near contact comes to the exact motion, where there is one: limits beside the budgets.

Budgets bound errors weighted by the growth of small differences. What contact promises is
narrower, and holds piece by piece: while a ball slides, until it first hits the ground, to the top
of its first rebound, up to its third bounce; and in flight, for bodies that are joined.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks import Finding
from mbds_xsim.measure.campaign import ReferenceOutcome
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.claims import Method

_SLIDING = 2e-3  # over the scene's length, as other errors of places
_FALLING = 5e-4
_BOUNCING = 2e-2
_BOUNCES = 3
_REBOUND = 2e-2
_FLYING = 1.25e-3
_TURNING = 1e-3  # [rad]
_MOMENTUM = 1e-3  # over the check's scale
_MOMENTUM_HIGH_ORDER = 1e-6
_HIGH_ORDER = 4
_CALM = 2.0  # growth up to which errors in flight are the method's own


def contact_findings(
    scene: Scene,
    motion: Trajectory,
    exact: ReferenceOutcome,
    method: Method,
    momentum: Array | None = None,
) -> list[Finding]:
    """Hold a motion on the ground against the pieces of it that are known exactly.

    A ball's motion is known throughout, that of joined bodies up to the first impact. Errors are
    distances of centres of mass; what starts in contact and is no ball has none. Momentum is
    looked at in all flights.

    Args:
        scene: What was simulated.
        motion: What an engine delivered.
        exact: What it should be.
        method: How the motion was made.
        momentum: Series of the check of momentum, shape (trajectory, frame); None: it has none.

    Returns:
        A finding for each limit that applies; none where the scene has no contact, or no gravity
        towards the ground.
    """
    if not scene.contacts or scene.gravity[2] >= 0.0:
        return []
    mechanism = Mechanism.of(scene)
    pieces = _ball_pieces if mechanism.has_only_balls else _flight_pieces
    return [*pieces(mechanism, motion, exact), *_momenta(exact, method, momentum)]


def _ball_pieces(
    mechanism: Mechanism, motion: Trajectory, exact: ReferenceOutcome
) -> Iterator[Finding]:
    length, error = mechanism.scene.length, _distance(motion, exact.trajectory)
    bounces = _bounces(mechanism, exact.trajectory)
    hopping = np.broadcast_to((bounces > 0).any(axis=1, keepdims=True), bounces.shape)
    between = (bounces > 0) & (bounces < _BOUNCES)
    yield from _judged("error while sliding", "m", error, ~hopping, _SLIDING * length)
    before = hopping & (bounces == 0)
    yield from _judged("error before the first impact", "m", error, before, _FALLING * length)
    rebound, tops = _rebounds(mechanism, motion, exact.trajectory, bounces)
    yield from _judged("height of the first rebound", "1", rebound, tops, _REBOUND)
    yield from _judged("error up to the third bounce", "m", error, between, _BOUNCING * length)


def _flight_pieces(
    mechanism: Mechanism, motion: Trajectory, exact: ReferenceOutcome
) -> Iterator[Finding]:
    truth = exact.trajectory
    flying = _known(truth) & (exact.growth < _CALM)
    flying &= flying[:, 1:].any(axis=1, keepdims=True)  # else it starts in contact
    turn = rotation.multiply(motion.orientation, rotation.conjugate(truth.orientation))
    angle = 2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(turn[..., 1:], axis=-1)))
    seen = np.broadcast_to(flying[:, :, None], angle.shape)
    most = _FLYING * mechanism.scene.length
    yield from _judged("error in flight", "m", _distance(motion, truth), seen, most)
    yield from _judged("turn in flight", "rad", angle, seen, _TURNING)


def _momenta(exact: ReferenceOutcome, method: Method, momentum: Array | None) -> Iterator[Finding]:
    """Before the first impact a method of high order keeps it almost to rounding."""
    if momentum is None:
        return
    series = momentum[:, :, None]
    high = method.order >= _HIGH_ORDER
    known = _known(exact.trajectory)
    before = known & ~known.all(axis=1, keepdims=True)
    before &= before[:, 1:].any(axis=1, keepdims=True)
    budget = _MOMENTUM_HIGH_ORDER if high else _MOMENTUM
    told = "momentum before the first impact"
    yield from _judged(told, "1", series, (before & ~np.isnan(momentum))[:, :, None], budget)
    yield from _judged("momentum in flight", "1", series, ~np.isnan(series), _MOMENTUM)


def _judged(check: str, unit: str, value: Array, where: Mask, budget: float) -> Iterator[Finding]:
    """Give what was measured, (trajectory, frame, part), where it counts; nothing if nowhere.

    What is not finite there was lost. A trajectory in which nothing counts has the figure 0.
    """
    if not where.any():
        return
    figure = np.where(where, np.where(np.isfinite(value), value, np.inf), np.nan)
    figure[~where.any(axis=(1, 2)), 0] = 0.0
    yield Finding.of(check, unit, figure, budget=budget)


def _known(truth: Trajectory) -> Mask:
    """Frames for which there is a true motion, shape (trajectory, frame)."""
    return np.asarray(np.isfinite(truth.position).all(axis=(2, 3)))


def _distance(motion: Trajectory, exact: Trajectory) -> Array:
    """Of centres of mass [m], shape (trajectory, frame, body)."""
    return np.asarray(np.linalg.norm(motion.position - exact.position, axis=-1))


def _bounces(mechanism: Mechanism, exact: Trajectory) -> Index:
    """Count each ball's bounces so far, (trajectory, frame, body): its speed jumps upwards."""
    climb = exact.velocity[..., 2]
    lift = -0.5 * mechanism.scene.gravity[2] * mechanism.scene.clock.frame
    return np.cumsum(np.diff(climb, axis=1, prepend=climb[:, :1]) > lift, axis=1)


def _rebounds(
    mechanism: Mechanism, motion: Trajectory, exact: Trajectory, bounces: Index
) -> tuple[Array, Mask]:
    """Compare heights of the first rebounds at the frame nearest the top, the rest added.

    Returns:
        Relative errors and where these frames are, each of shape (trajectory, frame, body).
    """
    radius = np.empty(mechanism.body_count)
    radius[mechanism.sphere_body] = mechanism.sphere_radius
    pull = -mechanism.scene.gravity[2]
    speed = np.where(bounces == 1, np.abs(exact.velocity[..., 2]), np.inf)
    nearest = speed.argmin(axis=1)[:, None]
    tops = np.zeros(speed.shape, dtype=bool)
    np.put_along_axis(tops, nearest, np.isfinite(speed.min(axis=1))[:, None], axis=1)
    reached, wanted = (
        run.position[..., 2] - radius + run.velocity[..., 2] ** 2 / (2 * pull)
        for run in (motion, exact)
    )
    return np.abs(reached / np.where(tops, wanted, 1.0) - 1.0), tops

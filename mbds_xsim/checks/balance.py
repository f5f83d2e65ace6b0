"""Can contact explain the momentum that bodies gain in each step?

The ground only pushes, and friction is at most μ times the push: Coulomb's cone. If a sphere slips
through the whole step, friction is exactly that large and opposes the slip. If the slip turns, the
total of a step lies in the hull of an arc of the cone's edge, which is the part of the cone ahead
of a plane. Finding the best impulses in these sets is a convex problem; those of all steps are
found at once by the alternating direction method of multipliers (Boyd et al. 2011, Foundations and
Trends in Machine Learning 3, 1).

The ground gives a group of bodies an impulse at each sphere that may touch. `balance` measures the
gained momentum that no impulses there explain, of any size and direction: drag, damping, wrong or
missing torques, a wrong mass or inertia, moments that no point contact has. `cones` measures the
gained momentum that no impulses within Coulomb's cones explain: wrong friction or gravity.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask, Picked
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.gains import Axle, axles_of, gains_of
from mbds_xsim.checks.ground import Push, pushes_of
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import direction

_LASTING = 1.0  # share of its change that a slip must exceed
_FAST = 0.5  # share of gravity's gain per frame; slower slips may come and go in one (Exudyn)
_ASIDE = 0.1  # rad between friction and slip; PyBullet's, under cars on two wheels, is 0.06
_WEIGHT = 0.01  # first weight of the distance from the cones, over the mean eigenvalue
_RELAXED = 1.6
_LOOK, _ROUNDS = 25, 24  # iterations between two tests of convergence, and number of tests
_MILD, _RANGE = 5.0, 10.0  # largest factor of the weight's change, at once and in all
_SAME = 1e-8  # relative tolerance of convergence
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Cones(Picked):
    """Allowed impulses P = (T, N): |T| ≤ μ N and T · ahead ≥ μ N least; axes (…, sphere)."""

    friction: float
    ahead: Array
    """Unit vector against the slip, (…, sphere, 2)."""
    least: Array
    """Cosine of the largest angle of friction to `ahead`; -1: the sphere may stick."""

    def nearest(self, impulse: Array) -> Array:
        """Project impulses onto the cones, shape (…, sphere, 3)."""
        across, up, mu = impulse[..., :2], impulse[..., 2], self.friction
        share, top = _into_wedge(np.linalg.norm(across, axis=-1), up, mu)
        near = np.concatenate([share[..., None] * across, top[..., None]], axis=-1)
        ahead = np.einsum("...i,...i->...", self.ahead, across)
        short = (self.least > -1.0) & (share * ahead < mu * self.least * top)
        if not short.any():
            return near
        # Then the nearest is on the plane, whose part of the cone is a wedge of two edges.
        steep = mu * self.least
        root = np.hypot(1.0, steep)
        side = np.stack([-self.ahead[..., 1], self.ahead[..., 0]], axis=-1)
        aside = np.einsum("...i,...i->...", side, across)
        slope = mu * np.sqrt(np.maximum(1.0 - self.least**2, 0.0)) / root
        share, along = _into_wedge(np.abs(aside), (steep * ahead + up) / root, slope)
        top = along / root
        flat = (share * aside)[..., None] * side + (steep * top)[..., None] * self.ahead
        return np.where(short[..., None], np.concatenate([flat, top[..., None]], axis=-1), near)


def cones_of(record: Record, push: Push) -> Cones:
    """Find the sets of allowed impulses of each step at the group's spheres."""
    begin, end = (slip[..., :2] for slip in gains_of(record, push).slips)
    slowest = np.minimum(*(np.linalg.norm(part, axis=-1) for part in (begin, end)))
    change = np.linalg.norm(end - begin, axis=-1)
    lasts = slowest > _LASTING * change + _FAST * record.fall
    lasts &= push.reach & (push.resting[:, 1:] & push.resting[:, :-1])[..., None]
    middle = direction(direction(begin) + direction(end))
    turned = np.arccos(np.clip(np.einsum("...i,...i->...", direction(begin), middle), -1.0, 1.0))
    least = np.where(lasts, np.cos(np.minimum(turned + _ASIDE, np.pi)), -1.0)
    return Cones(record.ground.friction, -middle, least)


def unexplained(columns: Array, gains: Array, cones: Cones) -> Array:
    """Return what the best impulses leave of gains, by least squares, shape (step, row).

    Args:
        columns: Gains by unit impulses, shape (step, row, sphere, 3).
        gains: Actual gains, shape (step, row).
        cones: Allowed impulses, (step, sphere).
    """
    residual = gains.copy()
    if not len(gains):
        return residual
    flat = columns.reshape(*gains.shape, -1)
    across = np.swapaxes(flat, 1, 2)
    size, turn = np.linalg.eigh(across @ flat)
    mean = size.mean(axis=1, keepdims=True) + _TINY
    search = _Search(
        step=np.arange(len(gains)),
        flat=flat,
        size=np.maximum(size, 0.0),
        turn=turn,
        start=_of(across, gains),
        weight=_WEIGHT * mean,
        first=_WEIGHT * mean,
        cones=cones,
        impulses=np.zeros_like(size),
        off=np.zeros_like(size),
    )
    for _ in range(_ROUNDS):
        unsettled = search.go_on()
        residual[search.step] = gains[search.step] - _of(search.flat, search.impulses)
        if not unsettled.any():
            break
        search = search[unsettled]
    return residual


@dataclass(eq=False)
class _Search(Picked):
    """Search for the impulses of all steps not settled yet; axes are (step, unknown)."""

    step: Index
    flat: Array
    """Gains by unit impulses, (step, row, unknown)."""
    size: Array
    """Eigenvalues of the normal equations."""
    turn: Array
    """Eigenvectors of the normal equations, (step, unknown, eigenvector)."""
    start: Array
    """Right-hand side of the normal equations."""
    weight: Array
    """Weight of the distance from the cones, (step, 1)."""
    first: Array
    """The same at the start."""
    cones: Cones
    impulses: Array
    """Impulses within the cones."""
    off: Array
    """Sum of the distances from the cones so far, the scaled dual variable."""

    def go_on(self) -> Mask:
        """Iterate, fit the weights to both residuals, and return which steps are not settled.

        Residuals are the distance of the best impulses from the cones, and the last change.
        """
        back = np.swapaxes(self.turn, 1, 2)
        for _ in range(_LOOK):
            aim = self.start + self.weight * (self.impulses - self.off)
            best = _of(self.turn, _of(back, aim) / (self.size + self.weight))
            ahead = _RELAXED * best + (1.0 - _RELAXED) * self.impulses + self.off
            before, shape = self.impulses, (*self.cones.least.shape, 3)
            self.impulses = self.cones.nearest(ahead.reshape(shape)).reshape(ahead.shape)
            self.off = ahead - self.impulses
        apart, moved = _size(self.impulses - best), _size(self.impulses - before)
        ratio = np.sqrt(np.maximum(apart, _TINY) / np.maximum(moved, _TINY))
        weight = self.weight * np.clip(ratio, 1.0 / _MILD, _MILD)
        weight = np.clip(weight, self.first / _RANGE, self.first * _RANGE)
        late = apart > _SAME * _size(best)
        late |= self.weight * moved > _SAME * _size(self.start)
        self.off = self.off * self.weight / weight
        self.weight = weight
        return np.asarray(late[:, 0])


def _of(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _size(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1, keepdims=True))


def _into_wedge(across: Array, up: Array, slope: Array | float) -> tuple[Array, Array]:
    """Project (across, up) to across ≤ slope · up; return the remaining share of across, and up."""
    inside, beyond = across <= slope * up, slope * across <= -up
    top = np.maximum((slope * across + up) / (1.0 + np.square(slope)), 0.0)
    share = slope * top / np.maximum(across, np.finfo(float).tiny)
    return (
        np.where(inside, 1.0, np.where(beyond, 0.0, share)),
        np.where(inside, up, np.where(beyond, 0.0, top)),
    )


_DEPENDENT = 1e-3  # share of the largest singular value; below it impulses hardly reach a direction
_IMPACT = 5e-3  # share of an impact's impulse; tumbling cars leave up to 3.4e-3, in MuJoCo
_FAINT = 0.05  # share of the weight; less is hardly a contact, and its impulse says little
_SURE = 1e-3  # share of the weight; steps that are more uncertain do not count in drifts


@dataclass(frozen=True, eq=False)
class _Imbalance:
    """Unexplained momentum in the steps of a group [N·s]; axes are (trajectory, step, …)."""

    rows: Array
    """Unexplained impulse, moment over longest arm, spins over radii (or that arm), (…, row)."""
    gain: Array
    """Gained momentum in the same rows, (…, row)."""
    columns: Array
    """Gains by unit impulses at the spheres, (…, row, sphere, 3)."""
    scale: Array
    """Vertical impulse, or the weight's if that is larger, (…)."""
    vague: Array
    """Uncertainty from motion within the step, faint contact and impacts, (…)."""
    beside: Array
    """Further uncertainty of sizes and directions of impulses next to impacts, (…)."""
    axles: list[Axle]
    flying: Mask
    """Steps in which nothing touches, (…)."""
    known: Mask
    """Steps whose two frames are finite, (…)."""


@check("balance", "balance")
def balance(record: Record) -> Figures:
    """Measure the gained momentum that no impulses at touching spheres explain.

    The scale is the larger of the ground's vertical impulse and the weight's. None without contact,
    or if something else supports the bodies that may touch.
    """
    return _figures(record, lambda _, rest: _parts(rest))


@check("balance drift", "balance")
def balance_drift(record: Record) -> Figures:
    """Add up unexplained spins about axles, over the impulse of the weight in a step.

    A small torque that always acts shows in the sum. None without bodies of revolution on axles.
    """
    return _figures(record, functools.partial(_drifts, record))


@check("cones", "balance")
def cones(record: Record) -> Figures:
    """Measure the gained momentum that no impulses within Coulomb's cones explain.

    Such impulses push, with friction up to μ times the push, and with exactly that much against the
    slip of a sphere that slips through the whole step. Scale and None are as in `balance`.
    """

    def parts(push: Push, rest: _Imbalance) -> dict[str, Array]:
        some, rows = ~rest.flying, rest.gain.copy()
        allowed = cones_of(record, push)[some]
        rows[some] = unexplained(rest.columns[some], rest.gain[some], allowed)
        return _parts(replace(rest, rows=rows, vague=rest.vague + rest.beside))

    return _figures(record, parts)


def _figures(record: Record, parts_of: Callable[[Push, _Imbalance], dict[str, Array]]) -> Figures:
    names, columns = [], []
    for push in pushes_of(record):
        rest = _imbalance_of(record, push)
        for name, part in parts_of(push, rest).items():
            names.append(f"{name}, {push.name}")
            columns.append(np.where(rest.known, part, np.nan))
    return Figures(record.by_step(columns), names)


def _parts(rest: _Imbalance) -> dict[str, Array]:
    """Return unexplained impulse, moment and spins over the scale, each (trajectory, step)."""
    impulse, moment = (np.linalg.norm(rest.rows[..., k : k + 3], axis=-1) for k in (0, 3))
    # In flight `momentum` judges it, with a budget by the order of the method.
    moment = np.where(rest.flying, 0.0, moment)
    off = {"impulse": impulse - rest.vague, "moment": moment - rest.vague}
    for axle, spin in zip(rest.axles, np.moveaxis(rest.rows[..., 6:], -1, 0), strict=True):
        off[axle.name] = np.abs(spin) - (0.0 if axle.sphere is None else rest.vague)
    return {name: np.maximum(part, 0.0) / rest.scale for name, part in off.items()}


def _drifts(record: Record, push: Push, rest: _Imbalance) -> dict[str, Array]:
    """Return sums up to each step over the weight's impulse, (trajectory, step)."""
    weight = push.mass * record.usual_pull * record.frame
    spins = np.moveaxis(rest.rows[..., 6:], -1, 0)
    sure = rest.vague < _SURE * weight
    return {
        axle.name: np.abs(np.cumsum(spin * (sure | (axle.sphere is None)), axis=1)) / weight
        for axle, spin in zip(rest.axles, spins, strict=True)
    }


@functools.lru_cache(maxsize=4)
def _imbalance_of(record: Record, push: Push) -> _Imbalance:
    """Find what impulses at the spheres, and one along gravity, leave unexplained.

    The latter is free in size because velocities near soft contact may belong to another instant.
    """
    gains, axles = gains_of(record, push), axles_of(record.mechanism, push)
    size = float(np.nanmax(rotation.norm(gains.arm), initial=np.finfo(float).tiny))
    radii = np.array([axle.radius or size for axle in axles])
    momentum = np.concatenate([gains.linear, gains.angular / size, gains.spin / radii], axis=-1)
    known = np.isfinite(momentum).all(axis=-1) & np.isfinite(gains.arm).all(axis=(2, 3))
    momentum = np.where(known[..., None], momentum, 0.0)
    up, weight = np.maximum(momentum[..., 2], 0.0), push.mass * record.usual_pull * record.frame
    faint = gains.touches.any(axis=2) & (up < _FAINT * weight)
    momentum[faint, 2] = 0.0
    touches = gains.touches & (known & ~faint)[..., None]
    columns = np.where(touches[..., None, :, None], _columns(gains.arm / size, len(axles)), 0.0)
    for k, axle in enumerate(axles):
        if axle.sphere is not None:
            lever = gains.lever[..., k, :] / axle.radius
            columns[..., 6 + k, axle.sphere, :] = np.where(
                touches[..., axle.sphere, None], lever, 0.0
            )
    # A step is quiet where the ground carries the weight steadily, before and after it as well.
    quiet = push.resting[:, 1:] & push.resting[:, :-1]
    most = up * np.hypot(1.0, record.ground.friction)
    vague = np.where(known, (gains.vague * most + gains.blur) / size, 0.0)
    flying = ~touches.any(axis=2)
    sides = np.pad(up, ((0, 0), (1, 1)))
    beside = np.maximum(np.maximum(sides[:, :-2], sides[:, 2:]) - up, 0.0)
    return _Imbalance(
        rows=_unexplained(columns, momentum),
        gain=momentum,
        columns=columns,
        scale=np.maximum(up, weight),
        vague=vague + np.where(faint, _FAINT * weight, np.where(quiet, 0.0, _IMPACT * up)),
        beside=np.where(faint | quiet | flying, 0.0, _IMPACT * beside),
        axles=axles,
        flying=flying,
        known=known,
    )


def _columns(arm: Array, axles: int) -> Array:
    """Compute gains by unit impulses at spheres, (trajectory, step, row, sphere, 3)."""
    columns = np.zeros((*arm.shape[:2], 6 + axles, *arm.shape[2:]))
    for k, along in enumerate(np.eye(3)):
        columns[..., k, :, k] = 1.0
        columns[..., 3:6, :, k] = np.swapaxes(rotation.cross(arm, along), -1, -2)
    return columns


def _unexplained(columns: Array, momentum: Array) -> Array:
    """Return the residual of a least-squares solution, (trajectory, step, row)."""
    some = columns.any(axis=(2, 3, 4))
    flat = columns[some].reshape(-1, columns.shape[2], 3 * columns.shape[3])
    fall = np.zeros((*flat.shape[:2], 1))
    fall[:, 2] = 1.0
    turn, size, _ = np.linalg.svd(np.concatenate([flat, fall], axis=-1), full_matrices=False)
    turn = turn * (size > _DEPENDENT * size[:, :1])[:, None]
    residual = momentum.copy()
    residual[some] -= np.einsum("src,sqc,sq->sr", turn, turn, momentum[some], optimize=True)
    return residual

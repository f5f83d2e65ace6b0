"""Can contact explain what bodies gain in each step?

The ground only pushes, and friction is no more than μ times the push: Coulomb's cone. Against a
sphere that slips through the whole step friction is just so much and opposite to the slip. What a
slip that turns collects in a step lies in the hull of an arc of the cone's edge, which is the part
of the cone ahead of a plane. Finding the best impulses in all of these is a convex problem; those
of all steps are solved at once by the alternating direction method of multipliers (Boyd et al.
2011, Foundations and Trends in Machine Learning 3, 1).

The ground gives a group of bodies an impulse at each sphere that may touch. What no impulses there,
of any size and direction, make of the momentum that the group gained is the finding: drag, damping,
torques that are wrong or missing, a wrong mass or inertia, moments that no point contact has. And
what no impulses within Coulomb's cones make of it: friction or gravity that is another.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.gains import Axle, axles_of, gains_of
from mbds_xsim.checks.ground import Push, pushes_of
from mbds_xsim.checks.record import Record

_LASTING = 1.0  # of its change, which a slip must keep
_FAST = 0.5  # of what gravity adds in a frame: slower slips may come and go in one (Exudyn's do)
_ASIDE = 0.1  # rad, of friction beside the slip: PyBullet's, under cars on two wheels, is 0.06
_WEIGHT = 0.01  # of the mean eigenvalue, at first: of the distance from the cones
_RELAXED = 1.6
_LOOK, _ROUNDS = 25, 24  # iterations between two looks at what still changes, and how many looks
_MILD, _RANGE = 5.0, 10.0  # by which the weight changes at most, at once and in all
_SAME = 1e-8  # relative, which no longer counts
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Cones:
    """What impulses may be, P = (T, N): |T| ≤ μ N and T · ahead ≥ μ N least; axes (…, sphere)."""

    friction: float
    ahead: Array
    """Against the slip, as a unit vector, (…, sphere, 2)."""
    least: Array
    """Cosine of the angle by which friction may be beside that; -1: the sphere may stick."""

    def __getitem__(self, picks: Mask) -> Cones:
        """Take some of the steps."""
        return Cones(self.friction, self.ahead[picks], self.least[picks])

    def nearest(self, impulse: Array) -> Array:
        """Project impulses, shape (…, sphere, 3)."""
        across, up, mu = impulse[..., :2], impulse[..., 2], self.friction
        share, top = _into_wedge(np.linalg.norm(across, axis=-1), up, mu)
        found = np.concatenate([share[..., None] * across, top[..., None]], axis=-1)
        ahead = np.einsum("...i,...i->...", self.ahead, across)
        short = (self.least > -1.0) & (share * ahead < mu * self.least * top)
        if not short.any():
            return found
        # Then the nearest is on the plane: its part of the cone is a wedge of two edges.
        steep = mu * self.least
        root = np.hypot(1.0, steep)
        side = np.stack([-self.ahead[..., 1], self.ahead[..., 0]], axis=-1)
        aside = np.einsum("...i,...i->...", side, across)
        open_ = mu * np.sqrt(np.maximum(1.0 - self.least**2, 0.0)) / root
        share, along = _into_wedge(np.abs(aside), (steep * ahead + up) / root, open_)
        top = along / root
        flat = (share * aside)[..., None] * side + (steep * top)[..., None] * self.ahead
        return np.where(short[..., None], np.concatenate([flat, top[..., None]], axis=-1), found)


def cones_of(record: Record, push: Push) -> Cones:
    """Find how the impulses of each step at the group's spheres are confined."""
    begin, end = (slip[..., :2] for slip in gains_of(record, push).slips)
    sizes = [np.linalg.norm(part, axis=-1) for part in (begin, end)]
    change = np.linalg.norm(end - begin, axis=-1)
    lasts = np.minimum(*sizes) > _LASTING * change + _FAST * record.fall
    lasts &= push.reach & (push.resting[:, 1:] & push.resting[:, :-1])[..., None]
    tiny = np.finfo(float).tiny
    ways = [
        part / np.maximum(size, tiny)[..., None]
        for part, size in zip((begin, end), sizes, strict=True)
    ]
    middle = ways[0] + ways[1]
    middle = middle / np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), tiny)
    turned = np.arccos(np.clip(np.einsum("...i,...i->...", ways[0], middle), -1.0, 1.0))
    least = np.where(lasts, np.cos(np.minimum(turned + _ASIDE, np.pi)), -1.0)
    return Cones(record.ground.friction, -middle, least)


def unexplained(columns: Array, given: Array, cones: Cones) -> Array:
    """Take from gains what the best impulses explain, by least squares, shape (step, row).

    Args:
        columns: What unit impulses give, shape (step, row, sphere, 3).
        given: What was gained, shape (step, row).
        cones: What impulses may be, (step, sphere).
    """
    left = given.copy()
    if not len(given):
        return left
    flat = columns.reshape(*given.shape, -1)
    across = np.swapaxes(flat, 1, 2)
    size, turn = np.linalg.eigh(across @ flat)
    mean = size.mean(axis=1, keepdims=True) + _TINY
    search = _Search(
        step=np.arange(len(given)),
        flat=flat,
        size=np.maximum(size, 0.0),
        turn=turn,
        start=_of(across, given),
        weight=_WEIGHT * mean,
        least=_WEIGHT * mean / _RANGE,
        most=_WEIGHT * mean * _RANGE,
        cones=cones,
        found=np.zeros_like(size),
        off=np.zeros_like(size),
    )
    for _ in range(_ROUNDS):
        still = search.go_on()
        left[search.step] = given[search.step] - _of(search.flat, search.found)
        if not still.any():
            break
        search = search.among(still)
    return left


@dataclass(eq=False)
class _Search:
    """The impulses of all steps that are not settled yet; axes are (step, unknown)."""

    step: Index
    flat: Array
    """What unit impulses give, (step, row, unknown)."""
    size: Array
    """Eigenvalues of the normal equations."""
    turn: Array
    """Their eigenvectors, (step, unknown, eigenvector)."""
    start: Array
    """Right-hand side of the normal equations."""
    weight: Array
    """Of the distance from the cones, (step, 1)."""
    least: Array
    most: Array
    cones: Cones
    found: Array
    """Impulses within the cones."""
    off: Array
    """Sum of the distances from them so far."""

    def go_on(self) -> Mask:
        """Iterate, let the weight suit how far both demands are from being met, and tell which are.

        The demands are that the best impulses are within the cones, and that they stay as they are.
        """
        back = np.swapaxes(self.turn, 1, 2)
        for _ in range(_LOOK):
            aim = self.start + self.weight * (self.found - self.off)
            best = _of(self.turn, _of(back, aim) / (self.size + self.weight))
            ahead = _RELAXED * best + (1.0 - _RELAXED) * self.found + self.off
            before, shape = self.found, (*self.cones.least.shape, 3)
            self.found = self.cones.nearest(ahead.reshape(shape)).reshape(ahead.shape)
            self.off = ahead - self.found
        apart, moved = _size(self.found - best), _size(self.found - before)
        ratio = np.sqrt(np.maximum(apart, _TINY) / np.maximum(moved, _TINY))
        weight = np.clip(self.weight * np.clip(ratio, 1.0 / _MILD, _MILD), self.least, self.most)
        late = apart > _SAME * _size(best)
        late |= self.weight * moved > _SAME * _size(self.start)
        self.off = self.off * self.weight / weight
        self.weight = weight
        return np.asarray(late[:, 0])

    def among(self, picks: Mask) -> _Search:
        """Go on with some of the steps."""
        return _Search(**{key: value[picks] for key, value in vars(self).items()})


def _of(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _size(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1, keepdims=True))


def _into_wedge(across: Array, up: Array, slope: Array | float) -> tuple[Array, Array]:
    """Project (across, up) to across ≤ slope · up: the share of across that is left, and up."""
    inside, beyond = across <= slope * up, slope * across <= -up
    top = np.maximum((slope * across + up) / (1.0 + np.square(slope)), 0.0)
    share = slope * top / np.maximum(across, np.finfo(float).tiny)
    return (
        np.where(inside, 1.0, np.where(beyond, 0.0, share)),
        np.where(inside, up, np.where(beyond, 0.0, top)),
    )


_DEPENDENT = 1e-3  # of the largest singular value: directions that impulses hardly reach
_IMPACT = 5e-3  # of an impact's impulse: tumbling cars leave up to 3.4e-3, in MuJoCo
_FAINT = 0.05  # of the weight: less of it is hardly a contact, whose impulse says little
_SURE = 1e-3  # of the weight: what motion within a step may leave open where drifts add up


@dataclass(frozen=True, eq=False)
class _Left:
    """What is left over in the steps of a group, in N·s; axes are (trajectory, step, …)."""

    rows: Array
    """Impulse, its moment over the longest arm, spins over radii (or that arm), (…, row)."""
    given: Array
    """The same of what was gained, (…, row)."""
    columns: Array
    """What unit impulses at the spheres give of it, (…, row, sphere, 3)."""
    scale: Array
    """The vertical impulse, or the weight's where that is larger, (…)."""
    vague: Array
    """What motion within the step leaves open, (…)."""
    beside: Array
    """What it leaves open besides of the impulses' sizes and directions, beside impacts, (…)."""
    axles: list[Axle]
    flying: Mask
    """Steps in which nothing touches, (…)."""
    known: Mask
    """Steps whose two frames are finite, (…)."""


@check("balance", "balance")
def balance(record: Record) -> Figures:
    """Measure what no impulses at spheres that touch explain, over the weight's or their own.

    None without contact, or where something else supports what may touch.
    """
    groups = [(push, _left_of(record, push)) for push in pushes_of(record)]
    return _figures(record, [(push, left, _parts(left)) for push, left in groups])


@check("balance drift", "balance")
def balance_drift(record: Record) -> Figures:
    """Add up what is not explained of spins about axles, over the impulse of the weight in a step.

    A small torque that is always there shows in it. None without bodies of revolution on axles.
    """
    groups = [(push, _left_of(record, push)) for push in pushes_of(record)]
    return _figures(record, [(push, left, _drifts(record, push, left)) for push, left in groups])


@check("cones", "balance")
def cones(record: Record) -> Figures:
    """Measure what no impulses within Coulomb's cones explain, over the weight's or their own.

    Impulses that push, with friction within μ times the push, and with just so much against the
    slip of a sphere that slips through the whole step. None as of `balance`.
    """
    found = []
    for push in pushes_of(record):
        left = _left_of(record, push)
        rows = _confined(left, cones_of(record, push))
        found.append((push, left, _parts(replace(left, rows=rows, vague=left.vague + left.beside))))
    return _figures(record, found)


def _figures(record: Record, groups: list[tuple[Push, _Left, dict[str, Array]]]) -> Figures:
    names = [f"{name}, {push.name}" for push, _, parts in groups for name in parts]
    columns = [
        np.where(left.known, part, np.nan) for _, left, parts in groups for part in parts.values()
    ]
    return Figures(record.by_step(columns), names)


def _parts(left: _Left) -> dict[str, Array]:
    """Impulse, moment and spins left over, each over the scale, (trajectory, step)."""
    impulse, moment = (np.linalg.norm(left.rows[..., k : k + 3], axis=-1) for k in (0, 3))
    # In flight it is a matter for `momentum`, whose budget goes with the order of the method.
    moment = np.where(left.flying, 0.0, moment)
    off = {"impulse": impulse - left.vague, "moment": moment - left.vague}
    for axle, spin in zip(left.axles, np.moveaxis(left.rows[..., 6:], -1, 0), strict=True):
        off[axle.name] = np.abs(spin) - (0.0 if axle.sphere is None else left.vague)
    return {name: np.maximum(part, 0.0) / left.scale for name, part in off.items()}


def _drifts(record: Record, push: Push, left: _Left) -> dict[str, Array]:
    """Sums up to each step over the weight's impulse, (trajectory, step)."""
    weight = push.mass * record.usual_pull * record.frame
    spins = np.moveaxis(left.rows[..., 6:], -1, 0)
    sure = left.vague < _SURE * weight
    return {
        axle.name: np.abs(np.cumsum(spin * (sure | (axle.sphere is None)), axis=1)) / weight
        for axle, spin in zip(left.axles, spins, strict=True)
    }


@functools.lru_cache(maxsize=4)
def _left_of(record: Record, push: Push) -> _Left:
    """Take off what impulses at the spheres explain, and what acts without contact.

    The latter since near soft contact velocities may belong to a moment beside the frame's.
    """
    gains, axles = gains_of(record, push), axles_of(record.mechanism, push)
    size = float(np.nanmax(rotation.norm(gains.arm), initial=np.finfo(float).tiny))
    radii = np.array([axle.radius or size for axle in axles])
    given = np.concatenate([gains.linear, gains.angular / size, gains.spin / radii], axis=-1)
    known = np.isfinite(given).all(axis=-1) & np.isfinite(gains.arm).all(axis=(2, 3))
    given = np.where(known[..., None], given, 0.0)
    up, weight = np.maximum(given[..., 2], 0.0), push.mass * record.usual_pull * record.frame
    faint = gains.touches.any(axis=2) & (up < _FAINT * weight)
    given[faint, 2] = 0.0
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
    return _Left(
        rows=_unexplained(columns, given),
        given=given,
        columns=columns,
        scale=np.maximum(up, weight),
        vague=vague + np.where(faint, _FAINT * weight, np.where(quiet, 0.0, _IMPACT * up)),
        beside=np.where(faint | quiet | flying, 0.0, _IMPACT * beside),
        axles=axles,
        flying=flying,
        known=known,
    )


def _columns(arm: Array, axles: int) -> Array:
    """What unit impulses at the spheres give, (trajectory, step, row, sphere, 3)."""
    columns = np.zeros((*arm.shape[:2], 6 + axles, *arm.shape[2:]))
    x, y, z = np.moveaxis(arm, -1, 0)
    for k in range(3):
        columns[..., k, :, k] = 1.0
    columns[..., 3, :, 1], columns[..., 3, :, 2] = -z, y
    columns[..., 4, :, 0], columns[..., 4, :, 2] = z, -x
    columns[..., 5, :, 0], columns[..., 5, :, 1] = -y, x
    return columns


def _unexplained(columns: Array, given: Array) -> Array:
    """Rest of a least-squares solution, (trajectory, step, row)."""
    some = columns.any(axis=(2, 3, 4))
    flat = columns[some].reshape(-1, columns.shape[2], 3 * columns.shape[3])
    fall = np.zeros((*flat.shape[:2], 1))
    fall[:, 2] = 1.0
    turn, size, _ = np.linalg.svd(np.concatenate([flat, fall], axis=-1), full_matrices=False)
    turn = turn * (size > _DEPENDENT * size[:, :1])[:, None]
    left = given.copy()
    left[some] -= np.einsum("src,sqc,sq->sr", turn, turn, given[some], optimize=True)
    return left


def _confined(left: _Left, cones: Cones) -> Array:
    """Rest of the best impulses within the cones, (trajectory, step, row)."""
    some, rows = ~left.flying, left.given.copy()
    rows[some] = unexplained(left.columns[some], left.given[some], cones[some])
    return rows

"""What spheres that touch the ground may get of it in a step, and which of it explains a gain best.

The ground only pushes, and friction is no more than μ times the push: Coulomb's cone. Against a
sphere that slips through the whole step friction is just so much and opposite to the slip. What a
slip that turns collects in a step lies in the hull of an arc of the cone's edge, which is the part
of the cone ahead of a plane. Finding the best impulses in all of these is a convex problem; those
of all steps are solved at once by the alternating direction method of multipliers (Boyd et al.
2011, Foundations and Trends in Machine Learning 3, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.finding import Record
from mbds_xsim.checks.gains import gains_of
from mbds_xsim.checks.ground import Push

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

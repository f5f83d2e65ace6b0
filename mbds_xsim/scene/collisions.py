"""Which bodies may touch each other, and how they rebound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np

from mbds_xsim.base import bounds, rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError, UnknownName

if TYPE_CHECKING:
    from mbds_xsim.scene.mechanism import Mechanism
    from mbds_xsim.scene.scene import Scene

_EVEN = 1e-9
_MOST_PAIRS = 100_000
_TOO_MANY = "200 frames of so many pairs of spheres take 3 GB to check"


class Collisions(Neutral):
    """Which bodies' contact spheres touch each other; the coefficients are those of every pair."""

    pairs: tuple[tuple[str, str], ...]
    """Two bodies each: every contact sphere of the one touches every one of the other."""
    friction: Annotated[float, bounds.at_least_zero]
    """Coulomb's coefficient μ, isotropic."""
    restitution: Annotated[float, bounds.share]
    """Newton's coefficient e of the normal velocity, in [0, 1]."""


def check_collisions(collisions: Collisions, carriers: Sequence[str]) -> None:
    """Raise SceneError where a pair is not of two bodies with contact spheres, or comes twice."""
    seen: set[frozenset[str]] = set()
    spheres, found = Counter(carriers), 0
    if not collisions.pairs:
        raise SceneError("collisions.pairs: got none, allowed are one or more")
    for k, pair in enumerate(collisions.pairs):
        where = f"collisions.pairs[{k}]"
        for end, body in enumerate(pair):
            if body not in spheres:
                what = UnknownName.of("body with contact spheres", body, sorted(spheres))
                raise SceneError(f"{where}[{end}]: {what}")
        if len({*pair}) < 2 or frozenset(pair) in seen:
            msg = f"{where}: got {list(pair)}, allowed are two different bodies, each pair once"
            raise SceneError(msg)
        seen.add(frozenset(pair))
        found += spheres[pair[0]] * spheres[pair[1]]
    bounds.count("collisions.pairs · spheres", found, _MOST_PAIRS, _TOO_MANY)


def sphere_pairs(scene: Scene) -> Index:
    """Number the contact spheres that may touch each other, shape (pair, 2)."""
    of: dict[str, list[int]] = {}
    for k, sphere in enumerate(scene.contacts):
        of.setdefault(sphere.body, []).append(k)
    pairs = scene.collisions.pairs if scene.collisions else ()
    found = [(i, j) for one, other in pairs for i in of[one] for j in of[other]]
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def passed(mechanism: Mechanism, position: Array, native: Array) -> Mask:
    """Tell whether a contact sphere is past what it touches, its centre in it; shape (…).

    Args:
        mechanism: Whose spheres.
        position: Centres of mass, shape (…, body, 3).
        native: Rotations of the native frames, shape (…, body, 4).
    """
    body, radius = mechanism.sphere_body, mechanism.sphere_radius
    place = position[..., body, :] + rotation.rotate(native[..., body, :], mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    apart = rotation.norm(place[..., one, :] - place[..., other, :])
    inside = apart < np.maximum(radius[one], radius[other])
    sunk = place[..., 2] < (0.0 if mechanism.scene.ground else -np.inf)
    return np.asarray(inside.any(axis=-1) | sunk.any(axis=-1))


def has_known_impacts(mechanism: Mechanism) -> bool:
    """Whether what is rigid has one motion through all impacts.

    That of balls on the ground has, and of balls with even inertia that touch each other alone.
    """
    scene = mechanism.scene
    if not mechanism.has_only_balls or (scene.ground and scene.collisions):
        return False
    moments = np.linalg.eigvalsh(mechanism.inertia)
    even = np.ptp(moments, axis=1) <= _EVEN * moments.max(axis=1)
    return scene.ground is not None or bool(even.all())


def count_pairs(mechanism: Mechanism) -> int:
    """Count the pairs that may touch: of spheres and the ground, and of spheres."""
    grounded = mechanism.scene.ground is not None
    return len(mechanism.sphere_body) * grounded + len(mechanism.sphere_pairs)

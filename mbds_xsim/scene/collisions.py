"""Collisions between bodies: the pairs that may touch, and their coefficients."""

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
    """Pairs of bodies whose contact spheres can touch; all pairs have the same coefficients."""

    pairs: tuple[tuple[str, str], ...]
    """Pairs of bodies; every contact sphere of one can touch every sphere of the other."""
    friction: Annotated[float, bounds.at_least_zero]
    """Coulomb's coefficient μ, isotropic."""
    restitution: Annotated[float, bounds.share]
    """Newton's coefficient e of the normal velocity, in [0, 1]."""


def check_collisions(collisions: Collisions, carriers: Sequence[str]) -> None:
    """Raise SceneError unless all pairs differ and consist of two bodies with contact spheres."""
    pairs: set[frozenset[str]] = set()
    spheres, count = Counter(carriers), 0
    if not collisions.pairs:
        raise SceneError("collisions.pairs: got none, allowed are one or more")
    for k, pair in enumerate(collisions.pairs):
        where = f"collisions.pairs[{k}]"
        for end, body in enumerate(pair):
            if body not in spheres:
                fault = UnknownName.of("body with contact spheres", body, sorted(spheres))
                raise SceneError(f"{where}[{end}]: {fault}")
        if len({*pair}) < 2 or frozenset(pair) in pairs:
            msg = f"{where}: got {list(pair)}, allowed are two different bodies, each pair once"
            raise SceneError(msg)
        pairs.add(frozenset(pair))
        count += spheres[pair[0]] * spheres[pair[1]]
    bounds.count("collisions.pairs · spheres", count, _MOST_PAIRS, _TOO_MANY)


def sphere_pairs(scene: Scene) -> Index:
    """Return the indices of contact spheres that may touch each other, shape (pair, 2)."""
    spheres: dict[str, list[int]] = {}
    for k, sphere in enumerate(scene.contacts):
        spheres.setdefault(sphere.body, []).append(k)
    pairs = scene.collisions.pairs if scene.collisions else ()
    indices = [(i, j) for one, other in pairs for i in spheres[one] for j in spheres[other]]
    return np.array(indices, dtype=np.int64).reshape(-1, 2)


def passed(mechanism: Mechanism, position: Array, native: Array) -> Mask:
    """Return whether a sphere's centre is below the ground or inside another sphere, shape (…).

    Args:
        mechanism: The mechanism.
        position: Centres of mass, shape (…, body, 3).
        native: Rotations of the native frames, shape (…, body, 4).
    """
    body, radius = mechanism.sphere_body, mechanism.sphere_radius
    place = position[..., body, :] + rotation.rotate(native[..., body, :], mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    distance = rotation.norm(place[..., one, :] - place[..., other, :])
    inside = distance < np.maximum(radius[one], radius[other])
    sunk = place[..., 2] < (0.0 if mechanism.scene.ground else -np.inf)
    return np.asarray(inside.any(axis=-1) | sunk.any(axis=-1))


def has_known_impacts(mechanism: Mechanism) -> bool:
    """Return whether rigid bodies have a unique motion through all impacts.

    This holds for balls on the ground, and for balls of isotropic inertia that touch only each
    other.
    """
    scene = mechanism.scene
    if not mechanism.has_only_balls or (scene.ground and scene.collisions):
        return False
    moments = np.linalg.eigvalsh(mechanism.inertia)
    even = np.ptp(moments, axis=1) <= _EVEN * moments.max(axis=1)
    return scene.ground is not None or bool(even.all())


def count_pairs(mechanism: Mechanism) -> int:
    """Count the pairs that may touch: sphere and ground, and two spheres."""
    grounded = mechanism.scene.ground is not None
    return len(mechanism.sphere_body) * grounded + len(mechanism.sphere_pairs)

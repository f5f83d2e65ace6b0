"""The spanning tree, cut into multibodies that Bullet can hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint

from .carriers import carrier_counts

# Bullet's server passes states in arrays of 128 coordinates, 7 of them the base's; beyond them
# it accesses other memory (MAX_DEGREE_OF_FREEDOM in SharedMemoryPublic.h).
COORDINATE_LIMIT = 128 - 7

FREEDOMS = {"ball": 3, "hinge": 1, "slider": 1, "fixed": 0}
"""Number of rates of a joint, by its kind."""
_COORDINATES = {"ball": 4, "hinge": 1, "slider": 1, "fixed": 1}
# Joints that a constraint can replace, best first.
_CUT_ORDER = {"ball": 0, "hinge": 1, "fixed": 2}
# Distance of the two points that close a hinge from its anchor, over the longest arm there.
_HINGE_ARM = 0.5
# Least such arm over the scene's length: bodies may be centred on the hinge.
_LEAST_ARM = 0.1


@dataclass(frozen=True)
class Multibody:
    """A multibody of Bullet: a base and the links on it."""

    base: int
    """Base body; −1 for a fixed base at the world's origin."""
    links: tuple[Link, ...]
    """Links in Bullet's order, parents before children."""

    @property
    def geared(self) -> list[tuple[PlacedJoint, int]]:
        """Joints with rotors, and the bodies they carry; rotors are links after those of bodies."""
        joints = [(link.joint, link.body) for link in self.links]
        return [(joint, body) for joint, body in joints if joint and joint.armature]

    @property
    def coordinate_count(self) -> int:
        """Number of rates of the base, of all joints and of rotors."""
        base = 0 if self.base == WORLD_INDEX else 6
        joints = sum(FREEDOMS[link.joint.kind] for link in self.links if link.joint)
        return base + joints + len(self.geared)


def split(mechanism: Mechanism) -> tuple[tuple[Multibody, ...], tuple[PlacedJoint, ...]]:
    """Return the parts, and the tree joints that have to become constraints instead.

    Each joint on the world starts a part, and so does each free body: a constraint then acts on
    few coordinates. Parts that are too large are cut further.

    Raises:
        Unsupported: A body carries more joints that cannot be cut, or spheres, than can be held.
    """
    cut = _cuts(mechanism)
    root: dict[int, int] = {}
    for link in mechanism.links:
        starts = link.parent == WORLD_INDEX or link.body in cut
        root[link.body] = link.body if starts else root[link.parent]
    parts = []
    for first in mechanism.links:
        if root[first.body] != first.body:
            continue
        links = tuple(link for link in mechanism.links if root[link.body] == first.body)
        # A body that is free or cut off is the base, without a link of its own. Links come parents
        # first, so it is the first of them.
        fixed = first.joint is not None and first.body not in cut
        parts.append(Multibody(WORLD_INDEX, links) if fixed else Multibody(first.body, links[1:]))
    joints = [link.joint for link in mechanism.links if link.body in cut and link.joint is not None]
    return tuple(parts), tuple(joints)


def _cuts(mechanism: Mechanism) -> set[int]:
    """Find the bodies to cut off their tree parents, from the tips inwards."""
    load: dict[int, int] = {}
    carried: dict[int, list[Link]] = {link.body: [] for link in mechanism.links}
    cut: set[int] = set()
    carriers = carrier_counts(mechanism).tolist()
    for link in reversed(mechanism.links):
        count = 0 if link.joint is None else _COORDINATES[link.joint.kind]
        count += bool(link.joint and link.joint.armature) + carriers[link.body]
        children = carried[link.body]
        load[link.body] = count + sum(load[child.body] for child in children)
        while load[link.body] > COORDINATE_LIMIT:
            heaviest = _best_cut(mechanism, link, children, load)
            children.remove(heaviest)
            cut.add(heaviest.body)
            load[link.body] -= load[heaviest.body]
        if link.parent != WORLD_INDEX:
            carried[link.parent].append(link)
    return cut


def _best_cut(mechanism: Mechanism, link: Link, children: list[Link], load: dict[int, int]) -> Link:
    choices = [
        child
        for child in children
        if child.joint and child.joint.kind in _CUT_ORDER and not child.joint.is_loaded
    ]
    if not choices:
        name = mechanism.scene.bodies[link.body].name
        raise Unsupported(
            f"pybullet: body {name!r} carries more sliders, joints with springs, dampers or "
            f"couplings, or sixteens of contact spheres, than the {COORDINATE_LIMIT} coordinates "
            "that a multibody can hold, and Bullet has no constraint to replace one"
        )
    return min(
        choices,
        key=lambda child: (_CUT_ORDER[child.joint.kind] if child.joint else 0, -load[child.body]),
    )


def hinge_arm(mechanism: Mechanism, joint: PlacedJoint) -> float:
    """Return how far from the anchor of a hinge the two points lie that close it [m]."""
    arms = np.linalg.norm([joint.in_child, joint.in_parent], axis=1)
    return _HINGE_ARM * float(arms.max(initial=_LEAST_ARM * mechanism.scene.length))


def principal_axes(tensor: Array) -> tuple[Array, Array]:
    """Return principal moments, and the rotation of principal axes against the native frame."""
    moments = np.diag(tensor)
    if np.abs(tensor - np.diag(moments)).max() <= 1e-14 * moments.max():
        return moments, rotation.IDENTITY
    moments, axes = np.linalg.eigh(tensor)
    axes[:, 2] *= np.linalg.det(axes)
    return moments, rotation.from_matrix(axes)


def to_world(reading: Array, body: int, point: Array) -> Array:
    """Return a point of an inertial frame in W, given what `Multibodies.read` returns."""
    if body == WORLD_INDEX:
        return point
    return np.asarray(reading[body, :3] + rotation.rotate(reading[body, [6, 3, 4, 5]], point))


def axis_of(joint: PlacedJoint) -> list[float]:
    """Return the axis of a hinge or slider; Bullet requires some axis for the others, too."""
    return joint.axis.tolist() if joint.kind in ("hinge", "slider") else [0.0, 0.0, 1.0]

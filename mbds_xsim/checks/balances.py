"""Components of momentum that only forces, gravity and torques change."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.spanning import connected

_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Balance:
    """Components of a group's momentum that only forces, gravity and torques change."""

    name: str
    bodies: tuple[int, ...]
    directions: Array
    """Unit vectors in W, shape (component, 3)."""
    about: Array | None = None
    """Point of the world that angular momentum is about, shape (3,); None: the centre of mass."""
    angular: bool = False


@functools.lru_cache(maxsize=64)
def balances_of(mechanism: Mechanism) -> list[Balance]:
    """Find the components of momentum that the scene's supports cannot change.

    Joints, links and springs connect bodies to groups. Collisions connect these to larger ones,
    whose momentum they conserve. A free group has all components, angular ones about its centre of
    mass. Ball joints, distance links and springs to the world pull at points and have no moment
    about a line through all of them; nor has a hinge along it. Sliders leave the momentum along
    them. Groups with a loaded joint to the world (`PlacedJoint.is_loaded`) are left out.
    """
    balances: list[Balance] = []
    for group, name in _named_groups(mechanism).items():
        joints, points = _supports(mechanism, set(group))
        if any(joint.is_loaded for joint in joints):
            continue
        sliders = [joint for joint in joints if joint.kind == "slider"]
        if not joints and not points:
            balances.append(Balance(f"linear momentum, {name}", group, np.eye(3)))
            balances.append(Balance(f"angular momentum, {name}", group, np.eye(3), angular=True))
        elif sliders:
            if len(sliders) == len(joints) and not points and _parallel(sliders):
                along = sliders[0].axis[None]
                balances.append(Balance(f"linear momentum, {name}", group, along))
        elif all(joint.kind != "fixed" for joint in joints):
            points += [joint.anchor for joint in joints]
            free = _directions(points, [joint for joint in joints if joint.kind == "hinge"])
            if len(free):
                title = f"angular momentum, {name}"
                balances.append(Balance(title, group, free, points[0], angular=True))
    return balances


def groups_of(mechanism: Mechanism, *, colliding: bool = False) -> list[tuple[int, ...]]:
    """Return groups of bodies that joints, distance links and springs connect, without the world.

    Args:
        mechanism: Mechanism with the bodies.
        colliding: Whether bodies that may touch each other count as connected, too.
    """
    pairs = [(joint.parent, joint.child) for joint in mechanism.joints]
    pairs += [pair.bodies for pair in (*mechanism.distances, *mechanism.springs)]
    if colliding:
        pairs += [(int(a), int(b)) for a, b in mechanism.sphere_body[mechanism.sphere_pairs]]
    return connected(mechanism.body_count, pairs)


def _named_groups(mechanism: Mechanism) -> dict[tuple[int, ...], str]:
    names = [body.name for body in mechanism.scene.bodies]
    group_names = {group: names[group[0]] for group in groups_of(mechanism)}
    for group in groups_of(mechanism, colliding=True):
        group_names.setdefault(group, f"{names[group[0]]} and what it collides with")
    return group_names


def _supports(mechanism: Mechanism, group: set[int]) -> tuple[list[PlacedJoint], list[Array]]:
    """Return joints between a group and the world, and points of the world that pull at it."""
    joints = [
        joint
        for joint in mechanism.joints
        if WORLD_INDEX in (joint.parent, joint.child) and group & {joint.parent, joint.child}
    ]
    points = [
        pair.in_body[pair.bodies.index(WORLD_INDEX)]
        for pair in (*mechanism.distances, *mechanism.springs)
        if WORLD_INDEX in pair.bodies and group & set(pair.bodies)
    ]
    return joints, points


def _directions(points: list[Array], hinges: list[PlacedJoint]) -> Array:
    """Find axes through the first point about which no support has a moment, shape (any, 3)."""
    offsets = np.array(points) - points[0]
    lengths = np.linalg.norm(offsets, axis=1)
    far = int(lengths.argmax())
    if hinges:
        line = hinges[0].axis
    elif lengths[far] > _SAME:
        line = offsets[far] / lengths[far]
    else:
        return np.eye(3)
    aligned = _parallel(hinges) and (np.linalg.norm(np.cross(offsets, line), axis=1) < _SAME).all()
    return line[None] if aligned else np.empty((0, 3))


def _parallel(joints: list[PlacedJoint]) -> bool:
    return all(
        bool(np.linalg.norm(np.cross(joint.axis, joints[0].axis)) < _SAME) for joint in joints
    )

"""Conversion between body states and joint or spanning-tree coordinates, vectorised.

Engines that use reduced coordinates hold, for each link of `Mechanism.links`, the motion of the
body relative to its tree parent. `LinkStates` has that motion in one form for all joint kinds;
an adapter copies the columns its engine needs. The order is that of `Mechanism.links`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.state import Batch, Trajectory

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Bodies = int | list[int] | Index


@dataclass(frozen=True, eq=False)
class BodyStates:
    """Maximal coordinates with rotations of the native frames, in body order."""

    position: Array
    """Centres of mass in W [m], shape (…, body, 3)."""
    native: Array
    """Rotations of the native frames, shape (…, body, 4)."""
    velocity: Array
    """Velocities of the centres of mass in W [m/s], shape (…, body, 3)."""
    angular_velocity: Array
    """Angular velocities in W [rad/s], shape (…, body, 3)."""

    @staticmethod
    def of(mechanism: Mechanism, motion: Batch | Trajectory) -> BodyStates:
        """Return the starts of a batch, or the frames of a trajectory, as body states."""
        native = mechanism.native_rotation(motion.orientation)
        return BodyStates(motion.position, native, motion.velocity, motion.angular_velocity)

    @staticmethod
    def at_reference(mechanism: Mechanism) -> BodyStates:
        """Return bodies at rest at the reference pose."""
        still = np.zeros((mechanism.body_count, 3))
        native = np.tile(rotation.IDENTITY, (mechanism.body_count, 1))
        return BodyStates(mechanism.com.copy(), native, still, still.copy())

    def __getitem__(self, rows: Any) -> BodyStates:
        """Select states along their leading axes."""
        return self.each(lambda values: values[rows])

    def each(self, change: Callable[[Array], Array]) -> BodyStates:
        """Apply a function to all four arrays."""
        return BodyStates(*map(change, vars(self).values()))

    def with_world(self) -> BodyStates:
        """Append the world as a last body at rest, so that index −1 finds it."""
        zero = np.zeros(3)
        still = BodyStates(zero, rotation.IDENTITY, zero, zero)
        return BodyStates(*map(_followed, vars(self).values(), vars(still).values()))

    def arms(self, body: Bodies, offset: Array) -> Array:
        """Rotate offsets from centres of mass to points into W [m], shape (…, point, 3)."""
        return rotation.rotate(select_bodies(self.native, body), offset)

    def points(self, body: Bodies, offset: Array) -> Array:
        """Return points fixed in bodies, in W [m], shape (…, point, 3)."""
        return select_bodies(self.position, body) + self.arms(body, offset)

    def speeds(self, body: Bodies, offset: Array) -> Array:
        """Return the velocities of points fixed in bodies [m/s], shape (…, point, 3)."""
        spin = select_bodies(self.angular_velocity, body)
        return select_bodies(self.velocity, body) + rotation.cross(spin, self.arms(body, offset))


def select_bodies(values: Array, body: Bodies) -> Array:
    """Select bodies' values, preserving the memory layout."""
    return np.asarray(values.T[:, body].T)


def _followed(values: Array, last: Array) -> Array:
    """Append a body's values, preserving the memory layout."""
    shape = *values.shape[:-2], values.shape[-2] + 1, values.shape[-1]
    extended = np.empty_like(values, shape=shape)
    extended[..., :-1, :], extended[..., -1, :] = values, last
    return extended


def representatives(mechanism: Mechanism) -> dict[int, int]:
    """Map each body, and the world, to the one that stands for all that the tree welds to it."""
    first = {WORLD_INDEX: WORLD_INDEX}
    for link in mechanism.links:
        fixed = link.joint is not None and link.joint.kind == "fixed"
        first[link.body] = first[link.parent] if fixed else link.body
    return first


@dataclass(frozen=True, eq=False)
class LinkStates:
    """Motion of each body relative to its tree parent, in link order."""

    rotation: Array
    """Rotation from the child's to the parent's native frame (wxyz), shape (…, link, 4)."""
    angular_velocity: Array
    """Child's rate relative to the parent, in the child's native frame [rad/s], (…, link, 3)."""
    coordinate: Array
    """Hinge angle in (−π, π] [rad] or slider displacement [m], else 0, shape (…, link)."""
    rate: Array
    """Rate of the coordinate [rad/s or m/s], else 0, shape (…, link)."""
    position: Array
    """Centre of mass of a free body in W [m], else 0, shape (…, link, 3)."""
    velocity: Array
    """Velocity of a free body's centre of mass in W [m/s], else 0, shape (…, link, 3)."""

    @staticmethod
    def still(shape: tuple[int, ...]) -> LinkStates:
        """Return links at rest with all coordinates 0, shape (…, link), to be filled in."""
        turn = np.broadcast_to(rotation.IDENTITY, (*shape, 4)).copy()
        spin, place, speed = (np.zeros((*shape, 3)) for _ in range(3))
        return LinkStates(turn, spin, np.zeros(shape), np.zeros(shape), place, speed)


def joint_coordinate(joint: PlacedJoint, position: Array, native: Array) -> Array:
    """Return hinge angle in (−π, π] [rad] or slider displacement [m]; leading axes are kept."""
    (xp, qp), (xc, qc) = (
        (np.zeros(3), rotation.IDENTITY)
        if body == WORLD_INDEX
        else (position[..., body, :], native[..., body, :])
        for body in (joint.parent, joint.child)
    )
    if joint.kind == "slider":
        span = xc + rotation.rotate(qc, joint.in_child) - xp - rotation.rotate(qp, joint.in_parent)
        return np.asarray(np.sum(span * rotation.rotate(qp, joint.axis), axis=-1))
    return rotation.angle_about(rotation.multiply(rotation.conjugate(qp), qc), joint.axis)


def joint_rate(joint: PlacedJoint, world: BodyStates) -> Array:
    """Return the rate of a hinge or slider [rad/s or m/s], from states with the world."""
    parent, child = joint.parent, joint.child
    axis = world.arms(parent, joint.axis)
    relative = world.angular_velocity[..., child, :] - world.angular_velocity[..., parent, :]
    if joint.kind == "slider":
        anchor = world.points(child, joint.in_child)
        arm = anchor - world.position[..., parent, :]
        swing = rotation.cross(world.angular_velocity[..., parent, :], arm)
        relative = world.speeds(child, joint.in_child) - world.velocity[..., parent, :] - swing
    return np.asarray(np.sum(relative * axis, axis=-1))


def joint_turns(joint: PlacedJoint, world: BodyStates, frame: float) -> Array:
    """Return the angle that a hinge turns in each step [rad], shape (trajectory, step).

    A frame gives its angle up to full turns; the mean of the rates at the two ends of the step
    resolves these.
    """
    rate = joint_rate(joint, world)
    turn = np.diff(joint_coordinate(joint, world.position, world.native), axis=1)
    expected = 0.5 * (rate[:, 1:] + rate[:, :-1]) * frame
    return np.asarray(turn + 2 * np.pi * np.round((expected - turn) / (2 * np.pi)))


def coupling_gaps(mechanism: Mechanism, bodies: BodyStates) -> tuple[Array, Array]:
    """Return by how much followers deviate from their couplings, in coordinate and rate.

    Hinge angles are in (−π, π], so this is for starts. Shapes (…, coupling) [rad or m, and /s].
    """
    world, lead = bodies.with_world(), bodies.position.shape[:-2]
    off, rate = (np.empty((*lead, len(mechanism.couplings))) for _ in range(2))
    for k, coupling in enumerate(mechanism.couplings):
        follower, leader = (
            joint_coordinate(joint, bodies.position, bodies.native)
            for joint in (coupling.follower, coupling.leader)
        )
        off[..., k] = follower - coupling.ratio * leader - coupling.offset
        leading = joint_rate(coupling.leader, world)
        rate[..., k] = joint_rate(coupling.follower, world) - coupling.ratio * leading
    return off, rate


def joint_loads(mechanism: Mechanism, bodies: BodyStates, push: Array) -> tuple[Array, Array]:
    """Return the loads of joint springs, dampers and drives on the bodies.

    Hinge angles are taken in (−π, π].

    Args:
        mechanism: The mechanism.
        bodies: States, with any leading axes.
        push: Pushes of the drives (`PlacedDrive.pushes`), shape (…, drive).

    Returns:
        Forces on centres of mass [N] and moments about them [N·m], in W, shapes (…, body, 3).
    """
    world = bodies.with_world()
    force, moment = np.zeros_like(world.position), np.zeros_like(world.position)
    laws = [(joint, joint.effort) for joint in mechanism.compliant]
    laws += [
        (drive.joint, functools.partial(drive.effort, push[..., k]))
        for k, drive in enumerate(mechanism.drives)
    ]
    for joint, law in laws:
        coordinate = joint_coordinate(joint, bodies.position, bodies.native)
        effort = law(coordinate, joint_rate(joint, world))[..., None]
        load = effort * world.arms(joint.parent, joint.axis)
        slides = joint.kind == "slider"
        anchor = world.points(joint.child, joint.in_child)
        for body, sign in ((joint.child, 1.0), (joint.parent, -1.0)):
            arm = anchor - world.position[..., body, :]
            force[..., body, :] += sign * load if slides else 0.0
            moment[..., body, :] += sign * (rotation.cross(arm, load) if slides else load)
    return force[..., :-1, :], moment[..., :-1, :]


def rate_row(mechanism: Mechanism, joint: PlacedJoint, bodies: BodyStates) -> csr_array:
    """Return the row that maps twists to a hinge's or slider's rate, shape (1, 6 · body)."""
    from scipy.sparse import csr_array

    on_world = joint.parent == WORLD_INDEX
    axis = joint.axis if on_world else bodies.arms(joint.parent, joint.axis)
    # Blocks of the world are left out below.
    if joint.kind == "hinge":
        child, parent = [0.0, 0.0, 0.0, *axis], [0.0, 0.0, 0.0, *-axis]
    else:
        anchor = joint.in_child
        if joint.child != WORLD_INDEX:
            anchor = bodies.points(joint.child, joint.in_child)
        child = [*axis, *np.cross(anchor - bodies.position[joint.child], axis)]
        parent = [*-axis, *-np.cross(anchor - bodies.position[joint.parent], axis)]
    ends = [(joint.child, child), (joint.parent, parent)]
    values = np.array([block for body, block in ends if body != WORLD_INDEX]).reshape(-1)
    columns = [6 * body + k for body, _ in ends if body != WORLD_INDEX for k in range(6)]
    shape = (1, 6 * mechanism.body_count)
    return csr_array((values, ([0] * len(columns), columns)), shape=shape)


def coupling_rows(mechanism: Mechanism, bodies: BodyStates) -> list[csr_array]:
    """Return each coupling's row, whose product with the twists is 0, shape (1, 6 · body)."""

    def row(joint: PlacedJoint) -> csr_array:
        return rate_row(mechanism, joint, bodies)

    return [row(each.follower) - each.ratio * row(each.leader) for each in mechanism.couplings]


def to_links(mechanism: Mechanism, bodies: BodyStates) -> LinkStates:
    """Express body states in the coordinates of the spanning tree."""
    tree = _tree(mechanism)
    parent = bodies.with_world()[..., tree.parent_body, :]
    child = bodies[..., tree.body, :]
    back = rotation.conjugate(child.native)
    relative = child.angular_velocity - parent.angular_velocity
    coordinate, rate = np.zeros(child.position.shape[:-1]), np.zeros(child.position.shape[:-1])
    for k in tree.scalar:
        joint = mechanism.links[k].joint
        assert joint is not None
        coordinate[..., k] = joint_coordinate(joint, bodies.position, bodies.native)
        axis = rotation.rotate(parent.native[..., k, :], joint.axis)
        turning = relative[..., k, :]
        if joint.kind == "slider":
            arm = child.position[..., k, :] - parent.position[..., k, :]
            turning = (
                child.velocity[..., k, :]
                - parent.velocity[..., k, :]
                - rotation.cross(parent.angular_velocity[..., k, :], arm)
            )
        rate[..., k] = np.sum(turning * axis, axis=-1)
    free = tree.free[:, None]
    return LinkStates(
        rotation.multiply(rotation.conjugate(parent.native), child.native),
        rotation.rotate(back, relative),
        coordinate,
        rate,
        np.where(free, child.position, 0.0),
        np.where(free, child.velocity, 0.0),
    )


def to_bodies(mechanism: Mechanism, links: LinkStates) -> BodyStates:
    """Compute body states from tree coordinates (forward kinematics).

    Ball joints and free bodies read `rotation` and `angular_velocity`, free bodies `position` and
    `velocity` too, hinges and sliders only `coordinate` and `rate`.
    """
    tree = _tree(mechanism)
    # Only the recursion from parent to child runs link by link. Axis 0 is the link.
    native = _natives(tree, links)
    parent = _above(tree, native, rotation.IDENTITY)
    each = (slice(None), *(None for _ in native.shape[1:-1]))
    spin = rotation.rotate(native, np.moveaxis(links.angular_velocity, -2, 0))
    spin[~tree.turns_freely] = 0.0
    to_joint = rotation.rotate(parent, tree.in_parent[each])
    from_joint = rotation.rotate(native, tree.in_child[each])
    slide = np.zeros_like(spin)
    for k in tree.scalar:
        axis = rotation.rotate(parent[k], tree.axis[k])
        rate = links.rate[..., k, None] * axis
        if tree.hinge[k]:
            spin[k] = rate
        else:
            to_joint[k] += links.coordinate[..., k, None] * axis
            slide[k] = rate
    turning = _down(tree, spin)
    step = to_joint - from_joint
    swing = rotation.cross(_above(tree, turning, np.zeros(3)), to_joint)
    move = swing + slide - rotation.cross(turning, from_joint)
    step[tree.free] = np.moveaxis(links.position, -2, 0)[tree.free]
    move[tree.free] = np.moveaxis(links.velocity, -2, 0)[tree.free]
    return BodyStates(
        *(
            np.ascontiguousarray(np.moveaxis(values[tree.link_of_body], 0, -2))
            for values in (_down(tree, step), native, _down(tree, move), turning)
        )
    )


def _above(tree: _Tree, values: Array, world: Array) -> Array:
    """Return the value of each link's parent, or the world's."""
    still = np.broadcast_to(world, (1, *values.shape[1:]))
    return np.concatenate([values, still])[tree.parent_link]


def _natives(tree: _Tree, links: LinkStates) -> Array:
    """Return the rotations of the native frames, shape (link, …, 4)."""
    turn = np.moveaxis(links.rotation, -2, 0).copy()
    turn[~tree.turns_freely] = rotation.IDENTITY
    for hinge in np.flatnonzero(tree.hinge):
        angle = links.coordinate[..., hinge, None]
        turn[hinge] = rotation.from_vector(angle * tree.axis[hinge])
    for k, parent in enumerate(tree.parent_link):
        if parent >= 0:
            turn[k] = rotation.multiply(turn[parent], turn[k])
    return turn


def _down(tree: _Tree, steps: Array) -> Array:
    """Sum steps from the world to each link, shape (link, …, 3)."""
    total = steps.copy()
    for k, parent in enumerate(tree.parent_link):
        if parent >= 0:
            total[k] += total[parent]
    return total


class _Tree:
    """Links of the spanning tree as arrays, in link order."""

    def __init__(self, mechanism: Mechanism) -> None:
        links = mechanism.links
        kinds = np.array([link.joint.kind if link.joint else "free" for link in links])
        self.body = np.array([link.body for link in links])
        self.link_of_body = np.argsort(self.body)
        self.parent_body = np.array([link.parent for link in links])
        parent_link = self.link_of_body[self.parent_body]
        self.parent_link = np.where(self.parent_body == WORLD_INDEX, -1, parent_link)
        """Link of the parent; −1 if the parent is the world."""
        self.free = kinds == "free"
        self.turns_freely = self.free | (kinds == "ball")
        """Whether the link is a free body or has a ball joint."""
        self.hinge = kinds == "hinge"
        self.scalar = np.flatnonzero(self.hinge | (kinds == "slider"))
        """Links with one coordinate."""
        self.axis, self.in_parent, self.in_child = (
            np.array([getattr(link.joint, key) if link.joint else np.zeros(3) for link in links])
            for key in ("axis", "in_parent", "in_child")
        )


_tree = functools.lru_cache(maxsize=64)(_Tree)

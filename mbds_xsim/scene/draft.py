"""A trajectory while it is drawn, and the draws that move joints."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene import sampling_terms as terms
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.spanning import connected

UPRIGHT = 1.0 - 1e-9
"""Vertical part of the axis of a slider that lifts what it carries."""


@dataclass
class Draft:
    """A trajectory while it is drawn."""

    mechanism: Mechanism
    index: int
    interval: terms.Interval
    rng: np.random.Generator
    position: Array
    native: Array
    velocity: Array
    angular_velocity: Array
    force: Array
    torque: Array
    inputs: bool

    def body(self, name: str) -> int:
        """Give the position of a body."""
        return [body.name for body in self.mechanism.scene.bodies].index(name)

    def uniform(self, span: terms.Span) -> float:
        """Draw from the range that holds in the interval."""
        low, high = terms.span_of(span, self.interval)
        return float(self.rng.uniform(low, high))

    def uniforms(self, spans: Sequence[terms.Span], count: int) -> Array:
        """Draw from several ranges in turn, so many times over; shape (count, span)."""
        low, high = np.array([terms.span_of(span, self.interval) for span in spans]).T
        return np.asarray(low + (high - low) * self.rng.random((count, len(spans))))

    def move_rigidly(self, bodies: list[int], point: Array, turn: Array) -> None:
        """Turn bodies, poses and velocities together, about a point of W."""
        for values, origin in (
            (self.position, point),
            (self.velocity, np.zeros(3)),
            (self.angular_velocity, np.zeros(3)),
        ):
            values[bodies] = rotation.rotate(turn, values[bodies] - origin) + origin
        self.native[bodies] = rotation.multiply(turn, self.native[bodies])

    def add_twist(self, bodies: list[int], point: Array, rate: Array) -> None:
        """Add a rigid angular velocity about a point of W."""
        self.velocity[bodies] += rotation.cross(rate, self.position[bodies] - point)
        self.angular_velocity[bodies] += rate


@dataclass(frozen=True, eq=False)
class Drafts:
    """Trajectories of a mechanism while they are drawn, side by side."""

    mechanism: Mechanism
    each: list[Draft]
    """Their arrays are parts of those of all."""
    states: BodyStates
    """Shapes (trajectory, body, …)."""
    force: Array
    """[N], shape (trajectory, step, body, 3)."""
    torque: Array
    """[N·m], shape (trajectory, step, hinge)."""


def pose(term: terms.Pose, drawing: Draft) -> None:
    """Lead hinges and sliders to a coordinate, with all that hangs on them."""
    for name in term.joints:
        joint, point, axis = _placed(drawing, name)
        moved = outboard(drawing.mechanism, joint.child)
        amount = drawing.uniform(term.coordinate)
        spin, drift = np.zeros(3), np.zeros(3)
        if joint.parent != WORLD_INDEX:
            spin = drawing.angular_velocity[joint.parent].copy()
            arm = point - drawing.position[joint.parent]
            drift = drawing.velocity[joint.parent] + np.cross(spin, arm)
        # Relative to the parent, velocities turn along with the bodies.
        drawing.add_twist(moved, point, -spin)
        drawing.velocity[moved] -= drift
        if joint.kind == "hinge":
            drawing.move_rigidly(moved, point, rotation.from_vector(amount * axis))
        else:
            drawing.position[moved] += amount * axis
        drawing.velocity[moved] += drift
        drawing.add_twist(moved, point, spin)


def hinge_rate(term: terms.HingeRate, drawing: Draft) -> None:
    """Give hinges a rate."""
    mechanism = drawing.mechanism
    rates, driven = [], set()
    for name in term.joints:
        joint, point, axis = _placed(drawing, name)
        rates.append(drawing.uniform(term.rate))
        drawing.add_twist(outboard(mechanism, joint.child), point, rates[-1] * axis)
        driven.add(joint.child)
    if rates and any(term.travel):
        moved = {other for body in driven for other in carried_by(mechanism, body)}
        drawing.velocity[sorted(moved)] += np.mean(rates) * np.array(term.travel)


def lift(term: terms.Lift, drawing: Draft) -> None:
    """Move what a body carries up or down until the lowest contact sphere is at a height."""
    mechanism = drawing.mechanism
    moved = _lifted(drawing, drawing.body(term.body))
    own = np.isin(mechanism.sphere_body, moved)
    if not own.any():
        msg = f"sampling: {term.body!r} carries no contact sphere, by which to lift it"
        raise SceneError(msg)
    low = mechanism.sphere_heights(drawing.position, drawing.native) - mechanism.sphere_radius
    drawing.position[moved, 2] += drawing.uniform(term.height) - low[own].min()


def _lifted(drawing: Draft, body: int) -> list[int]:
    """Give what a free body's joints carry, or what an upright slider does."""
    mechanism = drawing.mechanism
    joint = next(link.joint for link in mechanism.links if link.body == body)
    if joint is not None and joint.kind == "slider":
        _, _, axis = _placed(drawing, joint.name)
        if abs(axis[2]) > UPRIGHT:
            return outboard(mechanism, body)
    return carried_by(mechanism, body)


def carried_by(mechanism: Mechanism, body: int) -> list[int]:
    """Bodies that joints connect to a free body, itself among them."""
    pairs = [(joint.parent, joint.child) for joint in mechanism.joints]
    group = next(group for group in connected(mechanism.body_count, pairs) if body in group)
    if any(WORLD_INDEX in ends and {*ends} & {*group} for ends in pairs):
        msg = f"sampling: {mechanism.scene.bodies[body].name!r} is held by the world, not free"
        raise SceneError(msg)
    return list(group)


@functools.lru_cache(maxsize=16)
def _tree_joints(mechanism: Mechanism) -> dict[str, PlacedJoint]:
    return {link.joint.name: link.joint for link in mechanism.links if link.joint is not None}


def _placed(drawing: Draft, name: str) -> tuple[PlacedJoint, Array, Array]:
    """Find a joint of the tree, and where its anchor and axis are now, in W."""
    joint = _tree_joints(drawing.mechanism).get(name)
    if joint is None:
        msg = f"sampling: the joint {name!r} closes a loop; it follows from the others"
        raise SceneError(msg)
    if joint.parent == WORLD_INDEX:
        return joint, joint.in_parent, joint.axis
    native = drawing.native[joint.parent]
    point = drawing.position[joint.parent] + rotation.rotate(native, joint.in_parent)
    return joint, point, rotation.rotate(native, joint.axis)


def outboard(mechanism: Mechanism, body: int) -> list[int]:
    """Return a body and all that the spanning tree hangs on it."""
    found = [body]
    for link in mechanism.links:
        if link.parent in found:
            found.append(link.body)
    return found

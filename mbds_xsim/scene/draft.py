"""Trajectories that are being drawn, and the draws that move joints."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene import sampling_terms as terms
from mbds_xsim.scene.coupling import PlacedCoupling, trains
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.spanning import connected

UPRIGHT = 1.0 - 1e-9
"""Least |z component| of a slider's unit axis with which it can lift bodies."""


@dataclass(frozen=True, eq=False)
class Drafts:
    """Several trajectories of a mechanism that are being drawn together."""

    mechanism: Mechanism
    states: BodyStates
    """Body states, with shapes (trajectory, body, …)."""
    force: Array
    """Forces [N], shape (trajectory, step, body, 3)."""
    torque: Array
    """Torques [N·m], shape (trajectory, step, hinge)."""
    inputs: bool
    """Whether drawn forces and torques act."""


class Draft:
    """A trajectory of several that are being drawn; its arrays are views of theirs."""

    def __init__(self, drafts: Drafts, row: int, index: int, seed: int) -> None:
        self.mechanism, self.inputs = drafts.mechanism, drafts.inputs
        self.interval = terms.INTERVALS[index % len(terms.INTERVALS)]
        self.rng = np.random.default_rng(np.random.SeedSequence([seed, index]))
        states = drafts.states[row]
        self.position, self.native = states.position, states.native
        self.velocity, self.angular_velocity = states.velocity, states.angular_velocity
        self.force, self.torque = drafts.force[row], drafts.torque[row]

    def body(self, name: str) -> int:
        """Return the index of a body."""
        return [body.name for body in self.mechanism.scene.bodies].index(name)

    def uniform(self, span: terms.Span) -> float:
        """Draw uniformly from the range of this trajectory's interval."""
        low, high = terms.span_of(span, self.interval)
        return float(self.rng.uniform(low, high))

    def uniforms(self, spans: Sequence[terms.Span], count: int) -> Array:
        """Draw `count` times from several ranges in turn; shape (count, span)."""
        low, high = np.array([terms.span_of(span, self.interval) for span in spans]).T
        return np.asarray(low + (high - low) * self.rng.random((count, len(spans))))

    def move_rigidly(self, bodies: list[int], point: Array, turn: Array) -> None:
        """Rotate poses and velocities of bodies rigidly about a point in W."""
        for values, origin in (
            (self.position, point),
            (self.velocity, np.zeros(3)),
            (self.angular_velocity, np.zeros(3)),
        ):
            values[bodies] = rotation.rotate(turn, values[bodies] - origin) + origin
        self.native[bodies] = rotation.multiply(turn, self.native[bodies])

    def add_twist(self, bodies: list[int], point: Array, rate: Array) -> None:
        """Add a rigid angular velocity about a point in W."""
        self.velocity[bodies] += rotation.cross(rate, self.position[bodies] - point)
        self.angular_velocity[bodies] += rate


def pose(term: terms.Pose, drawing: Draft) -> None:
    """Add a drawn amount to coordinates and to those that follow; all bodies outboard move."""
    for lead in term.joints:
        followers = _followers(drawing, lead)
        amount = drawing.uniform(term.coordinate)
        for name, ratio in [(lead, 1.0), *followers]:
            _move(drawing, name, ratio * amount)


def _move(drawing: Draft, name: str, amount: float) -> None:
    joint, point, axis = _placed(drawing, name)
    bodies = outboard(drawing.mechanism, joint.child)
    spin, drift = np.zeros(3), np.zeros(3)
    if joint.parent != WORLD_INDEX:
        spin = drawing.angular_velocity[joint.parent].copy()
        arm = point - drawing.position[joint.parent]
        drift = drawing.velocity[joint.parent] + np.cross(spin, arm)
    # Relative to the parent, velocities turn along with the bodies.
    drawing.add_twist(bodies, point, -spin)
    drawing.velocity[bodies] -= drift
    if joint.kind == "hinge":
        drawing.move_rigidly(bodies, point, rotation.from_vector(amount * axis))
    else:
        drawing.position[bodies] += amount * axis
    drawing.velocity[bodies] += drift
    drawing.add_twist(bodies, point, spin)


def hinge_rate(term: terms.HingeRate, drawing: Draft) -> None:
    """Add a drawn rate to hinges, and to what follows them."""
    mechanism = drawing.mechanism
    rates, children = [], set()
    for lead in term.joints:
        followers = _followers(drawing, lead)
        rates.append(drawing.uniform(term.rate))
        for name, ratio in [(lead, 1.0), *followers]:
            joint, point, axis = _placed(drawing, name)
            bodies = outboard(mechanism, joint.child)
            if joint.kind == "hinge":
                drawing.add_twist(bodies, point, ratio * rates[-1] * axis)
            else:
                drawing.velocity[bodies] += ratio * rates[-1] * axis
            children.add(joint.child)
    if rates and any(term.travel):
        bodies = sorted({other for body in children for other in carried_by(mechanism, body)})
        drawing.velocity[bodies] += np.mean(rates) * np.array(term.travel)


def lift(term: terms.Lift, drawing: Draft) -> None:
    """Raise or lower a body and those it carries until the lowest sphere is at a drawn height."""
    mechanism = drawing.mechanism
    bodies = _lifted(drawing, drawing.body(term.body))
    own = np.isin(mechanism.sphere_body, bodies)
    if not own.any():
        raise SceneError(f"sampling: {term.body!r} carries no contact sphere; a lift needs one")
    low = mechanism.sphere_heights(drawing.position, drawing.native) - mechanism.sphere_radius
    drawing.position[bodies, 2] += drawing.uniform(term.height) - low[own].min()


def _lifted(drawing: Draft, body: int) -> list[int]:
    """Return a free body and all jointed to it, or a body on an upright slider and all outboard."""
    mechanism = drawing.mechanism
    joint = next(link.joint for link in mechanism.links if link.body == body)
    if joint is not None and joint.kind == "slider":
        _, _, axis = _placed(drawing, joint.name)
        if abs(axis[2]) > UPRIGHT:
            return outboard(mechanism, body)
    return carried_by(mechanism, body)


def carried_by(mechanism: Mechanism, body: int) -> list[int]:
    """Return a free body and all bodies jointed to it; raise SceneError if the world holds it."""
    pairs = [(joint.parent, joint.child) for joint in mechanism.joints]
    group = next(group for group in connected(mechanism.body_count, pairs) if body in group)
    if any(WORLD_INDEX in ends and {*ends} & {*group} for ends in pairs):
        msg = f"sampling: {mechanism.scene.bodies[body].name!r} is held by the world, not free"
        raise SceneError(msg)
    return list(group)


@functools.lru_cache(maxsize=16)
def _tree_joints(mechanism: Mechanism) -> dict[str, PlacedJoint]:
    return {link.joint.name: link.joint for link in mechanism.links if link.joint is not None}


def _followers(drawing: Draft, name: str) -> list[tuple[str, float]]:
    """Return the joints that follow one that is drawn, with their ratios to it."""
    led, leads = _trains(drawing.mechanism)
    if name in leads:
        raise SceneError(
            f"sampling: the joint {name!r} follows {leads[name]!r}; draw that one alone"
        )
    return [(each.follower.name, each.ratio) for each in led.get(name, ())]


@functools.lru_cache(maxsize=16)
def _trains(mechanism: Mechanism) -> tuple[dict[str, list[PlacedCoupling]], dict[str, str]]:
    """Return what each joint leads, and what each follower follows in the end."""
    led = trains(mechanism.couplings)
    return led, {each.follower.name: lead for lead, train in led.items() for each in train}


def _placed(drawing: Draft, name: str) -> tuple[PlacedJoint, Array, Array]:
    """Find a joint of the tree with its present anchor and axis in W."""
    joint = _tree_joints(drawing.mechanism).get(name)
    if joint is None:
        raise SceneError(f"sampling: the joint {name!r} closes a loop; it follows from the others")
    if joint.parent == WORLD_INDEX:
        return joint, joint.in_parent, joint.axis
    native = drawing.native[joint.parent]
    point = drawing.position[joint.parent] + rotation.rotate(native, joint.in_parent)
    return joint, point, rotation.rotate(native, joint.axis)


def outboard(mechanism: Mechanism, body: int) -> list[int]:
    """Return a body and all its descendants in the spanning tree."""
    bodies = {body: None}
    for link in mechanism.links:
        if link.parent in bodies:
            bodies[link.body] = None
    return [*bodies]

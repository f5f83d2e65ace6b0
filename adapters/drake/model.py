"""The Drake model of a scene: the program that builds it, and its coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import LinkStates, representatives
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.simulate.columns import LinkColumns, link_kinds, links_of

from .contact import contact_lines
from .stepping import of_angles

_KINDS = {
    "hinge": "RevoluteJoint",
    "slider": "PrismaticJoint",
    "ball": "BallRpyJoint",
    "fixed": "WeldJoint",
}
_SPRINGS = {"hinge": "RevoluteSpring", "slider": "PrismaticSpring"}
_HEAD = """\
import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration, GeometrySet, HalfSpace, ProximityProperties, Sphere
)
from pydrake.math import RigidTransform
from pydrake.multibody import tree
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph, ContactModel, CoulombFriction, DiscreteContactApproximation
)
from pydrake.systems.framework import DiagramBuilder

builder = DiagramBuilder()
plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=%r)
plant.SetUseSampledOutputPorts(False)
plant.mutable_gravity_field().set_gravity_vector(%r)
world = plant.world_body()
bodies, joints, laws, rotors, springs, servos = {}, {}, {}, {}, [], []


def at(body, place):
    name, pose = f"frame {plant.num_frames()}", RigidTransform(np.array(place))
    return plant.AddFrame(tree.FixedOffsetFrame(name, body.body_frame(), pose))


def add_body(name, mass, inertia):
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia
    about = tree.RotationalInertia(xx, yy, zz, xy, xz, yz)
    held = tree.SpatialInertia.MakeFromCentralInertia(mass, np.zeros(3), about)
    return plant.AddRigidBody(name, held)

"""
_ANCHOR = """\
# A constraint on the world itself ends the process.
anchor = plant.AddRigidBody("anchor of loops", tree.SpatialInertia.SolidSphereWithMass(1.0, 1.0))
plant.WeldFrames(plant.world_frame(), anchor.body_frame())"""


def listing(mechanism: Mechanism, time_step: float, impact_steps: float) -> str:
    """Return the program that defines `system`, `plant`, `bodies` and `joints`.

    Args:
        mechanism: Mechanism with the model's spanning tree.
        time_step: Step of a plant that steps itself [s]; 0 if an integrator steps it.
        impact_steps: Number of steps that an impact takes; 0 for Drake's own contact.
    """
    lines = [_HEAD % (time_step, list(mechanism.scene.gravity))]
    # Drake refuses names that are empty, or used for a body and its free joint, or for two frames.
    # So names are numbers, and those of the scene are comments.
    for k, body in enumerate(mechanism.scene.bodies):
        properties = f"{float(mechanism.mass[k])!r}, {mechanism.inertia[k].tolist()}"
        lines.append(f"bodies[{k}] = add_body('body {k}', {properties})  # {body.name!r}")
    for link in mechanism.links:
        lines += _link(link)
    lines += _springs(mechanism)
    lines += _servos(mechanism)
    lines += _loops(mechanism)
    lines += contact_lines(mechanism, time_step, impact_steps)
    lines += ["plant.Finalize()", "system = builder.Build()", ""]
    return "\n".join(lines)


def _link(link: Link) -> Iterator[str]:
    joint, here = link.joint, f"joints[{link.body}]"
    if joint is None:
        ends = f"world.body_frame(), bodies[{link.body}].body_frame()"
        name = f"'free {link.body}'"
        yield f"{here} = plant.AddJoint(tree.QuaternionFloatingJoint({name}, {ends}))"
        return
    ends = f"{_frame(link.parent, joint.in_parent)}, {_frame(link.body, joint.in_child)}"
    more = {"ball": "", "fixed": ", RigidTransform()"}.get(
        joint.kind, f", {joint.axis.tolist()}, {_limits(joint)}damping={joint.damping!r}"
    )
    args = f"'joint {link.body}', {ends}{more}"
    yield f"{here} = plant.AddJoint(tree.{_KINDS[joint.kind]}({args}))  # {joint.name!r}"
    if joint.stiffness:
        law = f"{here}, {joint.rest!r}, {joint.stiffness!r}"
        spring = f"tree.{_SPRINGS[joint.kind]}({law})"
        yield f"laws[{link.body}] = plant.AddForceElement({spring})"
    # Drake takes the rotor of a joint with several actuators from one alone: its servos carry it.
    if joint.armature and not joint.driven:
        yield f"rotors[{link.body}] = plant.AddJointActuator('rotor {link.body}', {here})"
        yield f"rotors[{link.body}].set_default_rotor_inertia({joint.armature!r})"


def _limits(joint: PlacedJoint) -> str:
    if joint.limits is None:
        return ""
    return f"pos_lower_limit={joint.limits[0]!r}, pos_upper_limit={joint.limits[1]!r}, "


def _springs(mechanism: Mechanism) -> Iterator[str]:
    for s in mechanism.springs:
        ends = (f"{_body(k)}, {p.tolist()}" for k, p in zip(s.bodies, s.in_body, strict=True))
        law = f"{s.length!r}, {s.stiffness!r}, {s.damping!r}"
        spring = f"tree.LinearSpringDamper({', '.join(ends)}, {law})"
        yield f"springs.append(plant.AddForceElement({spring}))  # {s.name!r}"


def _servos(mechanism: Mechanism) -> Iterator[str]:
    """Yield actuators whose controllers act by the state at each step's end, within a limit."""
    native = mechanism.carried
    for k, drive in enumerate(mechanism.drives):
        limit = "np.inf" if drive.servo.limit is None else repr(drive.servo.limit)
        body, armature = native[drive.joint.index], drive.joint.armature
        args = f"'servo {k}', joints[{body}], {limit}"
        yield f"servos.append(plant.AddJointActuator({args}))  # {drive.joint.name!r}"
        gains = f"p={drive.servo.stiffness!r}, d={drive.servo.damping!r}"
        yield f"servos[-1].set_controller_gains(tree.PdControllerGains({gains}))"
        if armature:
            yield f"servos[-1].set_default_rotor_inertia({armature!r})"
            yield f"rotors[{body}] = servos[-1]"


def _loops(mechanism: Mechanism) -> Iterator[str]:
    """Yield constraints that tie points (two on a hinge's axis), frames and joints."""
    tied = {end for j in mechanism.loops for end in (j.parent, j.child)}
    if WORLD_INDEX in tied.union(*(pair.bodies for pair in mechanism.distances)):
        yield _ANCHOR
    welded = representatives(mechanism)
    for joint in mechanism.loops:
        if welded[joint.parent] != welded[joint.child]:  # bodies welded into one need no tie
            yield from _closure(mechanism, joint)
    for link in mechanism.distances:
        if welded[link.bodies[0]] != welded[link.bodies[1]]:
            ends = _ends(link.bodies, link.in_body)
            yield f"plant.AddDistanceConstraint({ends}, {link.length!r})  # {link.name!r}"
    native = mechanism.carried
    for each in mechanism.couplings:
        pair = f"joints[{native[each.follower.index]}], joints[{native[each.leader.index]}]"
        yield f"plant.AddCouplerConstraint({pair}, {each.ratio!r}, {each.offset!r})"


def _closure(mechanism: Mechanism, joint: PlacedJoint) -> Iterator[str]:
    bodies, points = (joint.parent, joint.child), (joint.in_parent, joint.in_child)
    if joint.kind == "fixed":
        ends = _ends(bodies, points, "RigidTransform({})")
        yield f"plant.AddWeldConstraint({ends})  # {joint.name!r}"
        return
    arm = mechanism.scene.length * joint.axis
    for off in (arm, -arm) if joint.kind == "hinge" else (np.zeros(3),):
        ends = _ends(bodies, (points[0] + off, points[1] + off))
        yield f"plant.AddBallConstraint({ends})  # {joint.name!r}"


def _ends(bodies: tuple[int, int], points: tuple[Array, Array], each: str = "{}") -> str:
    """Return the arguments of a constraint: two bodies and a point in each."""
    return ", ".join(
        f"{_body(body, 'anchor')}, {each.format(point.tolist())}"
        for body, point in zip(bodies, points, strict=True)
    )


def _body(body: int, world: str = "world") -> str:
    return world if body == WORLD_INDEX else f"bodies[{body}]"


def _frame(body: int, point: Array) -> str:
    return f"at({_body(body)}, {point.tolist()})"


class DrakeCoordinates:
    """Conversion between a plant's coordinates and the states of links.

    Ball joints have roll, pitch and yaw relative to a frame on their parent, which the stepper
    turns, and angular velocities along its axes. Free bodies have quaternions and velocities in W.

    Args:
        mechanism: Mechanism with the model's spanning tree.
        joints: Drake's joints by body.
        size: Number of coordinates and of velocities.
    """

    def __init__(self, mechanism: Mechanism, joints: dict[int, Any], size: tuple[int, int]) -> None:
        kinds, by_link = link_kinds(mechanism), [joints[link.body] for link in mechanism.links]
        q = np.array([joint.position_start() for joint in by_link])
        v = np.array([joint.velocity_start() for joint in by_link])
        spin = {"ball": 0, "free": 0}
        self._columns = LinkColumns(kinds, (q, v), size, turn={"free": 0}, spin=spin, shift=(4, 3))
        self.ball, self._free = links_of(kinds, "ball"), links_of(kinds, "free")
        self._ball_q = q[self.ball, None] + np.arange(3)
        self._spin_v = v[self._free, None] + np.arange(3)
        self.balls = [by_link[k] for k in self.ball]

    def of_links(self, links: LinkStates) -> tuple[Array, Array, Array]:
        """Return coordinates (…, nq), velocities (…, nv) and turns of ball frames (…, ball, 4)."""
        q, v = self._columns.of_links(links)
        turn, spin = links.rotation[..., self._free, :], links.angular_velocity[..., self._free, :]
        v[..., self._spin_v] = rotation.rotate(turn, spin)
        return q, v, links.rotation[..., self.ball, :]

    def to_links(self, q: Array, v: Array, turns: Array) -> LinkStates:
        """Return the states of links."""
        links = self._columns.to_links(q, v)
        rates, here = links.angular_velocity, of_angles(q[..., self._ball_q])
        links.rotation[..., self.ball, :] = rotation.multiply(turns, here)
        rates[..., self.ball, :] = _back(here, rates[..., self.ball, :])
        turn = links.rotation[..., self._free, :]
        turn /= rotation.norm(turn)[..., None]
        links.rotation[..., self._free, :] = turn
        rates[..., self._free, :] = _back(turn, rates[..., self._free, :])
        return links


def _back(turn: Array, vector: Array) -> Array:
    return rotation.rotate(rotation.conjugate(turn), vector)

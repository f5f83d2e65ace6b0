"""The Pinocchio model of a scene: the program that builds it, and its coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.simulate.columns import LinkColumns, link_kinds

_KINDS = {
    "hinge": "JointModelRevoluteUnaligned",
    "slider": "JointModelPrismaticUnaligned",
    "ball": "JointModelSpherical",
}
_HEAD = """\
import numpy as np
import pinocchio as pin


def at(x, y, z):
    return pin.SE3(np.eye(3), np.array([x, y, z]))


def add_body(name, joint, place, mass, inertia):
    held = pin.Inertia(mass, np.zeros(3), np.array(inertia))
    return model.addFrame(pin.Frame(name, joint, 0, at(*place), pin.FrameType.BODY, held))


def close(kind, first, point, second, other):
    kinds = {3: pin.ContactType.CONTACT_3D, 6: pin.ContactType.CONTACT_6D}
    ends = first, at(*point), second, at(*other)
    held = pin.RigidConstraintModel(kinds[kind], model, *ends, pin.ReferenceFrame.LOCAL)
    held.m_baumgarte_parameters.Kp, held.m_baumgarte_parameters.Kd = %s, %s
    return held


model = pin.Model()
model.gravity.linear = np.array(%s)
bodies, constraints = {}, []"""


@dataclass(frozen=True, eq=False)
class PinocchioLayout:
    """Places of bodies and links in the native model."""

    joint: Index
    """Joint that each body is fixed to, shape (body,)."""
    place: Array
    """Centre of mass of each body in that joint's frame [m], (body, 3); axes are parallel."""
    carrier: dict[int, int]
    """Joint of each link with coordinates, by its body; a free body's is the joint of its turn."""
    native: dict[int, int]
    """The same joints by index of the scene's joint."""

    def end(self, body: int, point: Array) -> tuple[int, list[float]]:
        """Return the joint, and the point in its frame, for a point in a native frame."""
        if body == WORLD_INDEX:
            return 0, point.tolist()
        return int(self.joint[body]), (self.place[body] + point).tolist()

    @staticmethod
    def of(mechanism: Mechanism) -> PinocchioLayout:
        """Number the joints as they are added: each branch to its end before the next."""
        joint = np.zeros(mechanism.body_count, dtype=int)
        place = np.zeros((mechanism.body_count, 3))
        carrier: dict[int, int] = {}
        native: dict[int, int] = {}
        count = 1
        for link in depth_first(mechanism):
            kind = link.joint.kind if link.joint else "free"
            if link.joint is not None and kind == "fixed":
                on_body = link.parent != WORLD_INDEX
                joint[link.body] = joint[link.parent] if on_body else 0
                place[link.body] = link.joint.in_parent - link.joint.in_child
                place[link.body] += place[link.parent] if on_body else 0.0
                continue
            count += 2 if kind == "free" else 1
            joint[link.body] = carrier[link.body] = count - 1
            if link.joint is not None:
                place[link.body] = -link.joint.in_child
                native[link.joint.index] = count - 1
        return PinocchioLayout(joint, place, carrier, native)


def depth_first(mechanism: Mechanism) -> Iterator[Link]:
    """Yield the links in the order that Pinocchio's joints must have."""
    below: dict[int, list[Link]] = {}
    for link in reversed(mechanism.links):
        below.setdefault(link.parent, []).append(link)
    stack = below.get(WORLD_INDEX, [])
    while stack:
        link = stack.pop()
        yield link
        stack += below.get(link.body, [])


def listing(mechanism: Mechanism, layout: PinocchioLayout, drift_time: float) -> str:
    """Return the program that defines `model`, `bodies` and `constraints`.

    Args:
        mechanism: Mechanism with the model's spanning tree.
        layout: Layout of the model.
        drift_time: Time in which loops that have drifted open are closed [s]; 0 for never.
    """
    stiffness, damping = (1 / drift_time**2, 2 / drift_time) if drift_time else (0.0, 0.0)
    lines = [_HEAD % (stiffness, damping, list(mechanism.scene.gravity))]
    for link in depth_first(mechanism):
        lines += _link(mechanism, layout, link)
    for joint in mechanism.loops:
        lines += _closure(mechanism, layout, joint)
    for joint in mechanism.rotors:
        place = f"model.idx_vs[{layout.native[joint.index]}]"
        lines.append(f"model.armature[{place}] = {joint.armature!r}  # {joint.name!r}")
    return "\n".join([*lines, ""])


def _link(mechanism: Mechanism, layout: PinocchioLayout, link: Link) -> Iterator[str]:
    name, joint = mechanism.scene.bodies[link.body].name, link.joint
    if joint is None:
        shift = f"model.addJoint(0, pin.JointModelTranslation(), at(0, 0, 0), {name + ' at'!r})"
        yield f"model.addJoint({shift}, pin.JointModelSpherical(), at(0, 0, 0), {name!r})"
    elif joint.kind == "fixed":
        yield f"# {joint.name!r} makes two bodies one."
    else:
        above, point = layout.end(link.parent, joint.in_parent)
        axis = f"np.array({joint.axis.tolist()})" if joint.kind != "ball" else ""
        kind = f"pin.{_KINDS[joint.kind]}({axis})"
        yield f"model.addJoint({above}, {kind}, at(*{point}), {joint.name!r})"
    place = f"{layout.joint[link.body]}, {layout.place[link.body].tolist()}"
    properties = f"{float(mechanism.mass[link.body])!r}, {mechanism.inertia[link.body].tolist()}"
    yield f"bodies[{link.body}] = add_body({name!r}, {place}, {properties})"


def _closure(mechanism: Mechanism, layout: PinocchioLayout, joint: PlacedJoint) -> Iterator[str]:
    """Tie a point, two on a hinge's axis, or a frame; bodies welded into one need no tie."""
    arm = mechanism.scene.length * joint.axis
    yield f"# {joint.name!r} closes a loop."
    for off in (arm, -arm) if joint.kind == "hinge" else (np.zeros(3),):
        first = layout.end(joint.parent, joint.in_parent + off)
        second = layout.end(joint.child, joint.in_child + off)
        if first[0] != second[0]:
            ends = f"{first[0]}, {first[1]}, {second[0]}, {second[1]}"
            yield f"constraints.append(close({6 if joint.kind == 'fixed' else 3}, {ends}))"


def columns(mechanism: Mechanism, layout: PinocchioLayout, model: Any) -> tuple[LinkColumns, Index]:
    """Return the columns of a model's coordinates, and those of the turns among its velocities.

    Pinocchio's quaternions are xyzw; angular velocities are in a body's own axes. A free body's
    translation is the joint before that of its turn.
    """
    kinds = link_kinds(mechanism)
    carriers = [layout.carrier.get(link.body, 0) for link in mechanism.links]
    q, v = np.array(model.idx_qs)[carriers], np.array(model.idx_vs)[carriers]
    turning = {"ball": 0, "free": 0}
    sizes, order = (model.nq, model.nv), (3, 0, 1, 2)
    held = LinkColumns(
        kinds, (q, v), sizes, turn=turning, spin=turning, shift=(-3, -3), order=order
    )
    return held, v[np.isin(kinds, list(turning)), None] + np.arange(3)

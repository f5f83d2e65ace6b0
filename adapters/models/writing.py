"""Scenes as models of other formats, each with what of the scene the format has no place for."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Fate, Written, gathered
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism
from mbds_xsim.scene.scene import WORLD, Scene
from mbds_xsim.scene.servo import Servo

from ..mujoco.contact import numbers
from ..mujoco.model import limit_force, mechanics, text

_SETTING = "how the scene is run, which no model says"
_START = "the model stands in the reference pose"
_NO_MODEL: dict[str, tuple[bool, str]] = {
    "forces": (True, "the format has no forces"),
    "torques": (True, "the format has no torques"),
    "noise": (True, "the format has no forces"),
    "contacts": (True, "an importing program has contact of its own"),
    "ground": (True, "an importing program has contact of its own"),
    "sampling": (True, _START),
    "clock": (False, _SETTING),
    "budget": (False, _SETTING),
    "dimension": (False, _SETTING),
    "anchors": (False, "drawn only"),
    "edges": (False, "drawn only"),
}
"""Fields of a scene that no format takes: whether they bear on the motion, and the reason."""
_URDF_JOINTS = {"hinge": "continuous", "slider": "prismatic", "fixed": "fixed", None: "floating"}
_URDF_LIMITED = {"hinge": "revolute", "slider": "prismatic"}
_URDF_LACKS = {"stiffness": "springs", "armature": "rotors", "restitution": "rebound from limits"}
_PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")
_NO_URDF = "URDF is a tree of links with hinges and sliders"


def to_mjcf(scene: Scene) -> Written:
    """Write MJCF; see `mbds_xsim.simulate.registry`."""
    mechanism = _without_servos(scene)
    root = Element("mujoco", model=scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    SubElement(root, "option", gravity=numbers(scene.gravity))
    mechanics(root, mechanism, np.zeros((mechanism.body_count, 3)), {}, {})
    if scene.servos:
        actuators = SubElement(root, "actuator")
        for servo in scene.servos:
            _servo(actuators, servo)
    fates = [*_common(scene), *_loops(mechanism), *_targets(scene)]
    return Written(text(root), gathered(fates))


def to_urdf(scene: Scene) -> Written:
    """Write URDF; see `mbds_xsim.simulate.registry`.

    Raises:
        InputError: A joint is of a kind that URDF does not have.
    """
    mechanism = _without_servos(scene)
    root = Element("robot", name=scene.name)
    SubElement(root, "link", name=WORLD)
    frames: dict[int, Array] = {WORLD_INDEX: np.zeros(3)}
    for link in mechanism.links:
        _urdf_link(root, mechanism, link, frames)
    fates = list(_common(scene))
    for key in ("distance_links", "springs"):
        names = tuple(item.name for item in getattr(scene, key))
        if names:
            fates.append(Fate(key, (), "dropped", _NO_URDF, True, names, len(names)))
    if loops := tuple(joint.name for joint in mechanism.loops):
        fates.append(Fate("joints", (), "dropped", _NO_URDF, True, loops, len(loops)))
    for joint in scene.joints:
        for key, what in _URDF_LACKS.items():
            if getattr(joint, key):
                reason = f"URDF has no {what}"
                fates.append(Fate("joints", (key,), "dropped", reason, True, (joint.name,)))
    for servo in scene.servos:
        fates.append(Fate("servos", (), "dropped", "URDF has no servos", True, (servo.joint,)))
    if scene.gravity != (0.0, 0.0, -9.81):
        fates.append(Fate("gravity", (), "dropped", "URDF has no gravity", True))
    return Written(text(root), gathered(fates))


def _common(scene: Scene) -> Iterator[Fate]:
    for key, (moves, reason) in _NO_MODEL.items():
        value = getattr(scene, key)
        if value and value != Scene.__struct_defaults__[_default_place(key)]:
            count = len(value) if isinstance(value, tuple) else 1
            yield Fate(key, (), "dropped", reason, moves, (), count)
    for joint in scene.joints:
        for key in ("start", "rate"):
            if getattr(joint, key):
                yield Fate("joints", (key,), "dropped", _START, True, (joint.name,))
    for body in scene.bodies:
        for key in ("velocity", "angular_velocity"):
            if getattr(body, key) is not None:
                yield Fate("bodies", (key,), "dropped", _START, True, (body.name,))
        if body.particles:
            reason = "one inertia; the particles are not in it by themselves"
            yield Fate("bodies", ("particles",), "kept", reason, True, (body.name,))


def _default_place(key: str) -> int:
    fields = Scene.__struct_fields__
    return fields.index(key) - (len(fields) - len(Scene.__struct_defaults__))


def _loops(mechanism: Mechanism) -> Iterator[Fate]:
    for joint in mechanism.loops:
        reason = "points of it are kept together, by a solver that is soft"
        yield Fate("joints", (), "approximated", reason, True, (joint.name,))
    for pair in mechanism.distances:
        reason = "a tendon of constant length, by a solver that is soft"
        yield Fate("distance_links", (), "approximated", reason, True, (pair.name,))
    for tie in mechanism.couplings:
        reason = "an equality of two joints, by a solver that is soft"
        yield Fate("couplings", (), "approximated", reason, True, (tie.name,))


def _without_servos(scene: Scene) -> Mechanism:
    """Give the mechanism with the springs and dampers that are its joints' own."""
    return Mechanism.of(msgspec.structs.replace(scene, servos=()))


def _servo(actuators: Element, servo: Servo) -> None:
    """Write a servo that is at its first target without a command, which moves the target."""
    push = servo.stiffness * servo.position[0] + servo.damping * servo.velocity[0]
    gain, bias = servo.stiffness or servo.damping, (push, -servo.stiffness, -servo.damping)
    element = SubElement(
        actuators,
        "general",
        joint=servo.joint,
        gainprm=repr(gain),
        biastype="affine",
        biasprm=numbers(bias),
    )
    limit_force(element, servo.limit)


def _targets(scene: Scene) -> Iterator[Fate]:
    for servo in scene.servos:
        if len({*servo.position}) > 1 or len({*servo.velocity}) > 1:
            reason = "the first target alone: an importing program has its own commands"
            yield Fate("servos", ("series",), "approximated", reason, True, (servo.joint,))


def _urdf_link(root: Element, mechanism: Mechanism, link: Link, frames: dict[int, Array]) -> None:
    """Write a link whose frame is at its joint and parallel to W, and the joint."""
    joint, body = link.joint, link.body
    kind = None if joint is None else joint.kind
    if kind not in _URDF_JOINTS:
        msg = f"the joint {joint.name if joint else ''!r} is a {kind} joint; {_NO_URDF}"
        raise InputError(msg)
    name = mechanism.scene.bodies[body].name
    com = mechanism.com[body]
    frames[body] = com if joint is None else com + joint.in_child
    element = SubElement(root, "link", name=name)
    inertial = SubElement(element, "inertial")
    SubElement(inertial, "origin", xyz=numbers(com - frames[body]), rpy="0 0 0")
    SubElement(inertial, "mass", value=repr(float(mechanism.mass[body])))
    tensor = mechanism.inertia[body]
    pairs = {
        "ixx": (0, 0),
        "ixy": (0, 1),
        "ixz": (0, 2),
        "iyy": (1, 1),
        "iyz": (1, 2),
        "izz": (2, 2),
    }
    SubElement(inertial, "inertia", {key: repr(float(tensor[at])) for key, at in pairs.items()})
    parent = WORLD if link.parent == WORLD_INDEX else mechanism.scene.bodies[link.parent].name
    hold = SubElement(root, "joint", name=joint.name if joint else f"{name} floats")
    hold.set("type", str(_URDF_JOINTS[kind]))
    SubElement(hold, "parent", link=parent)
    SubElement(hold, "child", link=name)
    SubElement(hold, "origin", xyz=numbers(frames[body] - frames[link.parent]), rpy="0 0 0")
    if joint is not None and joint.axis.any():
        SubElement(hold, "axis", xyz=numbers(joint.axis))
    if joint is not None and (joint.damping or joint.friction):
        law = {key: repr(getattr(joint, key)) for key in ("damping", "friction")}
        SubElement(hold, "dynamics", law)
    if joint is not None and joint.limits:
        hold.set("type", _URDF_LIMITED[joint.kind])
        lower, upper = map(repr, joint.limits)
        # Effort and velocity are required; nothing of ours is limited by them.
        SubElement(hold, "limit", lower=lower, upper=upper, effort="1e9", velocity="1e9")
    for tie in mechanism.couplings:
        if joint is not None and tie.follower.name == joint.name:
            law = {"multiplier": repr(tie.ratio), "offset": repr(tie.offset)}
            SubElement(hold, "mimic", {"joint": tie.leader.name} | law)

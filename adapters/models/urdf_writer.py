"""Scenes as URDF: the frame of a link is at its joint, parallel to W."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.xml import indented, numbers
from mbds_xsim.scene.imported import Fate, Written
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism
from mbds_xsim.scene.scene import GRAVITY, WORLD, Scene

from .writing import dropped_fate, name_of, tensor_words, unique, without_servos, written

_KINDS = {"hinge": "continuous", "slider": "prismatic", "fixed": "fixed", None: "floating"}
_LIMITED = {"hinge": "revolute", "slider": "prismatic"}
_TREE = "URDF is a tree of links with hinges and sliders"
_LACKS = {
    "distance_links": _TREE,
    "springs": _TREE,
    "joints.stiffness": "URDF has no springs",
    "joints.armature": "URDF has no rotors",
    "joints.restitution": "URDF has no rebound from limits",
    "servos": "URDF has no servos",
}


def write(scene: Scene) -> Written:
    """Write URDF; see `mbds_xsim.simulate.registry`.

    Raises:
        InputError: A joint is of a kind that URDF does not have.
    """
    mechanism = without_servos(scene)
    root = Element("robot", name=scene.name)
    SubElement(root, "link", name=WORLD)
    frames: dict[int, Array] = {WORLD_INDEX: np.zeros(3)}
    for link in mechanism.links:
        _link(root, mechanism, link, frames)
    fates = [dropped_fate("joints", _TREE, joint.name) for joint in mechanism.loops]
    if scene.gravity != GRAVITY:
        fates.append(Fate("gravity", (), "dropped", "URDF has no gravity", True))
    return written(indented(root), scene, _LACKS, fates)


def _link(root: Element, mechanism: Mechanism, link: Link, frames: dict[int, Array]) -> None:
    """Write a joint and its link, whose frame is at the joint and parallel to W."""
    joint, body = link.joint, link.body
    kind = None if joint is None else joint.kind
    if kind not in _KINDS:
        raise InputError(f"the joint {joint.name if joint else ''!r} is a {kind} joint; {_TREE}")
    name = name_of(mechanism, body)
    com = mechanism.com[body]
    frames[body] = com if joint is None else com + joint.in_child
    element = SubElement(root, "link", name=name)
    inertial = SubElement(element, "inertial")
    SubElement(inertial, "origin", xyz=numbers(com - frames[body]), rpy="0 0 0")
    SubElement(inertial, "mass", value=repr(float(mechanism.mass[body])))
    SubElement(inertial, "inertia", tensor_words(mechanism.inertia[body]))
    floats = f"{name} floats"
    joint_name = joint.name if joint else unique(floats, {each.name for each in mechanism.joints})
    joint_node = SubElement(root, "joint", name=joint_name)
    joint_node.set("type", str(_KINDS[kind]))
    SubElement(joint_node, "parent", link=name_of(mechanism, link.parent))
    SubElement(joint_node, "child", link=name)
    SubElement(joint_node, "origin", xyz=numbers(frames[body] - frames[link.parent]), rpy="0 0 0")
    if joint is not None and joint.axis.any():
        SubElement(joint_node, "axis", xyz=numbers(joint.axis))
    if joint is not None and (joint.damping or joint.friction):
        law = {key: repr(getattr(joint, key)) for key in ("damping", "friction")}
        SubElement(joint_node, "dynamics", law)
    if joint is not None and joint.limits:
        joint_node.set("type", _LIMITED[joint.kind])
        lower, upper = map(repr, joint.limits)
        # Effort and velocity are required; a scene limits neither.
        SubElement(joint_node, "limit", lower=lower, upper=upper, effort="1e9", velocity="1e9")
    for tie in mechanism.couplings:
        if joint is not None and tie.follower.name == joint.name:
            law = {"multiplier": repr(tie.ratio), "offset": repr(tie.offset)}
            SubElement(joint_node, "mimic", {"joint": tie.leader.name} | law)

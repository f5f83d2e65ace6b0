"""Scenes as SDF 1.6: link frames are at the centres of mass, and no frame is rotated.

Elements: http://sdformat.org/spec?ver=1.6; DART reads no later worlds. Links and joints share no
names: later versions forbid it, and Drake applies that rule to this version as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from xml.etree.ElementTree import Element, SubElement

from mbds_xsim.base.xml import indented, numbers
from mbds_xsim.scene.imported import Written
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint
from mbds_xsim.scene.scene import Scene

from .writing import dropped_fate, name_of, tensor_words, unlike, without_servos, written

_KINDS = {"hinge": "revolute", "slider": "prismatic", "ball": "ball", "fixed": "fixed"}
_UNLIMITED = (-1e16, 1e16)  # the specification's defaults; limits are required
_LAW = {"damping": "damping", "friction": "friction", "spring_reference": "rest",
        "spring_stiffness": "stiffness"}  # fmt: skip
_TREE = "programs that read SDF hold each link by one joint"
_LACKS = {
    "distance_links": "SDF has no links of constant length",
    "springs": "SDF has no springs between points",
    "couplings": "SDF 1.6 has no joints that follow others",
    "servos": "SDF has no servos; they are plugins of a simulator",
    "joints.armature": "SDF has no rotors",
    "joints.restitution": "SDF has no rebound from limits",
}


def write(scene: Scene) -> Written:
    """Write SDF; see `mbds_xsim.simulate.registry`."""
    mechanism = without_servos(scene)
    root = Element("sdf", version="1.6")
    world = SubElement(root, "world", name=scene.name)
    _texts(world, {"gravity": numbers(scene.gravity)})
    model = SubElement(world, "model", name=scene.name)
    for body in range(mechanism.body_count):
        _link(model, mechanism, body)
    names, fates = unlike(scene, ("bodies", "joints"), str, "a link has this name")
    for link in mechanism.links:
        if link.joint is not None:
            name = names["joints", link.joint.name]
            _joint(model, mechanism, link.joint, name)
    fates += [dropped_fate("joints", _TREE, joint.name) for joint in mechanism.loops]
    return written(indented(root), scene, _LACKS, fates)


def _link(model: Element, mechanism: Mechanism, body: int) -> None:
    link = SubElement(model, "link", name=name_of(mechanism, body))
    _texts(link, {"pose": _pose(mechanism.com[body])})
    inertial = SubElement(link, "inertial")
    _texts(inertial, {"mass": repr(float(mechanism.mass[body]))})
    _texts(SubElement(inertial, "inertia"), tensor_words(mechanism.inertia[body]))


def _joint(model: Element, mechanism: Mechanism, joint: PlacedJoint, name: str) -> None:
    element = SubElement(model, "joint", name=name, type=_KINDS[joint.kind])
    ends = {key: name_of(mechanism, getattr(joint, key)) for key in ("parent", "child")}
    _texts(element, {**ends, "pose": _pose(joint.in_child)})
    if joint.axis.any():
        axis = SubElement(element, "axis")
        _texts(axis, {"xyz": numbers(joint.axis)})
        limits = zip(("lower", "upper"), joint.limits or _UNLIMITED, strict=True)
        _texts(SubElement(axis, "limit"), {key: repr(value) for key, value in limits})
        law = {key: repr(float(getattr(joint, field))) for key, field in _LAW.items()}
        _texts(SubElement(axis, "dynamics"), law)


def _pose(point: Iterable[float]) -> str:
    return numbers((*point, 0.0, 0.0, 0.0))


def _texts(parent: Element, texts: Mapping[str, str]) -> None:
    for tag, text in texts.items():
        SubElement(parent, tag).text = text

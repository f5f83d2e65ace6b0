"""Reader of SDF: poses and joints as DART parses them, masses as the file states them."""

from __future__ import annotations

import copy
import itertools
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported
from mbds_xsim.simulate.adapter import version_of

from .assembling import assemble
from .fates import LABELS, NO_FOLLOWER, fates_of, labelled, lost_mimic
from .graph import check_circles, check_unique
from .parts import (
    CLOSES,
    Closing,
    Freedom,
    Mass,
    ModelCoupling,
    Part,
    Parts,
    Property,
    Solid,
    Solids,
    bounded,
)
from .sdf_bodies import REPORTED, masses_of, number, numbers, pair, shapes_of
from .sdf_closings import closing_of, lost_of
from .source import read_source

_KINDS = {"RevoluteJoint": "hinge", "PrismaticJoint": "slider", "BallJoint": "ball",
          "FreeJoint": "free"}  # fmt: skip
_VERSIONS = ("1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11")
"""Accepted versions. Up to 1.4, axes were in the model's frame, a difference that DART ignores."""
_FRAMES = ("relative_to", "expressed_in", "frame", "placement_frame", "degrees", "rotation_format")
_PLAIN = ("", "0", "false", "euler_rpy")
"""Values of these attributes that change nothing."""
_ONE = "DART's parser takes one joint per link, and only between existing links"
_INERTIAL = (
    "<inertial><mass>1</mass><inertia><ixx>1</ixx><ixy>0</ixy><ixz>0</ixz><iyy>1</iyy><iyz>0</iyz>"
    "<izz>1</izz></inertia></inertial>"
)
_UNSTATED = (
    ("mass", ["mass"], "not stated: 1 kg, the specification's default"),
    ("inertia", [f"inertia/{key}" for key in ("ixx", "iyy", "izz")],
     "not all are stated: moments of 1 kg·m², the specification's default"),
)  # fmt: skip
"""Elements whose defaults are told, and what states them."""
_DOWN = (0.0, 0.0, -9.8)
_NO_GRAVITY = "not stated: 9.8 m/s² downwards, the specification's default"
_OFF = ("0", "false")
_LAW = ("damping", "friction", "spring_stiffness", "spring_reference")
_AXES = {
    "axis": ("revolute", "continuous", "prismatic", "revolute2", "universal"),
    "axis2": ("revolute2", "universal"),
}
"""Types of joints that need each of the two axes."""
_NO_FOLLOWER = f"{NO_FOLLOWER}, or has the name of another joint"
_MIMIC = (("multiplier", 1.0), ("offset", 0.0), ("reference", 0.0))
_UNSUPPORTED = ("include", "frame", "experimental:params")


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read an SDF file; see `mbds_xsim.simulate.registry`."""
    dartpy = optional("dartpy", "reading SDF", "dart")
    if floating:
        raise InputError("--floating is for URDF; SDF says itself which of its models are fixed")
    root = read_source(path, folder)
    _refuse(root)
    models = list(root.iter("model"))
    for each in models:
        _check_numbers(each)
        _check_tree(each)
    masses = [masses_of(each) for each in models]
    mimics = [mimic for each in models for mimic in _take_mimics(each)]
    try:
        skeletons = _skeletons(dartpy.utils.SdfParser, root)
    except (RuntimeError, ValueError) as error:  # ValueError: malformed numbers
        raise InputError(f"DART's parser refuses it: {error}") from error
    if len(models) != len(skeletons):
        raise InputError(f"DART's parser returns {len(skeletons)} of its {len(models)} models")
    parts: list[Part] = []
    shapes: list[Solid] = []
    fates: list[Fate] = []
    closings: list[Closing] = []
    for skeleton, element, link_masses in zip(skeletons, models, masses, strict=True):
        fates += _defaults(skeleton, element)
        skeleton.setPositions(np.zeros(skeleton.getNumDofs()))
        first = len(parts)
        parts += _parts(skeleton, first, link_masses)
        for joint in _skipped_joints(skeleton, element):
            if (closing := closing_of(joint, element, parts, first)) is None:
                fates.append(Fate("joint", (), "dropped", _ONE, True, (joint.get("name", ""),)))
            else:
                closings.append(closing)
                fates += lost_of(joint) if closing.axis is not None else ()
        shapes += shapes_of(element, parts[first:], first) if ground else ()
    name = models[0].get("name") or path.stem
    solids = Solids("collision", tuple(shapes), pair) if ground else None
    axes = _unique_axes(parts, closings)
    couplings = tuple(mimic for mimic in mimics if axes >= {mimic.joint, mimic.follows})
    lost = [mimic for mimic in mimics if mimic not in couplings]
    known = _joint_names(models)
    fates += [lost_mimic(m.joint, m.follows, known, _NO_FOLLOWER) for m in lost]
    model = Parts(
        name,
        tuple(parts),
        _gravity(root, fates),
        tuple(closings),
        couplings=couplings,
        labels=LABELS["sdf"],
        solids=solids,
    )
    lost_tags = {fate.element for fate in fates if fate.reason == CLOSES}
    stated = model.stated | {key for key, (tag, _) in LABELS["sdf"].items() if tag in lost_tags}
    reported = labelled("sdf", stated) | dict.fromkeys(REPORTED if ground else (), True)
    _mark(root)
    fates += fates_of(root, reported, touching=ground)
    reader = f"DART {version_of('dartpy')}"
    return assemble(model, file=path.name, kind="SDF", reader=reader, fates=fates)


def _unique_axes(parts: list[Part], closings: list[Closing]) -> set[str]:
    """Return the hinges and sliders whose name no other joint has, be it in another model."""
    freedoms = [each for part in parts for each in part.freedoms]
    counts = Counter([*(each.name for each in freedoms), *(each.name for each in closings)])
    return {each.name for each in freedoms if each.axis.any() and counts[each.name] == 1}


def _joint_names(models: list[Element]) -> set[str]:
    """Return the names of all joints, and of their axes as `_take_mimics` calls them."""
    joints = [joint.get("name", "") for model in models for joint in model.findall("joint")]
    return {joint + axis for joint in joints for axis in ("", " 1", " 2")}


def _take_mimics(model: Element) -> Iterator[ModelCoupling]:
    """Remove from the axes what makes them follow others, and yield it.

    DART's parser ignores its reference, and does not tell the rest.
    """
    types = {joint.get("name", ""): joint.get("type") for joint in model.findall("joint")}

    def freedom(joint: str, axis: str) -> str:
        single = axis == "axis" and types.get(joint) not in _AXES["axis2"]
        return joint if single else f"{joint} {axis.removeprefix('axis') or 1}"

    for joint, key in itertools.product(model.findall("joint"), _AXES):
        axis, path = joint.find(key), f"{key}/mimic"
        if axis is None or (mimic := axis.find("mimic")) is None:
            continue
        ratio, offset, middle = (number(joint, f"{path}/{each}", value) for each, value in _MIMIC)
        leader = freedom(mimic.get("joint", ""), mimic.get("axis", "axis"))
        follower = freedom(joint.get("name", ""), key)
        yield ModelCoupling(follower, leader, (offset - ratio * middle, ratio))
        axis.remove(mimic)


def _defaults(skeleton: Any, model: Element) -> Iterator[Fate]:
    """Report the moving links whose mass or moments of inertia are defaults."""
    nodes = skeleton.getBodyNodes() if skeleton.isMobile() else ()
    moving = {node.getName() for node in nodes if node.getNumDependentGenCoords()}
    for link in model.findall("link"):
        for element, paths, reason in _UNSTATED:
            stated = all(link.find(f"inertial/{path}") is not None for path in paths)
            if link.get("name") in moving and not stated:
                yield Fate(element, (), "approximated", reason, True, (link.get("name", ""),))


def _mark(root: Element) -> None:
    """Rename or remove elements whose fate depends on more than their name."""
    for link in root.iter("link"):
        if (gravity := link.find("gravity")) is not None and (gravity.text or "").strip() in _OFF:
            gravity.tag = "link/gravity"
        for tag in ("kinematic", "velocity_decay"):
            for element in link.findall(tag):
                if all(text.strip(" \t\r\n0.") in ("", "false") for text in element.itertext()):
                    link.remove(element)
    for ode in root.iter("ode"):
        if (across := ode.find("mu2")) is not None and across.text == ode.findtext("mu"):
            ode.remove(across)  # the same as mu: nothing is lost


def _skeletons(parser: Any, root: Element) -> list[Any]:
    """Let DART read the models without shapes and masses, which are read from the file itself.

    It crashes on missing meshes, and skips links with incomplete inertias.
    """
    bare = copy.deepcopy(root)
    bare.set("version", "1.6")  # the last whose worlds DART reads; without frames versions agree
    for joint in bare.iter("joint"):
        if joint.get("type") == "continuous":  # unknown to DART
            joint.set("type", "revolute")
            for limit in joint.findall("axis/limit"):
                limit.clear()
    for link in list(bare.iter("link")):
        for child in [each for each in link if each.tag in ("visual", "collision", "inertial")]:
            link.remove(child)
        link.append(fromstring(_INERTIAL))
    for axis in [*bare.iter("axis"), *bare.iter("axis2")]:
        if axis.find("xyz") is None:
            SubElement(axis, "xyz").text = "0 0 1"
    with tempfile.NamedTemporaryFile("w", suffix=".sdf", encoding="utf-8") as file:
        file.write(tostring(bare, encoding="unicode"))
        file.flush()
        if root.find("world") is None:
            skeletons = [parser.readSkeleton(file.name)]
        else:
            world = parser.readWorld(file.name)
            count = world.getNumSkeletons() if world is not None else 0
            skeletons = [world.getSkeleton(k) for k in range(count)]
    if not skeletons or None in skeletons:
        raise InputError("DART's parser returns no model")
    return skeletons


def _gravity(root: Element, fates: list[Fate]) -> Array:
    """Return the gravity of the world, or of its physics as before SDF 1.6."""
    world = root.find("world")
    if world is None:
        return np.array([0.0, 0.0, -9.81])
    for path in ("gravity", "physics/gravity"):
        if world.find(path) is not None:
            return numbers(world, path, _DOWN)
    fates.append(Fate("gravity", (), "approximated", _NO_GRAVITY, True))
    return np.array(_DOWN)


def _refuse(root: Element) -> None:
    """Raise InputError if DART's parser would ignore something that affects the motion."""
    if root.tag != "sdf":
        raise InputError(f"its outermost element is <{root.tag}>, allowed is <sdf>")
    if (number := root.get("version", "")) not in _VERSIONS:
        msg = f"it is of version {number or 'unsaid'}; DART's parser reads {', '.join(_VERSIONS)}"
        raise InputError(msg)
    if (joint := root.find("world/joint")) is not None:
        msg = f"<world> has a <joint> {joint.get('name', '')!r}, which DART's parser does not read"
        raise InputError(f"{msg}; make one <model> of all that it joins")
    for element in root.iter():
        frame_keys = [key for key in _FRAMES if element.get(key, "") not in _PLAIN]
        nested = element.tag not in ("sdf", "world") and element.find("model") is not None
        if element.tag in _UNSUPPORTED or frame_keys or nested:
            construct = f"a model in a {element.tag}" if nested else element.tag
            item = f"{frame_keys[0]}=" if frame_keys else construct
            msg = f"<{element.tag}> has what DART's parser does not read ({item}); resolve it first"
            raise InputError(msg)


def _check_numbers(model: Element) -> None:
    """Raise InputError on a malformed number, for which DART's parser silently takes another."""
    joints = model.findall("joint")
    for element in (model, *model.findall("link"), *joints):
        numbers(element, "pose", (0.0,) * 6)
    for joint, axis in itertools.product(joints, ("axis", "axis2")):
        name, kind = joint.get("name", ""), joint.get("type", "")
        if joint.find(axis) is None and kind in _AXES[axis]:
            raise InputError(f"<joint> {name!r} is {kind} and has no <{axis}>, which it needs")
        numbers(joint, f"{axis}/xyz", (0.0, 0.0, 1.0))
        for side in ("lower", "upper"):
            numbers(joint, f"{axis}/limit/{side}", (0.0,), endless=True)
        for key in _LAW:
            value = number(joint, f"{axis}/dynamics/{key}", 0.0)
            if value < 0.0 and key != "spring_reference":
                msg = f"<{key}> of <joint> {name!r} is {value:g}, allowed is 0 or more"
                raise InputError(msg)


def _check_tree(model: Element) -> None:
    """Raise InputError if joints leave open what holds a link; trim the names of what they join.

    DART's parser takes the world for a parent that it does not find, and stalls in a circle.
    """
    check_unique(model, "link")
    check_unique(model, "joint")
    ends = {link.get("name", "") for link in model.findall("link")} | {"world"}
    above: dict[str, tuple[str, ...]] = {}
    for joint in model.findall("joint"):
        for end in (*joint.findall("parent"), *joint.findall("child")):
            end.text = end.text if end.text in ends else (end.text or "").strip()
        if (parent := joint.findtext("parent", "")) not in ends:
            msg = f"<parent> of <joint> {joint.get('name', '')!r} is {parent!r}, allowed is a link "
            raise InputError(f"{msg}of its model or 'world'")
        above.setdefault(joint.findtext("child", ""), (parent,))
    check_circles(model, above)


def _skipped_joints(skeleton: Any, model: Element) -> Iterator[Element]:
    """Yield joints that DART's parser skips; raise InputError if it skips links.

    They are not told by name, as it calls the free joint of a link without one "root".
    """
    links = {node.getName() for node in skeleton.getBodyNodes()}
    for link in model.findall("link"):
        if (name := link.get("name", "")) not in links:
            raise InputError(
                f"DART's parser leaves out the link {name!r}; it takes joints that are revolute, "
                "revolute2, continuous, prismatic, ball, universal, screw or fixed, and parents "
                "that are links of the model or world"
            )
    for joint in model.findall("joint"):
        if (child := joint.findtext("child", "")) in links:
            links.remove(child)
        else:
            yield joint


def _parts(skeleton: Any, first: int, masses: Mapping[str, Mass]) -> Iterator[Part]:
    order = list(_downwards(skeleton))
    index = {node.getName(): first + k for k, node in enumerate(order)}
    for node in order:
        above = node.getParentBodyNode()
        frame = node.getTransform()
        axes = np.array(frame.rotation())
        local = masses[node.getName()]
        com = np.array(frame.multiply(local.com))
        yield Part(
            name=node.getName(),
            parent=index[above.getName()] if above is not None else -1,
            position=np.array(frame.translation()),
            orientation=rotation.from_matrix(axes),
            mass=Mass(local.mass, com, axes @ local.inertia @ axes.T),
            freedoms=tuple(_freedoms(node)) if skeleton.isMobile() else (),
        )


def _downwards(skeleton: Any) -> Iterator[Any]:
    queue = [node for node in skeleton.getBodyNodes() if node.getParentBodyNode() is None]
    while queue:
        node = queue.pop(0)
        yield node
        queue += [node.getChildBodyNode(k) for k in range(node.getNumChildBodyNodes())]


def _freedoms(node: Any) -> Iterator[Freedom]:
    joint = node.getParentJoint()
    kind = joint.getType()
    place = node.getTransform().multiply(joint.getTransformFromChildBodyNode())
    anchor, axes = np.array(place.translation()), np.array(place.rotation())
    name = joint.getName()
    if kind in _KINDS:
        axis = axes @ joint.getAxis() if _KINDS[kind] in ("hinge", "slider") else np.zeros(3)
        yield Freedom(name, _KINDS[kind], anchor, axis, _properties(joint, 0))  # type: ignore[arg-type]
    elif kind == "UniversalJoint":
        for k, axis in enumerate((joint.getAxis1(), joint.getAxis2())):
            yield Freedom(f"{name} {k + 1}", "hinge", anchor, axes @ axis, _properties(joint, k))
    elif kind != "WeldJoint":
        raise InputError(f"the joint {name!r} is a {kind}, which is not in the scene description")


def _properties(joint: Any, k: int) -> dict[str, Property]:
    properties: dict[str, Property] = {
        "stiffness": float(joint.getSpringStiffness(k)),
        "damping": float(joint.getDampingCoefficient(k)),
        "friction": float(joint.getCoulombFriction(k)),
    }
    if properties["stiffness"]:
        properties["rest"] = float(joint.getRestPosition(k))
    limits = bounded(float(joint.getPositionLowerLimit(k)), float(joint.getPositionUpperLimit(k)))
    if limits is not None:
        properties["limits"] = limits
    return {key: value for key, value in properties.items() if value}

"""SDF, as DART parses it: poses and joints are its reader's, masses are those of the file."""

from __future__ import annotations

import copy
import itertools
import math
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.scene.imported import Fate, Imported
from mbds_xsim.simulate.adapter import version_of

from .assembling import assemble
from .fates import fates_of
from .parts import Freedom, Mass, Part, Parts, Property, Solid, Solids
from .sdf_shapes import TOLD, pair, shapes_of
from .sdf_values import masses_of, numbers
from .source import read_source

_LABELS = {
    "stiffness": ("spring_stiffness", ""),
    "rest": ("spring_reference", ""),
    "damping": ("damping", ""),
    "friction": ("friction", ""),
    "limits": ("lower", ""),
}
_KINDS = {"RevoluteJoint": "hinge", "PrismaticJoint": "slider", "BallJoint": "ball",
          "FreeJoint": "free"}  # fmt: skip
_FAR = 1e10  # a limit beyond is none
_VERSIONS = ("1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11")
"""Until 1.4 axes were in the frame of the model, which DART does not tell apart."""
_FRAMES = ("relative_to", "expressed_in", "frame", "degrees", "rotation_format")
_ONE = "DART's parser takes one joint for each link, between links that are there"
_OFF = ("0", "false")
_LAW = ("damping", "friction", "spring_stiffness", "spring_reference")
_NOT_READ = ("include", "frame", "experimental:params")


def read(path: Path, folder: Path, floating: bool, ground: bool) -> Imported:
    """Read an SDF file; see `mbds_xsim.simulate.registry`."""
    dartpy = optional("dartpy", "reading SDF", "dart")
    if floating:
        msg = "--floating is for URDF; SDF says itself which of its models are fixed"
        raise InputError(msg)
    root = read_source(path, folder)
    _refuse(root)
    models = list(root.iter("model"))
    for each in models:
        _check_numbers(each)
    stated = [masses_of(each) for each in models]
    try:
        skeletons, gravity = _skeletons(dartpy.utils.SdfParser, root)
    except (RuntimeError, ValueError) as error:  # the latter of numbers that are none
        raise InputError(f"DART's parser refuses it: {error}") from error
    if len(models) != len(skeletons):
        msg = f"DART's parser gives {len(skeletons)} of its {len(models)} models"
        raise InputError(msg)
    parts: list[Part] = []
    shapes: list[Solid] = []
    untaken: list[str] = []
    for skeleton, element, own in zip(skeletons, models, stated, strict=True):
        untaken += _untaken(skeleton, element)
        skeleton.setPositions(np.zeros(skeleton.getNumDofs()))
        first = len(parts)
        parts += _parts(skeleton, first, own)
        shapes += shapes_of(element, parts[first:], first) if ground else ()
    named = models[0].get("name") or path.stem
    solids = Solids("collision", tuple(shapes), pair) if ground else None
    model = Parts(named, tuple(parts), _stated(root, gravity), labels=_LABELS, solids=solids)
    had = {key for part in parts for freedom in part.freedoms for key in freedom.properties}
    told = {label: key in had for key, label in _LABELS.items()}
    told["upper", ""] = told["lower", ""]
    told |= dict.fromkeys(TOLD if ground else (), True)
    _mark(root)
    reader = f"DART {version_of('dartpy')}"
    fates = [*fates_of(root, told, touching=ground)]
    if untaken:
        fates.append(Fate("joint", (), "dropped", _ONE, True, tuple(untaken), len(untaken)))
    return assemble(model, file=path.name, kind="SDF", reader=reader, fates=fates)


def _mark(root: Element) -> None:
    """Name elements as the table of fates has them where it takes more than a name to know."""
    for link in root.iter("link"):
        if (own := link.find("gravity")) is not None and (own.text or "").strip() in _OFF:
            own.tag = "link/gravity"
    for ode in root.iter("ode"):
        if (across := ode.find("mu2")) is not None and across.text == ode.findtext("mu"):
            ode.remove(across)  # nothing is lost of it


def _skeletons(parser: Any, root: Element) -> tuple[list[Any], Array]:
    """Let DART read the models, without shapes: it crashes on meshes that it does not find."""
    bare = copy.deepcopy(root)
    bare.set("version", "1.6")  # the last that it takes a world of; without frames all are alike
    for joint in bare.iter("joint"):
        if joint.get("type") == "continuous":  # which it does not know
            joint.set("type", "revolute")
            for limit in joint.findall("axis/limit"):
                limit.clear()
    for link in list(bare.iter("link")):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    gravity = np.array([0.0, 0.0, -9.81])
    with tempfile.NamedTemporaryFile("w", suffix=".sdf", encoding="utf-8") as file:
        file.write(tostring(bare, encoding="unicode"))
        file.flush()
        if root.find("world") is None:
            skeletons = [parser.readSkeleton(file.name)]
        else:
            world = parser.readWorld(file.name)
            count = world.getNumSkeletons() if world is not None else 0
            skeletons = [world.getSkeleton(k) for k in range(count)]
            gravity = np.array(world.getGravity()) if world is not None else gravity
    if not skeletons or None in skeletons:
        msg = "DART's parser gives no model of it"
        raise InputError(msg)
    return skeletons, gravity


def _stated(root: Element, parsed: Array) -> Array:
    """Give the world's own gravity, which SDF has from 1.6 on and DART's parser passes over."""
    world = root.find("world")
    return parsed if world is None else numbers(world, "gravity", (*parsed,))


def _refuse(root: Element) -> None:
    """Raise where DART's parser would pass over what moves things."""
    if root.tag != "sdf":
        msg = f"its outermost element is <{root.tag}>, allowed is <sdf>"
        raise InputError(msg)
    if (number := root.get("version", "")) not in _VERSIONS:
        msg = f"it is of version {number or 'unsaid'}; DART's parser reads {', '.join(_VERSIONS)}"
        raise InputError(msg)
    for element in root.iter():
        framed = [key for key in _FRAMES if element.get(key)]
        nested = element.tag not in ("sdf", "world") and element.find("model") is not None
        if element.tag in _NOT_READ or framed or nested:
            within = f"a model in a {element.tag}" if nested else element.tag
            what = f"{framed[0]}=" if framed else within
            msg = f"<{element.tag}> has what DART's parser does not read ({what}); resolve it first"
            raise InputError(msg)


def _check_numbers(model: Element) -> None:
    """Raise where a number is none: DART's parser goes on with another in its place."""
    joints = model.findall("joint")
    for element in (model, *model.findall("link"), *joints):
        numbers(element, "pose", (0.0,) * 6)
    for joint, axis in itertools.product(joints, ("axis", "axis2")):
        numbers(joint, f"{axis}/xyz", (0.0, 0.0, 1.0))
        for key in _LAW:
            numbers(joint, f"{axis}/dynamics/{key}", (0.0,))


def _untaken(skeleton: Any, model: Element) -> list[str]:
    """Name the joints that DART's parser does not take; raise where it leaves out links."""
    nodes = skeleton.getBodyNodes()
    links, joints = {n.getName() for n in nodes}, {n.getParentJoint().getName() for n in nodes}
    for link in model.findall("link"):
        if (name := link.get("name", "")) not in links:
            msg = (
                f"DART's parser leaves out the link {name!r}; it takes joints that are revolute, "
                "revolute2, continuous, prismatic, ball, universal, screw or fixed"
            )
            raise InputError(msg)
    return [n for joint in model.findall("joint") if (n := joint.get("name", "")) not in joints]


def _parts(skeleton: Any, first: int, stated: Mapping[str, tuple[float, Array]]) -> Iterator[Part]:
    order = list(_downwards(skeleton))
    place = {node.getName(): first + k for k, node in enumerate(order)}
    for node in order:
        above = node.getParentBodyNode()
        frame = node.getTransform()
        axes = np.array(frame.rotation())
        mass, inertia = stated[node.getName()]
        yield Part(
            name=node.getName(),
            parent=place[above.getName()] if above is not None else -1,
            position=np.array(frame.translation()),
            orientation=rotation.from_matrix(axes),
            mass=Mass(mass, np.array(node.getCOM()), axes @ inertia @ axes.T),
            freedoms=tuple(_freedoms(node)) if skeleton.isMobile() else (),
        )


def _downwards(skeleton: Any) -> Iterator[Any]:
    waiting = [node for node in skeleton.getBodyNodes() if node.getParentBodyNode() is None]
    while waiting:
        node = waiting.pop(0)
        yield node
        waiting += [node.getChildBodyNode(k) for k in range(node.getNumChildBodyNodes())]


def _freedoms(node: Any) -> Iterator[Freedom]:
    joint = node.getParentJoint()
    kind = joint.getType()
    place = node.getTransform().multiply(joint.getTransformFromChildBodyNode())
    anchor, axes = np.array(place.translation()), np.array(place.rotation())
    name = joint.getName()
    if kind in ("BallJoint", "FreeJoint"):
        yield Freedom(name, _KINDS[kind], anchor, np.zeros(3), _properties(joint, 0))  # type: ignore[arg-type]
    elif kind in _KINDS:
        yield Freedom(name, _KINDS[kind], anchor, axes @ joint.getAxis(), _properties(joint, 0))  # type: ignore[arg-type]
    elif kind == "UniversalJoint":
        for k, axis in enumerate((joint.getAxis1(), joint.getAxis2())):
            yield Freedom(f"{name} {k + 1}", "hinge", anchor, axes @ axis, _properties(joint, k))
    elif kind != "WeldJoint":
        msg = f"the joint {name!r} is a {kind}, which is not in the scene description"
        raise InputError(msg)


def _properties(joint: Any, k: int) -> dict[str, Property]:
    found: dict[str, Property] = {
        "stiffness": float(joint.getSpringStiffness(k)),
        "damping": float(joint.getDampingCoefficient(k)),
        "friction": float(joint.getCoulombFriction(k)),
    }
    if found["stiffness"]:
        found["rest"] = float(joint.getRestPosition(k))
    limits = (float(joint.getPositionLowerLimit(k)), float(joint.getPositionUpperLimit(k)))
    if all(map(math.isfinite, limits)) and max(map(abs, limits)) < _FAR:
        found["limits"] = limits
    return {key: value for key, value in found.items() if value}

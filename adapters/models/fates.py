"""Fates of all elements and attributes of MJCF, URDF, SDF and USD, in one table for each format.

Keys are `element` and `element@attribute`; the latter takes precedence, and anything in no row is
dropped as unknown. Properties of joints are in `LABELS`, and elements that a compiled model
describes better are reported from there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Hashable, Iterable, Iterator, Mapping
from typing import Any
from xml.etree.ElementTree import Element

from mbds_xsim.scene.imported import Fate, Outcome

Entry = tuple[Outcome, bool, str]
"""Outcome, whether the motion depends on it, and reason."""
Row = tuple[Outcome, bool, str, str]
"""An entry, then its keys separated by spaces."""

LABELS = {
    "mujoco": {
        "stiffness": ("joint", "stiffness"),
        "rest": ("joint", "springref"),
        "damping": ("joint", "damping"),
        "armature": ("joint", "armature"),
        "friction": ("joint", "frictionloss"),
        "limits": ("joint", "range"),
        "coupling": ("equality", "joint"),
    },
    "robot": {
        "damping": ("dynamics", "damping"),
        "friction": ("dynamics", "friction"),
        "limits": ("limit", "lower"),
        "coupling": ("mimic", "multiplier"),
    },
    "sdf": {
        "stiffness": ("spring_stiffness", ""),
        "rest": ("spring_reference", ""),
        "damping": ("damping", ""),
        "friction": ("friction", ""),
        "limits": ("lower", ""),
        "coupling": ("mimic", ""),
    },
}
"""Element and attribute that state each property, by root element of the format."""
_ALIASES = {
    ("joint", "limited"): "limits",
    ("joint", "springdamper"): "damping",
    ("joint", "springyield"): "springyield",
    ("limit", "upper"): "limits",
    ("upper", ""): "limits",
}
_APART = "no collisions of bodies are made of a model"
COLLISION = f"{_APART}; with --ground they meet a plane"
NO_FOLLOWER = "it, or what it follows, is no hinge or slider"
_SOLVER = "a setting of an engine, not of the mechanism"
_VISUAL = "drawn only"
_UNKNOWN: Entry = ("dropped", True, "unknown to this reader")
_NONE: Entry = ("kept", True, "none, or zero")
_NAMESPACE: Entry = ("dropped", False, "names of other formats")

_MJCF: tuple[Row, ...] = (
    ("kept", True, "as the compiler resolves it",
     "mujoco compiler default model attach body inertial frame replicate joint freejoint "
     "option@gravity joint@ref asset contact"),
    ("kept", True, "what it switches off in MuJoCo is not in the scene either",
     "flag@gravity flag@spring flag@damper flag@passive flag@limit flag@frictionloss "
     "flag@equality flag@constraint flag@contact flag@actuation flag@clampctrl "
     "option@actuatorgroupdisable"),
    ("kept", True, "its mass and inertia, where its body states none", "geom mesh hfield"),
    ("dropped", False, COLLISION,
     "geom@contype geom@conaffinity geom@condim geom@priority geom@friction exclude"),
    ("dropped", True, _APART, "pair"),
    ("dropped", True, "surfaces neither stick nor run", "geom@adhesion geom@surfacevel"),
    ("dropped", False, _SOLVER,
     "geom@solmix geom@solref geom@solimp geom@margin geom@gap option flag size statistic "
     "joint@solreflimit joint@solimplimit joint@solreffriction joint@solimpfriction joint@margin "
     "body@sleep lengthrange"),
    ("dropped", True, "there is no fluid", "option@density option@viscosity option@wind "
     "geom@fluidshape geom@fluidcoef"),
    ("dropped", True, "there are no magnetic fields", "option@magnetic"),
    ("dropped", True, "gravity acts on all bodies alike", "body@gravcomp"),
    ("kept", True, "it limits the servos of the joint",
     "joint@actuatorfrcrange joint@actuatorfrclimited"),
    ("dropped", False, "for actuators only", "joint@actuatorgravcomp"),
    ("dropped", False, _VISUAL,
     "visual site camera light texture material skin geom@material geom@rgba geom@group "
     "joint@group mesh@material bone layer geom@castshadow freejoint@group mesh@texcoord "
     "mesh@normal mesh@smoothnormal"),
    ("dropped", False, "data for other programs", "custom sensor user numeric text tuple "
     "body@user joint@user geom@user"),
    ("dropped", False, "a pose beside the reference pose, at which the scene starts", "keyframe"),
    ("kept", True, "as the compiler resolves it for each actuator",
     "motor position velocity intvelocity general damper cylinder muscle adhesion dcmotor pid "
     "orientation"),
    ("dropped", True, "a plugin may exert anything", "extension plugin"),
    ("dropped", True, "bodies are rigid", "deformable flex flexcomp composite"),
)  # fmt: skip
_PLACED = "pos quat axisangle xyaxes zaxis euler"
_KNOWN = {
    "mujoco": "model",
    "default": "class",
    "model": "name file content_type",
    "attach": "model body frame prefix",
    "body": f"name childclass mocap fuse simple {_PLACED}",
    "inertial": f"mass diaginertia fullinertia {_PLACED}",
    "frame": f"name childclass scale scaling massscale {_PLACED}",
    "replicate": f"count offset sep childclass {_PLACED}",
    "freejoint": "name align",
    "joint": "name class type pos axis range limited ref springref stiffness damping springdamper "
             "armature frictionloss",
    "geom": f"name class type size mass density fromto hfield mesh fitscale shellinertia {_PLACED}",
    "mesh": "name class content_type file scale inertia vertex face refpos refquat builtin params "
            "maxhullvert",
    "hfield": "name content_type file nrow ncol size elevation",
}  # fmt: skip
"""Attributes of MJCF that are kept with their elements, which may get others in new releases."""
_URDF: tuple[Row, ...] = (
    ("kept", True, "as the format says",
     "robot@name link@name link inertial mass@value origin@xyz origin@rpy inertia@ixx inertia@ixy "
     "inertia@ixz inertia@iyy inertia@iyz inertia@izz joint@name joint@type parent@link "
     "child@link axis@xyz"),
    (*_NONE, "origin axis limit dynamics"),
    (*_NAMESPACE, "robot@version"),
    ("dropped", False, _VISUAL, "visual material"),
    ("dropped", True, COLLISION, "collision"),
    ("dropped", False, "a limit of the drive", "limit@effort limit@velocity"),
    ("dropped", False, "for controllers",
     "safety_controller calibration transmission ros2_control"),
    ("dropped", True, "an extension of one simulator", "gazebo contact self_collision_checking"),
    ("dropped", False, "read by MuJoCo's compiler alone", "mujoco"),
)  # fmt: skip
_SDF: tuple[Row, ...] = (
    ("kept", True, "as DART's parser reads it",
     "sdf@version world@name model@name link@name link pose joint@name joint@type parent child "
     "axis axis2 xyz use_parent_model_frame static gravity"),
    ("kept", True, "as the format says", "inertial mass inertia ixx ixy ixz iyy iyz izz"),
    (*_NONE, "limit dynamics"),
    ("kept", True, "it says what holds without it", "pose@frame pose@degrees pose@rotation_format"),
    ("dropped", False, _VISUAL, "visual light scene gui material"),
    ("dropped", True, COLLISION, "collision"),
    ("dropped", False, 'it counts only with auto="true"', "density inertial@auto"),
    ("kept", True, "decides which shapes touch", "surface collide_bitmask collide_without_contact"),
    ("dropped", True, "a restitution counts at all speeds", "threshold"),
    ("dropped", True, "the ground has the same friction along all directions",
     "mu2 fdir1 slip1 slip2"),
    ("dropped", False, _SOLVER,
     "max_contacts kp kd max_vel min_depth soft_cfm soft_erp physics allow_auto_disable "
     "must_be_base_link"),
    ("dropped", False, _APART, "self_collide"),
    ("dropped", False, "a limit of the drive", "effort velocity"),
    ("dropped", True, "an extension of one simulator", "plugin"),
    ("dropped", False, "data for other programs",
     "sensor audio laser_retro magnetic_field spherical_coordinates atmosphere"),
    ("dropped", True, "there is no wind", "wind"),
    ("dropped", False, "there is no wind", "enable_wind"),
    ("dropped", True, "there is no such damping of bodies", "velocity_decay"),
    ("dropped", True, "nothing moves but by forces", "kinematic"),
    ("dropped", True, "gravity acts on all bodies alike", "link/gravity"),
    ("dropped", True, "DART's parser passes it over", "gearbox_ratio gearbox_reference_body"),
)  # fmt: skip


def _by_key(rows: Iterable[Row]) -> dict[str, Entry]:
    """Return the entry of each key."""
    return {key: row[:3] for row in rows for key in row[3].split()}


_TABLES = {"mujoco": _by_key(_MJCF), "robot": _by_key(_URDF), "sdf": _by_key(_SDF)}
_REPORTED = {"mujoco": {"equality", "tendon", "actuator"}, "robot": {"mimic"}, "sdf": set()}
"""Elements that the readers report instead."""
_WHOLE = {"visual", "custom", "sensor", "keyframe", "collision", "gazebo", "transmission",
          "material", "extension", "plugin", "skin", "ros2_control", "contact", "physics",
          "velocity_decay", "light", "gui", "scene", "geometry", "torsional", "mujoco", "wind",
          "spherical_coordinates", "atmosphere"}  # fmt: skip
"""Elements whose children share their fate."""
_OPEN = {"mujoco": {"contact", "mujoco"}, "robot": set(), "sdf": {"contact"}}
"""Exceptions in each format: their children have fates of their own."""
PAIRING = {
    "geom": ("contype", "conaffinity", "condim", "priority", "friction"),
    "exclude": ("name", "body1", "body2"),
}
"""MJCF elements and attributes that decide how shapes collide."""
_NONE_AT_ZERO = {"density", "viscosity", "wind", "magnetic", "gravcomp"}
_USD = _by_key((
    ("kept", True, "as the library of OpenUSD parses it",
     "physics:mass physics:density physics:centerOfMass physics:diagonalInertia "
     "physics:principalAxes physics:gravityDirection physics:gravityMagnitude physics:axis "
     "physics:localPos0 physics:localRot0 physics:localPos1 physics:localRot1 physics:body0 "
     "physics:body1 physics:rigidBodyEnabled physics:jointEnabled physics:kinematicEnabled "
     "physics:excludeFromArticulation physics:minDistance physics:maxDistance"),
    ("dropped", True, COLLISION,
     "physics:collisionEnabled physics:staticFriction physics:dynamicFriction "
     "physics:restitution"),
    ("dropped", False, COLLISION, "physics:filteredPairs physics:filteredGroups "
     "physics:invertFilteredGroups physics:mergeGroup collection physics:approximation "
     "physics:simulationOwner"),
    ("dropped", True, "the model starts in the reference pose, at rest",
     "physics:velocity physics:angularVelocity state"),
    ("dropped", True, "its joint has no such axis, or its API is not applied", "drive limit"),
    ("dropped", True, "joints do not break", "physics:breakForce physics:breakTorque"),
    ("dropped", False, _SOLVER, "physics:startsAsleep"),
    ("dropped", True, "not yet in the scene description",
     "physics:coneAngle0Limit physics:coneAngle1Limit"),
))  # fmt: skip
_AT_TIMES: Entry = ("dropped", True, "its values at times: only the one without a time counts")
_CONTACT = "decides how shapes meet the ground"
_USD_TOUCHING = _by_key((
    ("kept", True, _CONTACT,
     "physics:collisionEnabled physics:dynamicFriction physics:restitution collection "
     "physics:filteredPairs physics:filteredGroups physics:invertFilteredGroups "
     "physics:mergeGroup"),
    ("dropped", True, "the ground has the dynamic one alone", "physics:staticFriction"),
))  # fmt: skip
"""Rows that replace those above if shapes touch the ground."""
_COLLIDES = "physics:collisionEnabled"
"""Attribute that is true of a collision shape without being authored."""
_SIZES = "radius height size axis"
_USD_SHAPE = {
    True: _by_key([("kept", True, _CONTACT, f"material {_SIZES}")]),
    False: _by_key([("kept", True, "its mass, where its body states none", _SIZES)]),
}
"""Attributes of collision shapes, by whether they touch the ground."""
_USD_LIMITS = ("physics:lowerLimit", "physics:upperLimit")
_GENERAL = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
_PARSED_AXES: dict[tuple[str, str], tuple[str, ...]] = {
    ("drive", "PhysicsRevoluteJoint"): ("angular",),
    ("drive", "PhysicsPrismaticJoint"): ("linear",),
    ("drive", "PhysicsJoint"): _GENERAL,
    ("limit", "PhysicsJoint"): _GENERAL,
}
"""Axes whose drives or limits the reader takes, by type of joint."""
_NEVER = 3e38  # [N or N·m]: no force is larger in single precision
_SIMULATORS = ("physx", "mjc", "newton", "isaac")


def lost_mimic(joint: str, follows: str, known: Container[str], reason: str = NO_FOLLOWER) -> Fate:
    """Return the fate of a mimic that is no coupling; `known` are the names of all joints."""
    reason = reason if follows in known else f"no joint is called {follows!r}"
    return Fate("mimic", (), "dropped", reason, True, (joint,))


def labelled(kind: str, stated: Container[str]) -> dict[tuple[str, str], bool]:
    """Return whether a model has what an element or attribute of a format states for joints."""
    labels = {label: key for key, label in LABELS[kind].items()} | _ALIASES
    return {label: key in stated for label, key in labels.items()}


def fates_of(
    root: Element, reported: Mapping[tuple[str, str], bool], *, touching: bool = False
) -> Iterator[Fate]:
    """Walk a document and return the fates of its elements and attributes.

    Args:
        root: Root element of the document.
        reported: Elements and attributes that the caller reports, such as properties of joints:
            true leaves one out here, false reports it as none or zero.
        touching: Whether elements in collision shapes have fates of their own.
    """
    whole = _WHOLE - _OPEN[root.tag] - ({"collision"} if touching else set())
    found = []
    for element in _walk(root, whole):
        for attribute in element.attrib or ("",):
            is_reported = reported.get((element.tag, attribute))
            if not is_reported:
                entry = _NONE if is_reported is False else _look_up(root.tag, element, attribute)
                found.append((element.tag, entry, attribute, id(element), element.get("name", "")))
    return grouped(found)


def grouped(found: Iterable[tuple[str, Entry, str, Hashable, str]]) -> Iterator[Fate]:
    """Yield a fate for all attributes of a kind of element that have the same entry.

    Args:
        found: Kind of element, entry, attribute ("" for the element as a whole), the element, and
            its name ("" if it has none).
    """
    by_fate: dict[tuple[str, Entry], list[tuple[str, Hashable, str]]] = defaultdict(list)
    for kind, entry, attribute, element, name in found:
        by_fate[kind, entry].append((attribute, element, name))
    for (kind, (outcome, moves, reason)), rows in by_fate.items():
        attributes = dict.fromkeys(attribute for attribute, _, _ in rows if attribute)
        names = {element: name for _, element, name in rows}
        places = tuple(filter(None, names.values()))
        yield Fate(kind, tuple(attributes), outcome, reason, moves, places, len(names))


def _walk(root: Element, whole: set[str]) -> Iterator[Element]:
    """Yield the elements to report; those inside an element of `whole` are left out."""
    stack = [root]
    while stack:
        element = stack.pop()
        if element.tag in _REPORTED[root.tag]:
            continue
        if element.attrib or element.tag in whole or not len(element):
            yield element
        if element.tag not in whole:
            stack += reversed(element)


def _look_up(kind: str, element: Element, attribute: str) -> Entry:
    """Return the fate of an attribute, or of its element if the format's table does not name it.

    An attribute that its table does not name is only kept if it is a known one of MJCF: readers of
    URDF and SDF ignore any other, and MuJoCo's next release may understand it.
    """
    table = _TABLES[kind]
    fate = table.get(f"{element.tag}@{attribute}")
    if attribute.partition(":")[0] == "xmlns":
        return _NAMESPACE
    if fate is None:
        fate = table.get(element.tag, _UNKNOWN)
        known = _KNOWN.get(element.tag, attribute).split() if kind == "mujoco" else ()
        if attribute and attribute not in known and fate[0] == "kept":
            fate = _UNKNOWN
    if attribute in _NONE_AT_ZERO and not element.get(attribute, "").strip("0. "):
        return _NONE
    return fate


def fates_of_stage(stage: Any, *, limited: bool, touching: bool) -> Iterator[Fate]:
    """Walk a stage and return the fates of all authored properties, and of shapes that collide.

    Args:
        stage: The stage.
        limited: Whether limits are reported joint by joint.
        touching: Whether shapes touch the ground, and are reported one by one.
    """
    from pxr import Usd

    table = _USD | _USD_TOUCHING if touching else _USD
    found = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        kind, place = str(prim.GetTypeName()) or "Prim", prim.GetName()
        solid = "PhysicsCollisionAPI" in prim.GetAppliedSchemas()
        names = dict.fromkeys(each.GetName() for each in prim.GetAuthoredProperties())
        for name in names | ({_COLLIDES: None} if solid else {}):
            parsed, timed = _is_parsed(prim, name), _is_timed(prim, name)
            reported = (name in _USD_LIMITS and limited) or (parsed and name.startswith("drive"))
            if timed or not reported:
                entry = _usd_entry(table | _USD_SHAPE[touching] if solid else table, name)
                entry = _USD["physics:axis"] if parsed else entry
                if timed and entry[1]:
                    entry = _AT_TIMES
                elif _is_neutral(name, prim.GetAttribute(name)):
                    entry = _NONE
                found.append((kind, entry, name, prim.GetPath(), place))
    return grouped(found)


def _is_parsed(prim: Any, name: str) -> bool:
    """Whether a property belongs to a drive or limit that the reader takes."""
    first, _, rest = name.partition(":")
    axis = rest.partition(":")[0]
    applied = f"Physics{first.title()}API:{axis}" in prim.GetAppliedSchemas()
    return applied and axis in _PARSED_AXES.get((first, str(prim.GetTypeName())), ())


def _is_timed(prim: Any, name: str) -> bool:
    """Whether an attribute has values at times; those of a transform must move a solid or body."""
    from pxr import Usd

    attribute = prim.GetAttribute(name)
    if not attribute or not attribute.GetNumTimeSamples():
        return False
    below = Usd.PrimRange(prim, Usd.TraverseInstanceProxies())
    schemas = (schema for each in below for schema in each.GetAppliedSchemas())
    return not name.startswith("xformOp") or any(each.startswith("Physics") for each in schemas)


def _is_neutral(name: str, attribute: Any) -> bool:
    """Whether the value of a property that is dropped has no effect: at rest, unbounded."""
    value: Any = attribute.Get() if attribute else None
    if name.startswith("physics:break"):
        return isinstance(value, float) and value >= _NEVER
    if name.startswith("physics:coneAngle"):
        return isinstance(value, float) and value < 0
    speed = name in ("physics:velocity", "physics:angularVelocity") or name.startswith("state:")
    return speed and not any(value if hasattr(value, "__len__") else [value])


def _usd_entry(table: Mapping[str, Entry], name: str) -> Entry:
    first = name.partition(":")[0]
    for key in (name, first):
        if key in table:
            return table[key]
    if name in _USD_LIMITS:
        return ("kept", True, "none, or without bounds")
    if first == "physics" or first.startswith(_SIMULATORS):
        return ("dropped", True, "unknown to this reader")
    if first == "xformOp" or name == "xformOpOrder":
        return ("kept", True, "as the library of OpenUSD composes it")
    return ("dropped", False, "drawn only")

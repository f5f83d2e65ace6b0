"""What becomes of every element and attribute of MJCF and URDF, as one table.

Keys are `element` and `element@attribute`; the latter counts first, and what stands in no row is
dropped as unknown. Properties of joints have a table of their own
(`assembling.PROPERTIES`), and what the compiled model tells better is told from there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from xml.etree.ElementTree import Element

from mbds_xsim.scene.imported import Fate, Outcome

_Row = tuple[Outcome, bool, str, str]
"""Outcome, whether it bears on the motion, the reason, keys."""

_APART = "no collisions of bodies are made of a model"
COLLISION = f"{_APART}; with --ground they meet a plane"
_SOLVER = "a setting of an engine, not of the mechanism"
_DRAWN = "drawn only"
_Looked = tuple[Outcome, bool, str]
_UNKNOWN: _Looked = ("dropped", True, "unknown to this reader")
_NONE: _Looked = ("kept", True, "none, or zero")

_MJCF: tuple[_Row, ...] = (
    (
        "kept",
        True,
        "as the compiler resolves it",
        "mujoco compiler default model attach body inertial frame replicate joint freejoint "
        "option@gravity joint@ref",
    ),
    (
        "kept",
        True,
        "what it switches off in MuJoCo is not in the scene either",
        "flag@gravity flag@spring flag@damper flag@passive flag@limit flag@frictionloss "
        "flag@equality flag@constraint flag@contact flag@actuation",
    ),
    ("kept", True, "its mass and inertia, where its body states none", "geom mesh hfield"),
    (
        "dropped",
        False,
        COLLISION,
        "geom@contype geom@conaffinity geom@condim geom@priority geom@friction exclude",
    ),
    ("dropped", True, _APART, "pair"),
    (
        "dropped",
        False,
        _SOLVER,
        "geom@solmix geom@solref geom@solimp geom@margin geom@gap "
        "option flag size statistic joint@solreflimit joint@solimplimit joint@solreffriction "
        "joint@solimpfriction joint@margin body@sleep",
    ),
    ("dropped", True, "there is no fluid", "option@density option@viscosity option@wind "
     "geom@fluidshape geom@fluidcoef"),
    ("dropped", True, "there are no magnetic fields", "option@magnetic"),
    ("dropped", True, "gravity acts on all bodies alike", "body@gravcomp"),
    ("dropped", False, "for actuators only", "joint@actuatorfrcrange joint@actuatorfrclimited "
     "joint@actuatorgravcomp"),
    (
        "dropped",
        False,
        _DRAWN,
        "visual site camera light texture material skin geom@material geom@rgba geom@group "
        "joint@group mesh@material bone layer",
    ),
    ("dropped", False, "data for other programs", "custom sensor user numeric text tuple"),
    ("dropped", False, "a pose beside the reference pose, at which the scene starts", "keyframe"),
    ("kept", True, "as the compiler resolves it for each actuator",
     "motor position velocity intvelocity general damper cylinder muscle adhesion dcmotor"),
    ("dropped", True, "a plugin may exert anything", "extension plugin"),
    ("dropped", True, "bodies are rigid", "deformable flex flexcomp composite"),
)  # fmt: skip

_URDF: tuple[_Row, ...] = (
    (
        "kept",
        True,
        "as the format says",
        "robot@name link@name link inertial mass@value origin@xyz origin@rpy inertia@ixx "
        "inertia@ixy inertia@ixz inertia@iyy inertia@iyz inertia@izz joint@name joint@type "
        "parent@link child@link axis@xyz",
    ),
    ("dropped", False, "names of other formats", "robot@xmlns:xacro robot@version"),
    ("dropped", False, _DRAWN, "visual material"),
    ("dropped", True, COLLISION, "collision"),
    ("dropped", False, "a limit of the drive", "limit@effort limit@velocity"),
    (
        "dropped",
        False,
        "for controllers",
        "safety_controller calibration transmission ros2_control",
    ),
    ("dropped", True, "an extension of one simulator", "gazebo contact self_collision_checking"),
    ("dropped", False, "read by MuJoCo's compiler alone", "mujoco"),
)
_SDF: tuple[_Row, ...] = (
    (
        "kept",
        True,
        "as DART's parser reads it",
        "sdf@version world@name model@name link@name link pose joint@name joint@type parent child "
        "xyz use_parent_model_frame static",
    ),
    ("kept", True, "as the format says", "inertial mass inertia ixx ixy ixz iyy iyz izz"),
    ("kept", True, "it names no frame", "pose@frame"),
    ("dropped", False, _DRAWN, "visual light scene gui material"),
    ("dropped", True, COLLISION, "collision"),
    ("kept", True, "who meets whom", "surface collide_bitmask collide_without_contact"),
    ("dropped", True, "a restitution counts at all speeds", "threshold"),
    ("dropped", True, "the ground has the same friction along all directions",
     "mu2 fdir1 slip1 slip2"),
    ("dropped", False, _SOLVER, "max_contacts kp kd max_vel min_depth soft_cfm soft_erp"),
    ("dropped", False, _APART, "self_collide"),
    ("dropped", False, "a limit of the drive", "effort velocity"),
    ("dropped", False, _SOLVER, "physics"),
    ("dropped", True, "an extension of one simulator", "plugin"),
    ("dropped", False, "data for other programs", "sensor audio laser_retro"),
    ("dropped", True, "there is no such damping of bodies", "velocity_decay"),
    ("dropped", True, "gravity acts on all bodies alike", "link/gravity"),
    ("kept", True, "as DART's parser reads it", "gravity"),
    ("dropped", True, "DART's parser passes it over",
     "gearbox_ratio gearbox_reference_body"),
)  # fmt: skip
_TABLES = {"mujoco": _MJCF, "robot": _URDF, "sdf": _SDF}
_TOLD_ELSEWHERE = {"mujoco": {"equality", "tendon", "actuator"}, "robot": {"mimic"}, "sdf": set()}
"""Elements of which the compiled model says more."""
_WHOLE = {"visual", "custom", "sensor", "keyframe", "collision", "gazebo", "transmission",
          "material", "extension", "plugin", "skin", "ros2_control", "contact", "physics",
          "velocity_decay", "light", "gui", "scene", "geometry", "torsional"}  # fmt: skip
"""Elements whose children have their fate."""
_OPEN = {"mujoco": {"contact"}, "robot": set(), "sdf": {"contact"}}
"""Those of a format whose children have one each."""
_NONE_AT_ZERO = {"density", "viscosity", "wind", "magnetic", "gravcomp"}


def fates_of(
    root: Element, told: Mapping[tuple[str, str], bool], *, touching: bool = False
) -> Iterator[Fate]:
    """Walk a document, and say of each element and attribute what becomes of it.

    Args:
        root: Of the document.
        told: Elements and attributes that say a property of joints; true where one has it, and
            its fate is told for each joint.
        touching: Whether what is in collision shapes has a fate of its own.
    """
    table = {key: row[:3] for row in _TABLES[root.tag] for key in row[3].split()}
    found: dict[tuple[str, _Looked], list[tuple[str, Element]]] = defaultdict(list)
    whole = _WHOLE - _OPEN[root.tag] - ({"collision"} if touching else set())
    for element in _walk(root, whole):
        for attribute in element.attrib or ("",):
            if (said := told.get((element.tag, attribute))) is None:
                fate = _look_up(table, element, attribute, exact=root.tag != "mujoco")
            elif said:
                continue
            else:
                fate = _NONE
            found[element.tag, fate].append((attribute, element))
    for (tag, fate), pairs in found.items():
        outcome, moves, reason = fate
        elements = {id(element): element for _, element in pairs}
        yield Fate(
            tag,
            tuple(dict.fromkeys(attribute for attribute, _ in pairs if attribute)),
            outcome,
            reason,
            moves,
            tuple(filter(None, (e.get("name", "") for e in elements.values()))),
            len(elements),
        )


def _walk(root: Element, whole: set[str]) -> Iterator[Element]:
    """Give each element that says something; of some, what is in them goes unsaid."""
    waiting = [root]
    while waiting:
        element = waiting.pop()
        if element.tag in _TOLD_ELSEWHERE[root.tag]:
            continue
        if element.attrib or element.tag in whole or not len(element):
            yield element
        if element.tag not in whole:
            waiting += reversed(element)


def _look_up(
    table: Mapping[str, _Looked], element: Element, attribute: str, *, exact: bool
) -> _Looked:
    """Find the fate of an attribute, or of its element's attributes where it has none itself.

    With `exact` no attribute is kept that the table does not name: a format whose reader ignores
    what it does not know.
    """
    fate = table.get(f"{element.tag}@{attribute}")
    if fate is None:
        fate = table.get(element.tag, _UNKNOWN)
        if exact and attribute and fate[0] == "kept":
            fate = _UNKNOWN
    if attribute in _NONE_AT_ZERO and not element.get(attribute, "").strip("0. "):
        return _NONE
    return fate

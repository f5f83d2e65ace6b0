"""A scene as MJCF: body frames are native frames, so joints and sites are plain differences.

It is MJCF text and not an `MjSpec`, because `MjSpec.to_xml` rounds to six digits: users see exactly
what the engine gets. Elements: https://mujoco.readthedocs.io/en/stable/XMLreference.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.xml import indented, numbers
from mbds_xsim.scene.joint_space import representatives
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint, PointPair
from mbds_xsim.scene.servo import Servo

from .contact import Impact, add_contacts, cone_options, stop_law
from .state import joint_name, slim

_JOINT_TYPES = {"ball": "ball", "hinge": "hinge", "slider": "slide"}
"""MuJoCo's names of the joints that have coordinates; a fixed joint is the absence of one."""

_ROUNDED = 1e-10
"""A + B and C of a body are equal but for rounding, if they differ by less than this part of C."""
_DOUBLINGS = 16

# Points of a loop joint's axis that are kept together, in lengths of the scene from the anchor.
# A hinge's two points make six rows, one more than needed. A weld holds directions, too.
CLOSING_POINTS: dict[str, tuple[float, ...]] = {
    "ball": (0.0,),
    "hinge": (-0.5, 0.5),
    "fixed": (0.0,),
}

_NOT_IN_MJCF = (
    " Held over each recorded frame: forces as xfrc_applied, hinge torques as ctrl, and behind "
    "these what targets exert. The keyframe is the start."
)


@dataclass(frozen=True)
class StepOptions:
    """Options of stepping, in MuJoCo's terms."""

    integrator: str
    timestep: float
    """Step [s]."""
    solver: str
    loop_time_constant: float
    """Time constant of the constraints that close loops [s]; 0 leaves MuJoCo's default softness."""
    link_time_constant: float
    """The same for distance links."""
    impact: Impact
    hard_limits: bool
    """Whether stops take all of a velocity in a step, unlike MuJoCo's soft default."""
    # Newton's sparse factorisation gives wrong accelerations in 4.0.0:
    # https://github.com/google-deepmind/mujoco/issues/3767
    jacobian: str = "dense"
    resets: bool = True
    """Whether the engine resets a diverged state to the reference pose unless told not to."""


def mjcf(mechanism: Mechanism, stepping: StepOptions, idle: Array) -> Element:
    """Translate the scene to MJCF, and add nothing that it does not ask for.

    Args:
        mechanism: Mechanism of the scene.
        stepping: Options of stepping.
        idle: Axes of rods about which nothing spins, in native frames, zero for other bodies,
            shape (body, 3).
    """
    root = Element("mujoco", model=mechanism.scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="false")
    _option(root, mechanism, stepping)
    loops, links = map(_softness, (stepping.loop_time_constant, stepping.link_time_constant))
    bodies = mechanics(root, mechanism, idle, loops, links)
    for joint in mechanism.limited if stepping.hard_limits else ():
        law = stop_law(joint.restitution, stepping.timestep)
        element = bodies[mechanism.carried[joint.index]].find("joint")
        assert element is not None
        element.attrib.update({f"{key}limit": value for key, value in law.items()})
    add_contacts(root, bodies, mechanism, stepping.impact)
    if mechanism.hinges or mechanism.drives:
        actuators = SubElement(root, "actuator")
        _motors(actuators, bodies, mechanism)
        for drive in mechanism.drives:  # their commands are the pushes of their targets
            add_servo(actuators, drive.servo)
    return root


def mechanics(
    root: Element,
    mechanism: Mechanism,
    idle: Array,
    loops: dict[str, str],
    links: dict[str, str],
) -> dict[int, Element]:
    """Add bodies, joints, loops, links, springs and couplings; return the element of each body.

    Args:
        root: Element to add to.
        mechanism: Mechanism of the scene.
        idle: Axes as in `mjcf`.
        loops: Attributes of the equalities that close loops and couple joints, and of friction.
        links: The same for distance links.
    """
    grip = {f"{key}friction": value for key, value in loops.items()}
    bodies = _bodies(SubElement(root, "worldbody"), mechanism, idle, grip)
    tendons, equalities = Element("tendon"), Element("equality")
    for joint in open_loops(mechanism):
        equalities.extend(_closing(bodies, joint, mechanism.scene.length, loops))
    for link in mechanism.distances:
        _distance(tendons, equalities, bodies, mechanism, link, links)
    for spring in mechanism.springs:
        _spring(tendons, bodies, spring)
    for coupling in mechanism.couplings:
        pair = (joint_name(each.name) for each in (coupling.follower, coupling.leader))
        ends = dict(zip(("joint1", "joint2"), pair, strict=True))
        law = {"polycoef": numbers((coupling.offset, coupling.ratio, 0.0, 0.0, 0.0))}
        SubElement(equalities, "joint", ends | law | loops)
    root.extend(element for element in (tendons, equalities) if len(element))
    return bodies


def open_loops(mechanism: Mechanism) -> list[PlacedJoint]:
    """Return the joints that close loops, but for those whose bodies the tree has welded."""
    welded = representatives(mechanism)
    return [joint for joint in mechanism.loops if welded[joint.parent] != welded[joint.child]]


def closing_point(joint: PlacedJoint, k: int) -> str:
    """Name the k-th point at which a loop joint is closed."""
    return f"{joint.name} {k}"


def with_start(xml: str, qpos: Array, qvel: Array, command: Array, remark: str) -> str:
    """Add the scene's start as a keyframe, and a comment on inputs, which MJCF has no place for."""
    root = ElementTree.fromstring(xml)
    text = re.sub("-(?=-)", "- ", f"{_NOT_IN_MJCF}{remark} ")  # names may have what XML forbids
    root.insert(0, ElementTree.Comment(text))
    keyframe = SubElement(root, "keyframe")
    key = SubElement(keyframe, "key", name="start", qpos=numbers(qpos), qvel=numbers(qvel))
    if command.any():
        key.set("ctrl", numbers(command))
    return indented(root)


def _option(root: Element, mechanism: Mechanism, stepping: StepOptions) -> None:
    option = SubElement(
        root,
        "option",
        timestep=repr(stepping.timestep),
        integrator=stepping.integrator,
        solver=stepping.solver,
        gravity=numbers(mechanism.scene.gravity),
        jacobian=stepping.jacobian,
        # A cost improvement below this ends the solver; at the default 1e-8 it stops early.
        tolerance="1e-14",
    )
    if mechanism.scene.contacts:
        option.attrib.update(cone_options(stepping.impact))
    # Without autoreset off, a diverged state silently goes back to the reference pose.
    flags = [*(["autoreset"] if stepping.resets else []), *_idle(mechanism)]
    # Releases before 3.2 and 3.3.6 do not know all of them: they reset with a warning, which also
    # ends a trajectory, and spend time on idle parts.
    known = [flag for flag in flags if hasattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}")]
    SubElement(option, "flag", dict.fromkeys(known, "disable"))


def _idle(mechanism: Mechanism) -> list[str]:
    """Name the parts of a step that have nothing to do: a tenth of the time of a short chain."""
    parts = {
        "actuation": (*mechanism.hinges, *mechanism.drives),
        "spring": (*mechanism.springs, *mechanism.compliant),
        "damper": (*mechanism.springs, *mechanism.compliant),
        "contact": mechanism.scene.contacts,
        "constraint": (
            *mechanism.loops,
            *mechanism.distances,
            *mechanism.couplings,
            *mechanism.frictional,
            *mechanism.limited,
            *mechanism.scene.contacts,
        ),
        "limit": mechanism.limited,
        "frictionloss": mechanism.frictional,
        "sensor": (),
    }
    return [name for name, work in parts.items() if not work]


def _bodies(
    world: Element, mechanism: Mechanism, idle: Array, grip: dict[str, str]
) -> dict[int, Element]:
    """Nest the spanning tree; return the element of each body and of the world."""
    elements = {WORLD_INDEX: world}
    for link in mechanism.links:
        above, axis = elements[link.parent], idle[link.body]
        elements[link.body] = _body(above, mechanism, link, axis, grip)
    return elements


def _body(
    above: Element, mechanism: Mechanism, link: Link, axis: Array, grip: dict[str, str]
) -> Element:
    origin = mechanism.com[link.parent] if link.parent != WORLD_INDEX else np.zeros(3)
    name = mechanism.scene.bodies[link.body].name
    body = SubElement(above, "body", name=name, pos=numbers(mechanism.com[link.body] - origin))
    tensor = mechanism.inertia[link.body]
    if axis.any():
        tensor = slim(tensor, axis)
    tensor = _accepted(tensor)
    SubElement(
        body,
        "inertial",
        pos="0 0 0",
        mass=repr(float(mechanism.mass[link.body])),
        fullinertia=_full(tensor),
    )
    joint = link.joint
    if joint is None:
        SubElement(body, "freejoint")
    elif axis.any():
        for cross in rotation.normal_to(axis):  # without names, which other joints may have
            _joint(body, "", "hinge", joint.in_child, cross)
    elif joint.kind != "fixed":
        name, kind = joint_name(joint.name), _JOINT_TYPES[joint.kind]
        element = _joint(body, name, kind, joint.in_child, joint.axis)
        if joint.complies:
            law = {"stiffness": joint.stiffness, "damping": joint.damping, "springref": joint.rest}
            element.attrib.update({key: repr(value) for key, value in law.items()})
        if joint.armature:
            element.set("armature", repr(joint.armature))
        if joint.friction:
            element.set("frictionloss", repr(joint.friction))
            element.attrib.update(grip)
        if joint.limits:
            element.attrib.update(limited="true", range=numbers(joint.limits))
    return body


def _full(tensor: Array) -> str:
    return numbers(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


def _accepted(tensor: Array) -> Array:
    """Return the inertia of a flat body as the compiler accepts it: A + B >= C in its own rounding.

    Where it refuses, C shrinks by what is missing and a unit in the last place, and by more until
    it does not.
    """
    values, axes = np.linalg.eigh(tensor)
    excess = values[2] - values[0] - values[1]
    if abs(excess) > _ROUNDED * values[2] or _compiles(tensor):
        return tensor
    least = max(excess, 0.0) + np.spacing(values[2])
    for k in range(_DOUBLINGS):
        change = 2.0**k * least
        smaller = tensor - change * np.outer(axes[:, 2], axes[:, 2])
        if _compiles(smaller):
            return np.asarray(smaller)
    return tensor


def _compiles(tensor: Array) -> bool:
    """Whether the compiler accepts a body of this inertia."""
    inertial = f'<inertial pos="0 0 0" mass="1" fullinertia="{_full(tensor)}"/>'
    try:
        mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><body>{inertial}</body></worldbody></mujoco>"
        )
    except ValueError:
        return False
    return True


def _joint(body: Element, name: str, kind: str, anchor: Array, axis: Array) -> Element:
    names = {"name": name} if name else {}
    axes = {"axis": numbers(axis)} if axis.any() else {}
    return SubElement(body, "joint", names | {"type": kind, "pos": numbers(anchor)} | axes)


def _softness(tau: float) -> dict[str, str]:
    """Return attributes that make a gap g follow g̈ + 2 ġ/τ + g/τ² = 0, with hardness 0.9999."""
    if tau == 0:
        return {}
    return {
        "solref": numbers((-1.0 / tau**2, -2.0 / tau)),
        "solimp": "0.9999 0.9999 0.001 0.5 2",
    }


def _closing(
    bodies: dict[int, Element], joint: PlacedJoint, length: float, softness: dict[str, str]
) -> Iterator[Element]:
    """Mark the points at which a loop joint is closed, and yield the equality of each."""
    weld = joint.kind == "fixed"
    kind = "weld" if weld else "connect"
    for k, along in enumerate(CLOSING_POINTS[joint.kind]):
        name, offset = closing_point(joint, k), along * length * joint.axis
        ends = dict(zip(("site1", "site2"), _sites(bodies, joint, offset, name), strict=True))
        # In a weld, an angle counts like a gap at the end of the scene's length.
        turns = {"torquescale": repr(length)} if weld else {}
        yield Element(kind, {"name": name} | ends | turns | softness)


def _sites(
    bodies: dict[int, Element], joint: PlacedJoint, offset: Array, name: str
) -> tuple[str, str]:
    """Mark a point of the joint, offset from its anchor, in the parent and in the child."""
    return (
        _site(bodies[joint.parent], f"{name} parent", joint.in_parent + offset),
        _site(bodies[joint.child], f"{name} child", joint.in_child + offset),
    )


def _site(body: Element, name: str, point: Array) -> str:
    SubElement(body, "site", name=name, pos=numbers(point))
    return name


def _distance(
    tendons: Element,
    equalities: Element,
    bodies: dict[int, Element],
    mechanism: Mechanism,
    link: PointPair,
    softness: dict[str, str],
) -> None:
    tendon = _tendon(tendons, bodies, link, f"{link.name} link")
    ends = [
        point + (mechanism.com[body] if body != WORLD_INDEX else 0.0)
        for body, point in zip(link.bodies, link.in_body, strict=True)
    ]
    # The constraint counts from the length at the reference pose.
    extension = link.length - float(np.linalg.norm(ends[1] - ends[0]))
    target = {"tendon1": tendon.attrib["name"], "polycoef": f"{extension!r} 0 0 0 0"}
    SubElement(equalities, "tendon", target | softness)


def _spring(tendons: Element, bodies: dict[int, Element], spring: PointPair) -> None:
    tendon = _tendon(tendons, bodies, spring, f"{spring.name} spring")
    tendon.set("stiffness", repr(spring.stiffness))
    tendon.set("damping", repr(spring.damping))
    tendon.set("springlength", repr(spring.length))


def _tendon(tendons: Element, bodies: dict[int, Element], pair: PointPair, name: str) -> Element:
    tendon = SubElement(tendons, "spatial", name=name)
    for end, (body, point) in enumerate(zip(pair.bodies, pair.in_body, strict=True)):
        SubElement(tendon, "site", site=_site(bodies[body], f"{name} {end}", point))
    return tendon


def add_servo(actuators: Element, servo: Servo, push: float = 0.0, **gain: str) -> None:
    """Add a servo that may saturate: what it exerts at a command of 0.

    Args:
        actuators: Element to add to.
        servo: The servo.
        push: What it exerts at a coordinate and a rate of 0 [N·m or N].
        gain: Attributes of the gain by which a command counts; 1 without any.
    """
    bias = numbers((push, -servo.stiffness, -servo.damping))
    law = {"joint": joint_name(servo.joint), **gain, "biastype": "affine", "biasprm": bias}
    actuator = SubElement(actuators, "general", law)
    if servo.limit is not None:
        actuator.attrib.update(forcelimited="true", forcerange=numbers((-servo.limit, servo.limit)))


def _motors(actuators: Element, bodies: dict[int, Element], mechanism: Mechanism) -> None:
    """Add one motor per hinge, in the order of `Batch.torque`.

    On a hinge that closes a loop it acts between two sites, about an axis fixed in the parent's:
    equal and opposite torques that turn with the bodies.
    """
    for hinge in mechanism.hinges:
        if hinge.index in mechanism.carried:
            SubElement(actuators, "motor", name=hinge.name, joint=joint_name(hinge.name))
            continue
        parent, child = _sites(bodies, hinge, np.zeros(3), f"{hinge.name} motor")
        SubElement(
            actuators,
            "motor",
            name=hinge.name,
            site=child,
            refsite=parent,
            gear=numbers((0.0, 0.0, 0.0, *hinge.axis)),
        )

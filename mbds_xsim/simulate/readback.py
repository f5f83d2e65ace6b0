"""Compare the native model, as the engine reports it, with the scene, before the first step.

Adapters of engines that hold the spanning tree put its joints into scene order by `joint_axes` and
`joint_anchors`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.scene.scene import WORLD
from mbds_xsim.scene.spin import idle_axes
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import rounding
from mbds_xsim.simulate.adapter import Readback, Settings
from mbds_xsim.simulate.claims import Method

_Quantity = tuple[str, Array | None, Array, float, list[str]]
"""Name, values read, values wanted, least scale of a difference, and the rows' names."""

_TOLERANCE = 1e-9
_MISSING = 1e-6
_PAIR = ("radius of contact [m]", "friction", "restitution")
_BETWEEN = ("friction of a collision", "restitution of a collision")
_LAW = ("stiffness", "damping", "coordinate at rest")
_SERVO = ("stiffness of the servo", "damping of the servo", "limit of the servo")
_SPRING = ("stiffness [N/m]", "damping [N·s/m]", "rest length [m]", "length at the start [m]")


def compare(
    mechanism: Mechanism,
    batch: Batch,
    settings: Settings,
    readback: Readback,
    method: Method | None = None,
) -> list[str]:
    """List the differences between the engine's model and the scene, each in one line.

    Figures are relative to the largest element of the expected array, or to the scene's length
    for positions. The method determines the precision of the engine's values; double without one.
    """
    lines, allowed = [], max(_TOLERANCE, rounding.state_error(mechanism, method))
    for quantity, got, wanted, floor, names in _quantities(mechanism, batch, readback):
        if got is not None and (len(wanted) or got.size):
            lines += _differences(quantity, got, wanted, floor, names, allowed)
    off = 0.0 if readback.step is None else abs(readback.step - settings.step)
    if not off <= allowed * settings.step:
        lines.append(f"step: got {readback.step:.9g} s, the settings say {settings.step:.9g} s")
    slack = rounding.state_error(mechanism, method) * _most_damping(mechanism)
    if readback.damping is not None and np.any(np.abs(readback.damping) > slack):
        lines.append(f"damping: got up to {np.abs(readback.damping).max():g}, the scene has none")
    return lines


def joint_axes(
    mechanism: Mechanism,
    of_link: Callable[[Link], Array],
    of_loop: Callable[[PlacedJoint], Array] | None = None,
) -> Array:
    """Return the axes for `Readback.joint_axis`, in W, shape (joint, 3).

    Args:
        mechanism: Mechanism of the scene.
        of_link: Function that returns the axis of a link's joint, as it points in the tree.
        of_loop: Function that returns the axis of a loop-closing joint; NaN without it.
    """
    links = {link.joint.index: link for link in mechanism.links if link.joint}
    joints = [joint for joint in mechanism.joints if joint.kind in ("hinge", "slider")]
    axes = np.full((len(joints), 3), np.nan)
    for axis, joint in zip(axes, joints, strict=True):
        if (link := links.get(joint.index)) is not None:
            axis[:] = of_link(link) if link.body == joint.child else -of_link(link)
        elif of_loop is not None:
            axis[:] = of_loop(joint)
    return axes


def joint_anchors(
    mechanism: Mechanism, of_link: Callable[[Link], tuple[Array, Array] | None]
) -> Array:
    """Return the anchors for `Readback.anchor`, in W, shape (joint, 2, 3); NaN for loop joints.

    Args:
        mechanism: Mechanism of the scene.
        of_link: Function that returns the anchor of a link's joint, as fixed in the tree parent and
            in the body; None if the engine does not report it.
    """
    anchors = np.full((len(mechanism.joints), 2, 3), np.nan)
    for link in mechanism.links:
        if link.joint is not None and (ends := of_link(link)) is not None:
            forwards = mechanism.joints[link.joint.index].child == link.body
            anchors[link.joint.index] = ends if forwards else ends[::-1]
    return anchors


def joint_laws(
    mechanism: Mechanism, of_link: Callable[[Link, PlacedJoint], tuple[float, float, float]]
) -> Array:
    """Return the laws for `Readback.law`, shape (joint, 3); NaN for loop joints.

    Args:
        mechanism: Mechanism of the scene.
        of_link: Function that returns stiffness, damping and rest coordinate of a link's joint.
    """
    laws = np.full((len(mechanism.compliant), len(_LAW)), np.nan)
    links = {link.joint.index: link for link in mechanism.links if link.joint}
    for law, joint in zip(laws, mechanism.compliant, strict=True):
        if joint.index in links:
            law[:] = of_link(links[joint.index], joint)
    return laws


def _most_damping(mechanism: Mechanism) -> float:
    """Return the scene's largest damping, the scale of rounding errors in an engine's surplus."""
    dampings = [spring.damping for spring in mechanism.springs]
    return max(dampings + [joint.damping for joint in mechanism.compliant], default=0.0)


def _quantities(mechanism: Mechanism, batch: Batch, readback: Readback) -> Iterator[_Quantity]:
    """Yield all quantities that both sides hold."""
    scene, length = mechanism.scene, mechanism.scene.length
    bodies = [body.name for body in scene.bodies]
    completed = _with_idle_spin(mechanism, batch, readback)
    orientation = _turn(completed, batch)
    yield "mass [kg]", completed.mass, mechanism.mass, 0.0, bodies
    yield "inertia [kg·m²]", completed.inertia, mechanism.inertia, 0.0, bodies
    yield "start: centre of mass [m]", completed.com, batch.position[0], length, bodies
    yield "start: velocity [m/s]", completed.velocity, batch.velocity[0], 1.0, bodies
    spin, wanted = completed.angular_velocity, batch.angular_velocity[0]
    yield "start: angular velocity [rad/s]", spin, wanted, 1.0, bodies
    yield "start: orientation", orientation, batch.orientation[0], 1.0, bodies
    gravity = None if readback.gravity is None else readback.gravity[None]
    yield "gravity [m/s²]", gravity, np.array([scene.gravity]), 1.0, ["W"]
    world = BodyStates.of(mechanism, batch[:1])[0].with_world()
    yield from _of_joints(mechanism, world, readback)
    yield from _of_springs(mechanism, world, readback)
    laws = np.array([(j.stiffness, j.damping, j.rest) for j in mechanism.compliant]).reshape(-1, 3)
    names = [joint.name for joint in mechanism.compliant]
    for quantity, key, joints in (
        ("armature", "armature", mechanism.rotors),
        ("dry friction", "friction", mechanism.frictional),
    ):
        wanted = np.array([[getattr(joint, key)] for joint in joints]).reshape(-1, 1)
        values: Array | None = getattr(readback, key)
        got = None if values is None else values.reshape(-1, 1)
        yield quantity, got, wanted, 0.0, [joint.name for joint in joints]
    yield from _columns("joints", _LAW, _known(readback.law, laws), laws, names)
    stops = np.array([joint.limits for joint in mechanism.limited])
    names = [joint.name for joint in mechanism.limited]
    yield from _columns("joints", ("lower limit", "upper limit"), readback.limits, stops, names)
    drives = np.array([drive.as_read() for drive in mechanism.drives])
    names = [drive.joint.name for drive in mechanism.drives]
    yield from _columns("servos", _SERVO, _known(readback.drive, drives), drives, names)
    couplings = np.array([(coupling.ratio, coupling.offset) for coupling in mechanism.couplings])
    names = [coupling.name for coupling in mechanism.couplings]
    got = _known(readback.coupling, couplings)
    yield from _columns("couplings", ("ratio", "offset"), got, couplings, names)
    yield from _of_contact(mechanism, world, readback)


def _of_joints(mechanism: Mechanism, world: BodyStates, readback: Readback) -> Iterator[_Quantity]:
    joints = [joint for joint in mechanism.joints if joint.kind in ("hinge", "slider")]
    axes = np.array([world.arms(joint.parent, joint.axis) for joint in joints])
    names = [joint.name for joint in joints]
    yield "axis", _known(readback.joint_axis, axes), axes, 1.0, names
    ends = [
        (world.points(j.parent, j.in_parent), world.points(j.child, j.in_child))
        for j in mechanism.joints
    ]
    names = [
        f"{joint.name} in {mechanism.scene.bodies[end].name if end != WORLD_INDEX else WORLD}"
        for joint in mechanism.joints
        for end in (joint.parent, joint.child)
    ]
    wanted = np.array(ends)
    got = _known(readback.anchor, wanted)
    if got is not None and got.shape == wanted.shape:
        got, wanted = got.reshape(-1, 3), wanted.reshape(-1, 3)
    yield "anchor [m]", got, wanted, mechanism.scene.length, names


def _of_springs(mechanism: Mechanism, world: BodyStates, readback: Readback) -> Iterator[_Quantity]:
    names, wanted = [spring.name for spring in mechanism.springs], []
    for spring in mechanism.springs:
        first, second = world.points(list(spring.bodies), np.array(spring.in_body))
        wanted.append(spring.as_read(second - first))
    yield from _columns("springs", _SPRING, readback.spring, np.array(wanted), names)


def _of_contact(mechanism: Mechanism, world: BodyStates, readback: Readback) -> Iterator[_Quantity]:
    scene, ground, collisions = mechanism.scene, mechanism.scene.ground, mechanism.scene.collisions
    if not scene.contacts:
        return
    names = [f"sphere {k} on {sphere.body}" for k, sphere in enumerate(scene.contacts)]
    places = world.points(mechanism.sphere_body, mechanism.sphere_offset)
    got = _known(readback.sphere, places)
    yield "centre of contact [m]", got, places, scene.length, names
    law = (ground.friction, ground.restitution) if ground else (0.0, 0.0)
    wanted = np.array([(sphere.radius, *law) for sphere in scene.contacts])
    yield from _columns("contact", _PAIR, _known(readback.contact, wanted), wanted, names)
    if collisions is None:
        return
    names = [f"{names[one]} and {names[other]}" for one, other in mechanism.sphere_pairs.tolist()]
    wanted = np.array([(collisions.friction, collisions.restitution)] * len(names))
    yield from _columns("collision", _BETWEEN, _known(readback.collision, wanted), wanted, names)


def _columns(
    quantity: str, columns: tuple[str, ...], got: Array | None, wanted: Array, names: list[str]
) -> Iterator[_Quantity]:
    """Split a table of coefficients (item, column) into columns, each with its own scale."""
    wanted = wanted.reshape(-1, len(columns))  # also without items
    if got is None or got.shape != wanted.shape:
        yield quantity, got, wanted, 0.0, names
        return
    for k, column in enumerate(columns):
        yield column, got[:, [k]], wanted[:, [k]], 0.0, names


def _known(got: Array | None, wanted: Array) -> Array | None:
    """Replace NaN, for values an engine cannot report, by the wanted values."""
    return got if got is None or got.shape != wanted.shape else np.where(np.isnan(got), wanted, got)


def _with_idle_spin(mechanism: Mechanism, batch: Batch, readback: Readback) -> Readback:
    """Complete inertia, orientation and spin of bodies that never spin, if the engine omits them.

    This applies only if the engine has no inertia about such a body's axis.
    """
    axes = idle_axes(mechanism.scene)
    moments = np.einsum("ki,kij,kj->k", axes, readback.inertia, axes)
    wanted = np.einsum("ki,kij,kj->k", axes, mechanism.inertia, axes)
    slim = moments < _MISSING * wanted
    axes = np.where(slim[:, None], axes, 0.0)
    along = axes[:, :, None] * axes[:, None, :]
    expected = mechanism.native_rotation(batch.orientation[0])
    got = mechanism.native_rotation(readback.orientation)
    surplus = rotation.angle_about(rotation.multiply(rotation.conjugate(expected), got), axes)
    native = rotation.multiply(got, rotation.from_vector(-surplus[:, None] * axes))
    axis = rotation.rotate(expected, axes)
    spin = np.sum(readback.angular_velocity * axis, axis=-1, keepdims=True)
    return dataclasses.replace(
        readback,
        inertia=readback.inertia + (wanted - moments)[:, None, None] * along,
        orientation=mechanism.body_orientation(np.where(slim[:, None], native, got)),
        angular_velocity=readback.angular_velocity - spin * axis,
    )


def _turn(readback: Readback, batch: Batch) -> Array:
    """Return orientations with the sign of the expected ones (q and −q are one rotation)."""
    sign = np.sign(np.sum(readback.orientation * batch.orientation[0], axis=-1, keepdims=True))
    return readback.orientation * np.where(sign == 0, 1.0, sign)


def _differences(
    quantity: str, got: Array, wanted: Array, floor: float, names: list[str], allowed: float
) -> list[str]:
    if got.shape != wanted.shape:
        return [f"{quantity}: got shape {got.shape}, the scene has {wanted.shape}"]
    scale = max(floor, float(np.abs(wanted).max())) or 1.0
    off = np.abs(got - wanted).reshape(len(wanted), -1).max(axis=1) / scale
    if np.all(off <= allowed):
        return []
    worst = int(np.nanargmax(np.where(np.isfinite(off), off, np.inf)))
    return [
        f"{quantity} of {names[worst]}: got {np.round(got[worst], 9).tolist()}, the scene says "
        f"{np.round(wanted[worst], 9).tolist()} ({np.sum(~(off <= allowed))} differ)"
    ]

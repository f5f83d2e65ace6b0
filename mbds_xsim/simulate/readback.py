"""Hold the native model, as the engine tells it, against the scene, before the first step.

Adapters that hold the spanning tree put its joints into the scene's order by `joint_axes` and
`joint_anchors`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.scene.scene import WORLD
from mbds_xsim.scene.spin import idle_axes
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Readback, Settings

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
_MISSING = 1e-6
_PAIR = ("radius of contact [m]", "friction", "restitution")
_SPRING = ("stiffness [N/m]", "damping [N·s/m]", "rest length [m]", "length at the start [m]")


def compare(
    mechanism: Mechanism, batch: Batch, settings: Settings, readback: Readback
) -> list[str]:
    """List what the engine holds differently from the scene, each in one line.

    Figures are relative to the largest element of the expected array, or to the scene's length
    for positions.
    """
    readback = _with_idle_spin(mechanism, batch, readback)
    length = mechanism.scene.length
    names = [body.name for body in mechanism.scene.bodies]
    expected: list[tuple[str, Array | None, Array, float]] = [
        ("mass [kg]", readback.mass, mechanism.mass, 0.0),
        ("inertia [kg·m²]", readback.inertia, mechanism.inertia, 0.0),
        ("start: centre of mass [m]", readback.com, batch.position[0], length),
        ("start: velocity [m/s]", readback.velocity, batch.velocity[0], 1.0),
        ("start: angular velocity [rad/s]", readback.angular_velocity, _spin(batch), 1.0),
        ("start: orientation", _turn(readback, batch), batch.orientation[0], 1.0),
    ]
    lines = []
    for what, got, wanted, floor in expected:
        if got is not None:
            lines += _differences(what, got, wanted, max(floor, float(np.abs(wanted).max())), names)
    if readback.gravity is not None:
        gravity = np.array([mechanism.scene.gravity])
        lines += _differences("gravity [m/s²]", readback.gravity[None], gravity, 1.0, ["W"])
    off = 0.0 if readback.step is None else abs(readback.step - settings.step)
    if not off <= _TOLERANCE * settings.step:
        lines.append(f"step: got {readback.step:.9g} s, the settings say {settings.step:.9g} s")
    if readback.damping is not None and np.any(readback.damping):
        lines.append(f"damping: got up to {np.abs(readback.damping).max():g}, the scene has none")
    lines += _axis_differences(mechanism, batch, readback)
    lines += _anchor_differences(mechanism, batch, readback.anchor)
    lines += _sphere_differences(mechanism, batch, readback.sphere)
    lines += _spring_differences(mechanism, batch, readback.spring)
    return lines + _contact(mechanism, readback)


def joint_axes(
    mechanism: Mechanism,
    of_link: Callable[[Link], Array],
    of_loop: Callable[[PlacedJoint], Array] | None = None,
) -> Array:
    """Give what `Readback.joint_axis` tells, in W, shape (joint, 3).

    Args:
        mechanism: Of the scene.
        of_link: The axis of a link's joint, as it points in the spanning tree.
        of_loop: The axis of a joint that closes a loop; NaN where there is no such function.
    """
    links = {link.joint.index: link for link in mechanism.links if link.joint}
    jointed = [joint for joint in mechanism.joints if joint.kind in ("hinge", "slider")]
    axes = np.full((len(jointed), 3), np.nan)
    for axis, joint in zip(axes, jointed, strict=True):
        if (link := links.get(joint.index)) is not None:
            axis[:] = of_link(link) if link.body == joint.child else -of_link(link)
        elif of_loop is not None:
            axis[:] = of_loop(joint)
    return axes


def joint_anchors(
    mechanism: Mechanism, of_link: Callable[[Link], tuple[Array, Array] | None]
) -> Array:
    """Give what `Readback.anchor` tells, in W; NaN of loops, shape (joint, 2, 3).

    Args:
        mechanism: Of the scene.
        of_link: The anchor of a link's joint, as fixed in the tree parent and in the body; None
            where the engine does not tell.
    """
    anchors = np.full((len(mechanism.joints), 2, 3), np.nan)
    for link in mechanism.links:
        if link.joint is not None and (ends := of_link(link)) is not None:
            forwards = mechanism.joints[link.joint.index].child == link.body
            anchors[link.joint.index] = ends if forwards else ends[::-1]
    return anchors


def _with_idle_spin(mechanism: Mechanism, batch: Batch, readback: Readback) -> Readback:
    """Add what an engine may leave out: how bodies that never spin would do so.

    Only where the engine has no inertia about such a body's axis.
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


def _spin(batch: Batch) -> Array:
    return batch.angular_velocity[0]


def _turn(readback: Readback, batch: Batch) -> Array:
    """Orientations as read, with the sign of the expected ones (q and −q are one rotation)."""
    sign = np.sign(np.sum(readback.orientation * batch.orientation[0], axis=-1, keepdims=True))
    return readback.orientation * np.where(sign == 0, 1.0, sign)


def _differences(what: str, got: Array, wanted: Array, scale: float, names: list[str]) -> list[str]:
    if got.shape != wanted.shape:
        return [f"{what}: got shape {got.shape}, the scene has {wanted.shape}"]
    off = np.abs(got - wanted).reshape(len(wanted), -1).max(axis=1) / scale
    if np.all(off <= _TOLERANCE):
        return []
    worst = int(np.nanargmax(np.where(np.isfinite(off), off, np.inf)))
    return [
        f"{what} of {names[worst]}: got {np.round(got[worst], 9).tolist()}, the scene says "
        f"{np.round(wanted[worst], 9).tolist()} ({np.sum(~(off <= _TOLERANCE))} differ)"
    ]


def _contact(mechanism: Mechanism, readback: Readback) -> list[str]:
    ground, got = mechanism.scene.ground, readback.contact
    if got is None or ground is None:
        return []
    spheres = mechanism.scene.contacts
    if got.shape != (len(spheres), 3):
        return [f"contact: got shape {got.shape}, the scene has {len(spheres)} spheres"]
    pair = [(sphere.radius, ground.friction, ground.restitution) for sphere in spheres]
    names = [f"sphere {k} on {sphere.body}" for k, sphere in enumerate(spheres)]
    wanted = np.array(pair)
    return _column_differences(_PAIR, np.where(np.isnan(got), wanted, got), wanted, names)


def _spring_differences(mechanism: Mechanism, batch: Batch, got: Array | None) -> list[str]:
    springs = mechanism.springs
    if got is None or not springs:
        return []
    if got.shape != (len(springs), len(_SPRING)):
        return [f"springs: got shape {got.shape}, the scene has {len(springs)}"]
    wanted = np.zeros(got.shape)
    for row, spring in zip(wanted, springs, strict=True):
        ends = [
            _placed(mechanism, batch, *end)
            for end in zip(spring.bodies, spring.in_body, strict=True)
        ]
        apart = float(np.linalg.norm(ends[1] - ends[0]))
        row[:] = spring.stiffness, spring.damping, spring.length, apart
    return _column_differences(_SPRING, got, wanted, [spring.name for spring in springs])


def _column_differences(
    columns: tuple[str, ...], got: Array, wanted: Array, names: list[str]
) -> list[str]:
    """Compare coefficients, each with the largest of its kind, shape (item, column)."""
    lines = []
    for what, held, asked in zip(columns, got.T, wanted.T, strict=True):
        scale = float(asked.max()) or 1.0
        lines += _differences(what, held[:, None], asked[:, None], scale, names)
    return lines


def _anchor_differences(mechanism: Mechanism, batch: Batch, got: Array | None) -> list[str]:
    if got is None or not mechanism.joints:
        return []
    wanted = np.array(
        [
            [
                _placed(mechanism, batch, joint.parent, joint.in_parent),
                _placed(mechanism, batch, joint.child, joint.in_child),
            ]
            for joint in mechanism.joints
        ]
    )
    names = [
        f"{joint.name} in {mechanism.scene.bodies[end].name if end != WORLD_INDEX else WORLD}"
        for joint in mechanism.joints
        for end in (joint.parent, joint.child)
    ]
    return _place_differences("anchor [m]", got, wanted, mechanism, names)


def _sphere_differences(mechanism: Mechanism, batch: Batch, got: Array | None) -> list[str]:
    if got is None or not mechanism.scene.contacts:
        return []
    pairs = list(zip(mechanism.sphere_body.tolist(), mechanism.sphere_offset, strict=True))
    wanted = np.array([_placed(mechanism, batch, body, offset) for body, offset in pairs])
    names = [f"sphere {k} on {sphere.body}" for k, sphere in enumerate(mechanism.scene.contacts)]
    return _place_differences("centre of contact [m]", got, wanted, mechanism, names)


def _placed(mechanism: Mechanism, batch: Batch, body: int, point: Array) -> Array:
    """Place a point of a native frame in W at the first start."""
    if body == WORLD_INDEX:
        return point
    turn = mechanism.native_rotation(batch.orientation[0])[body]
    return np.asarray(batch.position[0, body] + rotation.rotate(turn, point))


def _place_differences(
    what: str, got: Array, wanted: Array, mechanism: Mechanism, names: list[str]
) -> list[str]:
    if got.shape != wanted.shape:
        return [f"{what}: got shape {got.shape}, the scene has {wanted.shape}"]
    told = np.where(np.isnan(got), wanted, got).reshape(-1, 3)
    scale = max(mechanism.scene.length, float(np.abs(wanted).max()))
    return _differences(what, told, wanted.reshape(-1, 3), scale, names)


def _axis_differences(mechanism: Mechanism, batch: Batch, readback: Readback) -> list[str]:
    jointed = [joint for joint in mechanism.joints if joint.kind in ("hinge", "slider")]
    if readback.joint_axis is None or not jointed:
        return []
    if readback.joint_axis.shape != (len(jointed), 3):
        return [f"axes: got shape {readback.joint_axis.shape}, the scene has {len(jointed)} joints"]
    native = mechanism.native_rotation(batch.orientation[0])
    lines = []
    for joint, got in zip(jointed, readback.joint_axis, strict=True):
        turn = rotation.IDENTITY if joint.parent == WORLD_INDEX else native[joint.parent]
        wanted = rotation.rotate(turn, joint.axis)
        if not np.isnan(got).any() and np.abs(got - wanted).max() > _TOLERANCE:
            lines.append(
                f"axis of {joint.name}: got {np.round(got, 9).tolist()}, the scene says "
                f"{np.round(wanted, 9).tolist()}"
            )
    return lines

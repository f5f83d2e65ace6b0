"""Rigid bodies of six coordinates each, held together by constraints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import exudyn
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair

from ._exudyn_model import Held, inertia_text, loads_listing, springs_listing
from ._exudyn_script import graphics_listing

__all__ = ["RigidBodies"]

Array = NDArray[np.float64]

_CALLS = {
    "fixed": "CreateGenericJoint",
    "hinge": "CreateRevoluteJoint",
    "slider": "CreatePrismaticJoint",
    "ball": "CreateSphericalJoint",
}
_AXIS_COLUMN = {"JointRevoluteZ": 2, "JointPrismaticX": 0}
# Exudyn keeps the inertia tensor as xx, yy, zz, yz, xz, xy.
_VOIGT = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])


class RigidBodies:
    """Coordinates: displacement from the reference position and rotation vector of each body.

    Their velocities are the body's velocity in W and its angular velocity in its own frame.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism

    def statements(self) -> Iterator[str]:
        mechanism = self._mechanism
        for k in range(mechanism.body_count):
            yield from _body(mechanism, k)
        for joint in mechanism.joints:
            yield from _joint(joint)
        for link in mechanism.distances:
            yield f"mbs.CreateDistanceConstraint({_ends(link)}, distance={link.length!r})"
        yield from springs_listing(mechanism, _ends)
        yield from loads_listing(mechanism)

    def graphics(self) -> Iterator[str]:
        yield from graphics_listing(self._mechanism)

    def marker(self, body: int, point: Array) -> str:
        return (
            f"mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=bodies[{body}], "
            f"localPosition={point.tolist()!r}))"
        )

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        shift = bodies.position - self._mechanism.com
        spin = rotation.rotate(rotation.conjugate(bodies.native), bodies.angular_velocity)
        return _joined(shift, rotation.to_vector(bodies.native)), _joined(bodies.velocity, spin)

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        shift, vector = _parted(coordinates)
        velocity, spin = _parted(velocities)
        native = rotation.from_vector(vector)
        position = self._mechanism.com + shift
        return BodyStates(position, native, velocity, rotation.rotate(native, spin))

    def held(self, names: Mapping[str, Any]) -> Held:
        bodies = [names["mbs"].GetObject(number) for number in names["bodies"]]
        return Held(
            mass=np.array([body["mass"] for body in bodies]),
            inertia=np.array([body["inertia"] for body in bodies])[:, _VOIGT],
            com=np.array([body["centerOfMass"] for body in bodies]),
            gravity=_gravity(names),
        )

    def anchors(self, names: Mapping[str, Any], com: Array, turn: Array) -> Array:
        del com, turn  # the engine places its markers itself
        mbs, place = names["mbs"], exudyn.OutputVariableType.Position
        joints = [mbs.GetObject(number)["markerNumbers"] for number in names["joints"]]
        ends = [[mbs.GetMarkerOutput(end, place) for end in pair] for pair in joints]
        return np.array(ends).reshape(-1, 2, 3)

    def joint_axes(self, names: Mapping[str, Any], turn: Array) -> Array:
        mbs, axes = names["mbs"], []
        for placed, number in zip(self._mechanism.joints, names["joints"], strict=True):
            joint = mbs.GetObject(number)
            if joint["objectType"] in _AXIS_COLUMN:
                marker = mbs.GetMarker(joint["markerNumbers"][0])
                local = marker["localHT"][:3, :3] @ joint["rotationMarker0"]
                axis = local[:, _AXIS_COLUMN[joint["objectType"]]]
                axes.append(axis if placed.parent == WORLD_INDEX else turn[placed.parent] @ axis)
        return np.array(axes).reshape(-1, 3)


def _body(mechanism: Mechanism, k: int) -> Iterator[str]:
    yield f"# {mechanism.scene.bodies[k].name!r}"
    # A rotation vector is what every solver of Exudyn takes: the explicit ones refuse Euler
    # parameters. It does not run into its singularity at 2π, the Lie-group update wraps it.
    yield (
        f"bodies.append(mbs.CreateRigidBody(referencePosition={mechanism.com[k].tolist()!r}, "
        f"inertia={inertia_text(mechanism.mass[k], mechanism.inertia[k], np.zeros(3))}, "
        f"gravity={list(mechanism.scene.gravity)!r}, "
        "nodeType=exu.NodeType.RotationRotationVector))"
    )
    yield f"frames.append(mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=bodies[{k}])))"


def _joint(joint: PlacedJoint) -> Iterator[str]:
    axis = f", axis={joint.axis.tolist()!r}" if joint.axis.any() else ""
    yield f"# {joint.name!r}"
    yield (
        f"joints.append(mbs.{_CALLS[joint.kind]}("
        f"itemNumbers=[{_item(joint.parent)}, {_item(joint.child)}], "
        f"position={joint.anchor.tolist()!r}{axis}))"
    )


def _ends(pair: PointPair) -> str:
    first, second = (point.tolist() for point in pair.in_body)
    return (
        f"itemNumbers=[{', '.join(map(_item, pair.bodies))}], "
        f"localPosition0={first!r}, localPosition1={second!r}"
    )


def _item(body: int) -> str:
    return "ground" if body == WORLD_INDEX else f"bodies[{body}]"


def _gravity(names: Mapping[str, Any]) -> Array:
    """Sum of the loads per mass on each body: without gravity Exudyn makes none."""
    mbs, bodies = names["mbs"], [int(body) for body in names["bodies"]]
    gravity = np.zeros((len(bodies), 3))
    for k in range(mbs.systemData.NumberOfLoads()):
        load = mbs.GetLoad(k)
        if load["loadType"] == "MassProportional":
            body = int(mbs.GetMarker(load["markerNumber"])["bodyNumber"])
            gravity[bodies.index(body)] += load["loadVector"]
    return gravity


def _joined(first: Array, second: Array) -> Array:
    both = np.concatenate([first, second], axis=-1)
    return both.reshape(*both.shape[:-2], -1)


def _parted(values: Array) -> tuple[Array, Array]:
    parts = values.reshape(*values.shape[:-1], -1, 6)
    return parts[..., :3], parts[..., 3:]

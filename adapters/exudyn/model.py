"""A mechanism in Exudyn's terms: what every way of putting it must tell, and rigid bodies.

Rigid bodies have six coordinates each and are held together by constraints.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

import exudyn
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates, joint_rate
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair
from mbds_xsim.scene.shapes import THIN, shapes

from .brakes import brakes_listing, couplings_listing, drives_listing, rotors_listing

# Exudyn wants names that no other item has, so the scene's names are comments.
HEAD = """\
import exudyn as exu
import exudyn.itemInterface as items
import numpy as np
from exudyn.utilities import RigidBodyInertia, TreeLink

container = exu.SystemContainer()
mbs = container.AddSystem()
ground = mbs.CreateGround()
bodies, joints, frames, centres, springs, laws, brakes = [], [], [], [], [], [], []
drives, couplings, rotors, forces, torques = [], [], [], [], []"""
_CALLS = {
    "fixed": "CreateGenericJoint",
    "hinge": "CreateRevoluteJoint",
    "slider": "CreatePrismaticJoint",
}
_CENTRED = 1e-14  # of the scene's length: what is so near to a centre of mass is there
_AXIS_COLUMN = {"JointRevoluteZ": 2, "JointPrismaticX": 0}
# Exudyn keeps the inertia tensor as xx, yy, zz, yz, xz, xy.
_VOIGT = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass properties as Exudyn holds them, in native frames, body by body."""

    mass: Array
    """[kg], shape (body,)."""
    inertia: Array
    """About the centre of mass [kg·m²], shape (body, 3, 3)."""
    com: Array
    """From the body's marker in `frames` [m], shape (body, 3): nil if all is well."""
    gravity: Array
    """Acting on each body [m/s²], shape (body, 3)."""


class Formulation(ABC):
    """A mechanism in Exudyn's terms.

    `names` are those that the listing leaves behind, among them `mbs` and, body by body, `frames`:
    markers at the centres of mass, parallel to the native frames; `centres` are as good for forces.
    """

    def __init__(self, mechanism: Mechanism, step: float) -> None:
        self.mechanism = mechanism
        self.step = step
        """Of the solver [s]."""

    @final
    def statements(self) -> Iterator[str]:
        """Lines that build the model, after `HEAD`."""
        yield from self.bodies()
        for spring in self.mechanism.springs:
            yield (
                f"springs.append(mbs.CreateSpringDamper({self.ends(spring)}, "
                f"referenceLength={spring.length!r}, stiffness={spring.stiffness!r}, "
                f"damping={spring.damping!r}))"
            )
        yield from loads_listing(self.mechanism)

    @abstractmethod
    def bodies(self) -> Iterator[str]:
        """Lines that make bodies, joints, distance links, `frames` and `centres`."""

    @abstractmethod
    def ends(self, pair: PointPair) -> str:
        """Write the ends of a spring."""

    @abstractmethod
    def graphics(self) -> Iterator[str]:
        """Lines that give bodies something to be seen by, where the engine draws nothing."""

    @abstractmethod
    def marker(self, body: int, point: Array) -> str:
        """Write a marker at a point of a body's native frame, parallel to it."""

    @abstractmethod
    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Coordinates and velocities of body states, each of shape (…, coordinate)."""

    @abstractmethod
    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        """Body states of coordinates and velocities."""

    @abstractmethod
    def mass_properties(self, names: Mapping[str, Any]) -> MassProperties:
        """Read mass properties back."""

    @abstractmethod
    def anchors(self, names: Mapping[str, Any], com: Array, turn: Array) -> Array:
        """Anchors in the parent and in the child, in W as the bodies are, shape (joint, 2, 3)."""

    @abstractmethod
    def laws(self, names: Mapping[str, Any]) -> Array:
        """Read back what `Readback.law` tells."""

    @abstractmethod
    def armature(self, names: Mapping[str, Any]) -> Array:
        """Read back what `Readback.armature` tells."""

    @abstractmethod
    def joint_axes(self, names: Mapping[str, Any], turn: Array) -> Array:
        """Axes of hinges and sliders in W, with the bodies' rotations (body, 3, 3) as they are."""


class RigidBodies(Formulation):
    """Coordinates: displacement from the reference position and rotation vector of each body.

    Their velocities are the body's velocity in W and its angular velocity in its own frame. What
    rotors have turned by since the start follows.
    """

    def bodies(self) -> Iterator[str]:
        mechanism = self.mechanism
        for k in range(mechanism.body_count):
            yield from _body(mechanism, k)
        for joint in mechanism.joints:
            yield f"# {joint.name!r}"
            ball = joint.kind == "ball"
            yield _ball(joint, nil=_CENTRED * mechanism.scene.length) if ball else _joint(joint)
        for link in mechanism.distances:
            yield f"mbs.CreateDistanceConstraint({self.ends(link)}, distance={link.length!r})"
        for joint in mechanism.compliant:
            yield (_turning_law if joint.kind == "hinge" else _sliding_law)(joint)
        yield from brakes_listing(mechanism, self.step)
        yield from drives_listing(mechanism)
        yield from couplings_listing(mechanism)
        yield from rotors_listing(mechanism)

    def ends(self, pair: PointPair) -> str:
        first, second = (point.tolist() for point in pair.in_body)
        return (
            f"itemNumbers=[{', '.join(map(_item, pair.bodies))}], "
            f"localPosition0={first!r}, localPosition1={second!r}"
        )

    def graphics(self) -> Iterator[str]:
        parts: dict[int, list[str]] = {body: [] for body in range(self.mechanism.body_count)}
        for shape in shapes(self.mechanism):
            begin, *ends = shape.points
            parts[shape.body].append(
                f"graphics.Cylinder({begin!r}, {ends[0]!r}, {shape.radius!r})"
                if ends
                else f"graphics.Sphere({begin!r}, {shape.radius!r})"
            )
        yield "import exudyn.graphics as graphics"
        yield ""
        size = 2.0 * THIN * self.mechanism.scene.length
        yield f"container.visualizationSettings.connectors.defaultSize = {size!r}"
        for body, drawn in parts.items():
            made = ", ".join(drawn)
            yield f"mbs.SetObjectParameter(bodies[{body}], 'VgraphicsData', [{made}])"

    def marker(self, body: int, point: Array) -> str:
        return (
            f"mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=bodies[{body}], "
            f"localPosition={point.tolist()!r}))"
        )

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        shift = bodies.position - self.mechanism.com
        spin = rotation.rotate(rotation.conjugate(bodies.native), bodies.angular_velocity)
        world = bodies.with_world()
        rates = [joint_rate(joint, world)[..., None] for joint in self.mechanism.rotors]
        places = _joined(shift, rotation.to_vector(bodies.native))
        return (
            np.concatenate([places, *(np.zeros_like(rate) for rate in rates)], axis=-1),
            np.concatenate([_joined(bodies.velocity, spin), *rates], axis=-1),
        )

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        of_bodies = 6 * self.mechanism.body_count
        shift, vector = _parted(coordinates[..., :of_bodies])
        velocity, spin = _parted(velocities[..., :of_bodies])
        native = rotation.from_vector(vector)
        position = self.mechanism.com + shift
        return BodyStates(position, native, velocity, rotation.rotate(native, spin))

    def mass_properties(self, names: Mapping[str, Any]) -> MassProperties:
        bodies = [names["mbs"].GetObject(number) for number in names["bodies"]]
        return MassProperties(
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

    def laws(self, names: Mapping[str, Any]) -> Array:
        objects = [names["mbs"].GetObject(number) for number in names["laws"]]
        keys = ("stiffness", "damping", "offset")
        told = [[np.ravel(each[key])[0] for key in keys] for each in objects]
        return np.array(told).reshape(-1, len(keys))

    def armature(self, names: Mapping[str, Any]) -> Array:
        return np.array([names["mbs"].GetObject(number)["mass"] for number in names["rotors"]])

    def joint_axes(self, names: Mapping[str, Any], turn: Array) -> Array:
        mbs, axes = names["mbs"], []
        for placed, number in zip(self.mechanism.joints, names["joints"], strict=True):
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
    node = f"mbs.GetObject(bodies[{k}])['nodeNumber']"
    yield f"centres.append(mbs.AddMarker(items.MarkerNodePosition(nodeNumber={node})))"


def _joint(joint: PlacedJoint) -> str:
    axis = f", axis={joint.axis.tolist()!r}" if joint.axis.any() else ""
    return (
        f"joints.append(mbs.{_CALLS[joint.kind]}("
        f"itemNumbers=[{_item(joint.parent)}, {_item(joint.child)}], "
        f"position={joint.anchor.tolist()!r}{axis}))"
    )


def _ball(joint: PlacedJoint, nil: float) -> str:
    """Write a joint of two points; one at a centre of mass takes no rotation matrix to compute."""
    ends = ((joint.parent, joint.in_parent), (joint.child, joint.in_child))
    markers = ", ".join(
        f"centres[{body}]"
        if body != WORLD_INDEX and np.abs(point).max() < nil
        else f"mbs.AddMarker(items.MarkerBodyPosition(bodyNumber={_item(body)}, "
        f"localPosition={point.tolist()!r}))"
        for body, point in ends
    )
    return f"joints.append(mbs.AddObject(items.ObjectJointSpherical(markerNumbers=[{markers}])))"


def _turning_law(joint: PlacedJoint) -> str:
    return (
        f"laws.append(mbs.CreateTorsionalSpringDamper("
        f"itemNumbers=[{_item(joint.parent)}, {_item(joint.child)}], "
        f"position={joint.anchor.tolist()!r}, axis={joint.axis.tolist()!r}, "
        f"stiffness={joint.stiffness!r}, damping={joint.damping!r}, offset={joint.rest!r}))"
    )


def _sliding_law(joint: PlacedJoint) -> str:
    frame = np.column_stack([joint.axis, *rotation.normal_to(joint.axis)]).tolist()
    markers = ", ".join(
        f"mbs.AddMarker(items.MarkerBodyRigid(bodyNumber={_item(body)}, "
        f"localPosition={point.tolist()!r}))"
        for body, point in ((joint.parent, joint.in_parent), (joint.child, joint.in_child))
    )
    return (
        f"laws.append(mbs.AddObject(items.ObjectConnectorRigidBodySpringDamper("
        f"markerNumbers=[{markers}], rotationMarker0={frame}, rotationMarker1={frame}, "
        f"stiffness=np.diag([{joint.stiffness!r}, 0, 0, 0, 0, 0]), "
        f"damping=np.diag([{joint.damping!r}, 0, 0, 0, 0, 0]), "
        f"offset=[{joint.rest!r}, 0, 0, 0, 0, 0])))"
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


def loads_listing(mechanism: Mechanism) -> Iterator[str]:
    """Lines that make `forces`, one a body, and `torques`, pairs (child, parent) of a hinge."""
    for k in range(mechanism.body_count):
        yield f"forces.append(mbs.CreateForce(itemNumber=centres[{k}]))"
    for joint in mechanism.hinges:
        # The axis is fixed in both bodies, so loads in their frames turn with it.
        pair = ", ".join(
            f"mbs.CreateTorque(itemNumber=frames[{end}], bodyFixed=True)"
            if end != WORLD_INDEX
            else "None"
            for end in (joint.child, joint.parent)
        )
        yield f"torques.append(({pair}))"


def inertia_text(mass: float, inertia: Array, com: Array) -> str:
    """Write mass properties; the tensor is about the centre of mass."""
    return (
        f"RigidBodyInertia(mass={float(mass)!r}, inertiaTensor=np.array({inertia.tolist()!r}), "
        f"com=np.array({com.tolist()!r}), inertiaTensorAtCOM=True)"
    )

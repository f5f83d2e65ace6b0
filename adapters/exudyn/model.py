"""Formulations of a mechanism in Exudyn: their common interface, and rigid bodies.

Rigid bodies have six coordinates each and are held together by constraints.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, final

import exudyn
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates, joint_rate
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair
from mbds_xsim.scene.shapes import THIN, shapes

from .brakes import (
    brakes_listing,
    counters_listing,
    couplings_listing,
    drives_listing,
    item,
    joined_items,
    rotors_listing,
)

# Exudyn requires unique names of items, so the scene's names are comments.
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
_OFFSET = 1e-14  # share of the scene's length that counts as 0 off a centre of mass
_AXIS_COLUMN = {"JointRevoluteZ": 2, "JointPrismaticX": 0}
# Exudyn keeps the inertia tensor as xx, yy, zz, yz, xz, xy.
_VOIGT = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])


class Formulation(ABC):
    """A mechanism in Exudyn's terms.

    `names` are the variables of the listing once it has run. Among them are `mbs` and, body by
    body, `frames`: markers at centres of mass, parallel to native frames. `centres` suffice for
    forces.
    """

    def __init__(self, mechanism: Mechanism, step: float) -> None:
        self.mechanism = mechanism
        self.step = step
        """Step of the solver [s]."""
        self.names: dict[str, Any] = {}

    @final
    def objects(self, name: str) -> list[Mapping[str, Any]]:
        """Return what the engine has for the objects in one of the listing's lists."""
        return [self.names["mbs"].GetObject(number) for number in self.names[name]]

    @final
    def statements(self) -> Iterator[str]:
        """Yield the lines that build the model, after `HEAD`."""
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
        """Yield the lines that make bodies, joints, distance links, `frames` and `centres`."""

    @abstractmethod
    def ends(self, pair: PointPair) -> str:
        """Return the arguments that give the ends of a spring."""

    def graphics(self) -> Iterator[str]:
        """Yield the lines that make bodies visible, if the engine itself draws nothing."""
        yield from ()

    @abstractmethod
    def marker(self, body: int, point: Array) -> str:
        """Return the call for a marker at a point of a body's native frame, parallel to it."""

    @abstractmethod
    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Convert body states to coordinates and velocities, each of shape (…, coordinate)."""

    @abstractmethod
    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        """Convert coordinates and velocities to body states."""

    @abstractmethod
    def mass_properties(self) -> tuple[Array, Array, Array, Array]:
        """Read back what belongs to each body's mass, in native frames.

        Returns:
            Mass [kg], shape (body,); inertia about the centre of mass [kg·m²], (body, 3, 3); centre
            of mass relative to the marker in `frames` [m], (body, 3), 0 if right; and gravity
            [m/s²], (body, 3).
        """

    @abstractmethod
    def joint_fields(self, com: Array, turn: Array) -> dict[str, Array]:
        """Return the fields of `Readback` on joints: axes, anchors, laws and armature.

        Args:
            com: Centres of mass in W [m], shape (body, 3).
            turn: Rotations of the bodies, shape (body, 3, 3).
        """


class RigidBodies(Formulation):
    """Rigid bodies; each has a displacement from its reference position and a rotation vector.

    Their velocities are the body's velocity in W and its angular velocity in its own frame. The
    turns of rotors since the start follow as further coordinates.
    """

    def bodies(self) -> Iterator[str]:
        mechanism = self.mechanism
        for k in range(mechanism.body_count):
            yield from _body(mechanism, k)
        for joint in mechanism.joints:
            yield f"# {joint.name!r}"
            ball = joint.kind == "ball"
            yield _ball(joint, nil=_OFFSET * mechanism.scene.length) if ball else _joint(joint)
        for link in mechanism.distances:
            yield f"mbs.CreateDistanceConstraint({self.ends(link)}, distance={link.length!r})"
        yield from counters_listing(mechanism)
        for joint in mechanism.compliant:
            yield (_turning_law if joint.kind == "hinge" else _sliding_law)(joint)
        yield from brakes_listing(mechanism, self.step)
        yield from drives_listing(mechanism)
        yield from couplings_listing(mechanism)
        yield from rotors_listing(mechanism)

    def ends(self, pair: PointPair) -> str:
        first, second = (point.tolist() for point in pair.in_body)
        return (
            f"itemNumbers=[{', '.join(map(item, pair.bodies))}], "
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
        for body, drawings in parts.items():
            text = ", ".join(drawings)
            yield f"mbs.SetObjectParameter(bodies[{body}], 'VgraphicsData', [{text}])"

    def marker(self, body: int, point: Array) -> str:
        return body_marker("Rigid", body, point)

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        shift = bodies.position - self.mechanism.com
        spin = rotation.rotate(rotation.conjugate(bodies.native), bodies.angular_velocity)
        world = bodies.with_world()
        rates = [joint_rate(joint, world)[..., None] for joint in self.mechanism.rotors]
        places = _join(shift, rotation.to_vector(bodies.native))
        return (
            np.concatenate([places, *(np.zeros_like(rate) for rate in rates)], axis=-1),
            np.concatenate([_join(bodies.velocity, spin), *rates], axis=-1),
        )

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        count = 6 * self.mechanism.body_count
        shift, vector = _split(coordinates[..., :count])
        velocity, spin = _split(velocities[..., :count])
        native = rotation.from_vector(vector)
        position = self.mechanism.com + shift
        return BodyStates(position, native, velocity, rotation.rotate(native, spin))

    def mass_properties(self) -> tuple[Array, Array, Array, Array]:
        bodies = self.objects("bodies")
        mass, inertia, com = (
            np.array([body[key] for body in bodies]) for key in ("mass", "inertia", "centerOfMass")
        )
        return mass, inertia[:, _VOIGT], com, _gravity(self.names)

    def joint_fields(self, com: Array, turn: Array) -> dict[str, Array]:
        del com  # the engine computes its markers' places itself
        mbs, place = self.names["mbs"], exudyn.OutputVariableType.Position
        axes, anchors = [], []
        for placed, joint in zip(self.mechanism.joints, self.objects("joints"), strict=True):
            ends = joint["markerNumbers"]
            anchors.append([mbs.GetMarkerOutput(end, place) for end in ends])
            if joint["objectType"] in _AXIS_COLUMN:
                local = mbs.GetMarker(ends[0])["localHT"][:3, :3] @ joint["rotationMarker0"]
                axis = local[:, _AXIS_COLUMN[joint["objectType"]]]
                axes.append(axis if placed.parent == WORLD_INDEX else turn[placed.parent] @ axis)
        keys = ("stiffness", "damping", "offset")
        laws = [[np.ravel(each[key])[0] for key in keys] for each in self.objects("laws")]
        return {
            "joint_axis": np.array(axes).reshape(-1, 3),
            "anchor": np.array(anchors).reshape(-1, 2, 3),
            "law": np.array(laws).reshape(-1, len(keys)),
            "armature": np.array([rotor["mass"] for rotor in self.objects("rotors")]),
        }


def _body(mechanism: Mechanism, k: int) -> Iterator[str]:
    yield f"# {mechanism.scene.bodies[k].name!r}"
    # Every solver of Exudyn takes rotation vectors; the explicit ones refuse Euler parameters. A
    # rotation vector never reaches its singularity at 2π: the Lie-group update wraps it.
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
    return f"joints.append(mbs.{_CALLS[joint.kind]}({_ends(joint)}))"


def _ends(joint: PlacedJoint) -> str:
    """Return the arguments that give the bodies, the anchor and the axis, if any, of a joint."""
    axis = f", axis={joint.axis.tolist()!r}" if joint.axis.any() else ""
    return f"itemNumbers=[{joined_items(joint)}], position={joint.anchor.tolist()!r}{axis}"


def _ball(joint: PlacedJoint, nil: float) -> str:
    """Return the call for a ball joint; points at a centre of mass need no rotation matrix."""
    ends = ((joint.parent, joint.in_parent), (joint.child, joint.in_child))
    markers = ", ".join(
        f"centres[{body}]"
        if body != WORLD_INDEX and np.abs(point).max() < nil
        else body_marker("Position", body, point)
        for body, point in ends
    )
    return f"joints.append(mbs.AddObject(items.ObjectJointSpherical(markerNumbers=[{markers}])))"


def _turning_law(joint: PlacedJoint) -> str:
    return (
        f"laws.append(mbs.CreateTorsionalSpringDamper({_ends(joint)}, "
        f"stiffness={joint.stiffness!r}, damping={joint.damping!r}, offset={joint.rest!r}))\n"
        f"counters.append(({joint.index}, mbs.GetObject(laws[-1])['nodeNumber']))"
    )


def _sliding_law(joint: PlacedJoint) -> str:
    frame = np.column_stack([joint.axis, *rotation.normal_to(joint.axis)]).tolist()
    ends = ((joint.parent, joint.in_parent), (joint.child, joint.in_child))
    markers = ", ".join(body_marker("Rigid", body, point) for body, point in ends)
    return (
        f"laws.append(mbs.AddObject(items.ObjectConnectorRigidBodySpringDamper("
        f"markerNumbers=[{markers}], rotationMarker0={frame}, rotationMarker1={frame}, "
        f"stiffness=np.diag([{joint.stiffness!r}, 0, 0, 0, 0, 0]), "
        f"damping=np.diag([{joint.damping!r}, 0, 0, 0, 0, 0]), "
        f"offset=[{joint.rest!r}, 0, 0, 0, 0, 0])))"
    )


def body_marker(kind: str, body: int, point: Array) -> str:
    """Return the call for a marker at a point of a rigid body's native frame, or of the world."""
    place = f"bodyNumber={item(body)}, localPosition={point.tolist()!r}"
    return f"mbs.AddMarker(items.MarkerBody{kind}({place}))"


def _gravity(names: Mapping[str, Any]) -> Array:
    """Sum up the loads per mass on each body; without gravity Exudyn makes none."""
    mbs, bodies = names["mbs"], [int(body) for body in names["bodies"]]
    gravity = np.zeros((len(bodies), 3))
    for k in range(mbs.systemData.NumberOfLoads()):
        load = mbs.GetLoad(k)
        if load["loadType"] == "MassProportional":
            body = int(mbs.GetMarker(load["markerNumber"])["bodyNumber"])
            gravity[bodies.index(body)] += load["loadVector"]
    return gravity


def _join(first: Array, second: Array) -> Array:
    both = np.concatenate([first, second], axis=-1)
    return both.reshape(*both.shape[:-2], -1)


def _split(values: Array) -> tuple[Array, Array]:
    parts = values.reshape(*values.shape[:-1], -1, 6)
    return parts[..., :3], parts[..., 3:]


def loads_listing(mechanism: Mechanism) -> Iterator[str]:
    """Yield lines that make `forces`, one per body, and `torques`, (child, parent) per hinge."""
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
    """Return the text of mass properties; the tensor is about the centre of mass."""
    return (
        f"RigidBodyInertia(mass={float(mass)!r}, inertiaTensor=np.array({inertia.tolist()!r}), "
        f"com=np.array({com.tolist()!r}), inertiaTensorAtCOM=True)"
    )

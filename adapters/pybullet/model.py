"""Bullet's multibodies and constraints for a mechanism, and access to their states.

A link frame sits at its joint and is parallel to W at the reference pose; the inertial frame sits
at the centre of mass along the principal axes. Bullet's states are about the inertial frames: a
ball joint's quaternion and rate are those of the native frames turned into the principal axes.
Quaternions are xyzw in Bullet.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.simulate.adapter import ModelSize
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from .carriers import carriers
from .client import BARE_LINK, Client, Constant
from .contact import BulletContact, flags_of
from .gears import IMPULSE_CAP, gear_rotors, rotors, speed, tie
from .parts import Multibody, axis_of, hinge_arm, principal_axes, split, to_world

SPEED_CAP = 1e6
"""Largest rate of a multibody, to which Bullet cuts faster ones [m/s or rad/s]."""
RATES = slice(7, 13)
"""Columns of `Multibodies.read` with velocity and angular velocity."""
# Largest force of a stop [N]; by default, bodies of some tonnes fall through.
_STOP_FORCE = 1e30

_JOINT_TYPES = {
    "ball": "JOINT_SPHERICAL",
    "hinge": "JOINT_REVOLUTE",
    "slider": "JOINT_PRISMATIC",
    "fixed": "JOINT_FIXED",
}


class Multibodies:
    """The native model in one connection.

    Args:
        client: The connection.
        mechanism: Mechanism of the scene.
        drag: Bullet's `linearDamping` and `angularDamping` on every link [1/s].
        contact: The contacts; None if the scene has none.
    """

    def __init__(
        self,
        client: Client,
        mechanism: Mechanism,
        drag: Mapping[str, float],
        contact: BulletContact | None,
    ) -> None:
        self.client = client
        self.mechanism = mechanism
        self._contact = contact
        self.parts, cut = split(mechanism)
        self.closures = (*mechanism.loops, *cut)
        self.principal = np.array([principal_axes(tensor)[1] for tensor in mechanism.inertia])
        self._places = {WORLD_INDEX: (-1, -1)}
        self._carriers = defaultdict[int, list[tuple[int, int]]](list)
        self._ids: list[int] = []
        self._links = {link.body: link for part in self.parts for link in part.links}
        for part in self.parts:
            number = self._add_part(part, drag)
            self._ids.append(number)
            if part.base != WORLD_INDEX:
                self._places[part.base] = (number, -1)
            self._places |= {link.body: (number, k) for k, link in enumerate(part.links)}
        # By joint, its constraints: number, then (body, end) on the parent's and the child's side.
        self._ties: dict[int, list[tuple[int, list[tuple[int, int]]]]] = {}
        rows = sum(self._close(joint) for joint in self.closures)
        rows += len(mechanism.couplings) + len(mechanism.rotors)
        bodies = mechanism.carried
        self._gears = []
        for each in mechanism.couplings:
            client.note(each.name)
            ends = [self.address(bodies[joint.index]) for joint in (each.follower, each.leader)]
            self._gears.append(tie(client, ends, each.ratio))
        if contact:
            contact.join(self.addresses)
        self.size = ModelSize(
            sum(part.coordinate_count for part in self.parts), rows, count_pairs(mechanism)
        )
        self._base_pose = client.function("getBasePositionAndOrientation")
        self._base_rate = client.function("getBaseVelocity")
        self._link_states = client.function("getLinkStates")
        self._readings = [
            (number, part.base, range(len(part.links)), [link.body for link in part.links])
            for number, part in zip(self._ids, self.parts, strict=True)
        ]
        self._moving = [
            [k for k, link in enumerate(part.links) if link.joint and link.joint.kind != "fixed"]
            for part in self.parts
        ]

    def address(self, body: int) -> tuple[int, int]:
        """Return Bullet's body number (−1: the world) and link index (−1: the base)."""
        return self._places[body]

    def addresses(self, body: int) -> list[tuple[int, int]]:
        """Return the same for all links that have spheres of a body, its own first."""
        return [self._places[body], *self._carriers[body]]

    def put(self, bodies: BodyStates) -> None:
        """Set the state; arrays of shape (body, 3|4), native rotations."""
        self.client.begin()
        links = to_links(self.mechanism, bodies)
        row = {link.body: k for k, link in enumerate(self.mechanism.links)}
        principal = self.principal
        inertial = rotation.multiply(bodies.native, principal)
        order = [link.body for link in self.mechanism.links]
        back = rotation.conjugate(principal[order])
        turn = rotation.multiply(rotation.multiply(back, links.rotation), principal[order])
        spin = rotation.rotate(back, links.angular_velocity)
        for number, part, moving in zip(self._ids, self.parts, self._moving, strict=True):
            if part.base != WORLD_INDEX:
                k = part.base
                self.client.put(
                    "resetBasePositionAndOrientation",
                    number, bodies.position[k].tolist(), _xyzw(inertial[k]),
                )  # fmt: skip
                self.client.put(
                    "resetBaseVelocity",
                    number, bodies.velocity[k].tolist(), bodies.angular_velocity[k].tolist(),
                )  # fmt: skip
            values: list[list[float]] = []
            rates: list[list[float]] = []
            for link in (part.links[k] for k in moving):
                k = row[link.body]
                ball = link.joint is not None and link.joint.kind == "ball"
                values.append(_xyzw(turn[k]) if ball else [float(links.coordinate[k])])
                rates.append(spin[k].tolist() if ball else [float(links.rate[k])])
            rotors = range(len(part.links), len(part.links) + len(part.geared))
            values += [[0.0]] * len(rotors)
            rates += [[speed(joint) * float(links.rate[row[k]])] for joint, k in part.geared]
            if values:
                self.client.put(
                    "resetJointStatesMultiDof",
                    number, [*moving, *rotors], targetValues=values, targetVelocities=rates,
                )  # fmt: skip

    def read(self) -> Array:
        """Read the state of every body, with the columns of `states`; shape (body, 13)."""
        reading = np.empty((self.mechanism.body_count, 13))
        for number, base, links, bodies in self._readings:
            if base != WORLD_INDEX:
                reading[base] = self._base_state(number)
            if bodies:
                # Field 5, the link frame's rotation, comes back in single precision; 1 does not.
                reading[bodies] = [
                    (*link[0], *link[1], *link[6], *link[7])
                    for link in self._link_states(number, links, 1, 1)
                ]
        return reading

    def states(self, reading: Array) -> BodyStates:
        """Convert what `read` returns to body states.

        Args:
            reading: Position, xyzw of the inertial frame, velocity, spin, shape (…, body, 13).
        """
        native = rotation.multiply(reading[..., [6, 3, 4, 5]], rotation.conjugate(self.principal))
        return BodyStates(reading[..., 0:3], native, reading[..., 7:10], reading[..., 10:13])

    def _base_state(self, number: int) -> list[float]:
        position, turn = self._base_pose(number)
        velocity, rate = self._base_rate(number)
        return [*position, *turn, *velocity, *rate]

    def inertia(self) -> Array:
        """Return inertias in native frames [kg·m²] from Bullet's moments and principal axes."""
        count = self.mechanism.body_count
        still = np.zeros((count, 3))
        native = np.tile(rotation.IDENTITY, (count, 1))
        # Native frames are parallel to W at the reference pose, so there the inertial frames'
        # rotations are the principal axes; getDynamicsInfo has them in single precision only.
        self.put(BodyStates(self.mechanism.com, native, still, still))
        axes = rotation.matrix(self.read()[:, [6, 3, 4, 5]])
        moments = np.array([self._dynamics(body)[2] for body in range(count)])
        return np.asarray(np.einsum("bij,bj,bkj->bik", axes, moments, axes))

    def fields(self, reading: Array) -> dict[str, Array]:
        """Return the fields of `Readback` on masses and joints in the present state.

        Bullet reports neither drag on links nor the motors that brake joints.
        """
        self.client.call("syncBodyInfo")  # reports damping and limits as they have been set since
        dynamics, info = (self.client.function(f"get{what}Info") for what in ("Dynamics", "Joint"))
        joints = {body: info(*self.address(body)) for body in self._links}

        def axis(link: Link) -> Array:
            if link.body not in joints:
                return np.full(3, np.nan)
            # Bullet reports the axis in the child's inertial frame.
            return rotation.rotate(
                reading[link.body, [6, 3, 4, 5]], np.array(joints[link.body][13])
            )

        def ends(link: Link) -> tuple[Array, Array] | None:
            if link.body not in joints:
                return None
            above = np.array(joints[link.body][14])
            # Position of the inertial frame in the link frame, which sits at the joint.
            shift = np.array(self._dynamics(link.body)[3])
            below = -rotation.rotate(self._into_principal(link.body), shift)
            return to_world(reading, link.parent, above), to_world(reading, link.body, below)

        anchors = joint_anchors(self.mechanism, ends)
        constraint = self.client.function("getConstraintInfo")
        for index, ties in self._ties.items():
            points = [
                [to_world(reading, end, np.array(constraint(number)[6 + k])) for end, k in ends_of]
                for number, ends_of in ties
            ]
            anchors[index] = np.mean(points, axis=0)
        armature = {
            joint.index: speed(joint) ** 2 * dynamics(number, rotor)[2][2]
            for number, part in zip(self._ids, self.parts, strict=True)
            for rotor, (joint, _) in enumerate(part.geared, len(part.links))
        }
        bodies, carried = range(self.mechanism.body_count), self.mechanism.carried
        damped = {carried[joint.index] for joint in self.mechanism.compliant}

        def law(link: Link, joint: PlacedJoint) -> tuple[float, float, float]:
            return joint.stiffness, joints[link.body][6], joint.rest  # springs are the adapter's

        return {
            "mass": np.array([self._dynamics(body)[0] for body in bodies]),
            "joint_axis": joint_axes(self.mechanism, axis),
            "anchor": anchors,
            "damping": np.array([info[6] for body, info in joints.items() if body not in damped]),
            "law": joint_laws(self.mechanism, law),
            "limits": np.array([joints[carried[j.index]][8:10] for j in self.mechanism.limited]),
            "armature": np.array([armature[joint.index] for joint in self.mechanism.rotors]),
            "coupling": np.array([(-constraint(gear)[11], np.nan) for gear in self._gears]),
        }

    def _dynamics(self, body: int) -> Any:
        return self.client.function("getDynamicsInfo")(*self.address(body))

    def _add_part(self, part: Multibody, drag: Mapping[str, float]) -> int:
        build = self.client.build
        mechanism, contact = self.mechanism, self._contact
        base_mass, base_at, base_turn = 0.0, np.zeros(3), rotation.IDENTITY
        if part.base != WORLD_INDEX:
            base_mass, base_at = float(mechanism.mass[part.base]), mechanism.com[part.base]
            base_turn = self.principal[part.base]
        joints = [link.joint for link in part.links if link.joint is not None]
        links = list(zip((link.body for link in part.links), joints, strict=True))
        places = [(part.base, np.zeros(3)), *((body, -joint.in_child) for body, joint in links)]
        shapes = [contact.shapes(*place) if contact else [-1] for place in places]
        of_bodies = self._link_rows(part, joints, shapes)
        of_spheres = carriers(of_bodies, shapes, _xyzw(base_turn))
        rows = [*of_bodies, *rotors(of_bodies, joints), *of_spheres]
        number = build(
            "createMultiBody",
            baseMass=base_mass,
            baseCollisionShapeIndex=shapes[0][0],
            basePosition=base_at.tolist(),
            baseInertialFramePosition=[0.0, 0.0, 0.0],
            baseInertialFrameOrientation=_xyzw(base_turn),
            **{key: [row[key] for row in rows] for key in BARE_LINK},
            flags=flags_of(contact),
        )
        cap = SPEED_CAP * max([1.0, *map(speed, joints)])
        build("changeDynamics", number, -1, **drag, maxJointVelocity=cap)
        name = [body.name for body in mechanism.scene.bodies]
        if part.base != WORLD_INDEX:
            self.client.note(f"{name[part.base]!r} is the base of {number}")
            self._set_dynamics(number, -1, part.base, 0.0)
        for k, (body, joint) in enumerate(links):
            self.client.note(f"{name[body]!r} on {joint.name!r} is link {k} of {number}")
            self._set_dynamics(number, k, body, joint.damping)
            self._switch_motor_off(number, k, joint)
            if joint.limits:
                build(
                    "changeDynamics", number, k,
                    jointLowerLimit=joint.limits[0], jointUpperLimit=joint.limits[1],
                    jointLimitForce=_STOP_FORCE,
                )  # fmt: skip
        gear_rotors(self.client, number, joints)
        for k, row in enumerate(of_spheres, len(rows) - len(of_spheres)):
            body = places[row["linkParentIndices"]][0]
            self._carriers[body].append((int(number), k))
            assert contact is not None
            contact.set_pair(number, k, body)
        return int(number)

    def _link_rows(
        self, part: Multibody, joints: list[PlacedJoint], shapes: list[list[int]]
    ) -> list[dict[str, Any]]:
        """Return what `createMultiBody` takes for the link of each body."""
        mechanism, base = self.mechanism, part.base
        number = {link.body: k for k, link in enumerate(part.links, 1)}
        # Link frames sit at the joints; a free base's frame sits at its centre of mass.
        origin = {link.body: joint.anchor for link, joint in zip(part.links, joints, strict=True)}
        origin[base] = mechanism.com[base] if base != WORLD_INDEX else np.zeros(3)
        return [
            {
                **BARE_LINK,
                "linkMasses": float(mechanism.mass[link.body]),
                "linkCollisionShapeIndices": own[0],
                "linkPositions": (joint.anchor - origin[link.parent]).tolist(),
                "linkInertialFramePositions": (-joint.in_child).tolist(),
                "linkInertialFrameOrientations": _xyzw(self.principal[link.body]),
                "linkParentIndices": number.get(link.parent, 0),
                "linkJointTypes": Constant(_JOINT_TYPES[joint.kind]),
                "linkJointAxis": axis_of(joint),
            }
            for link, joint, own in zip(part.links, joints, shapes[1:], strict=True)
        ]

    def _set_dynamics(self, number: int, link: int, body: int, damping: float) -> None:
        moments, _ = principal_axes(self.mechanism.inertia[body])
        self.client.build(
            "changeDynamics", number, link,
            localInertiaDiagonal=moments.tolist(), jointDamping=damping,
        )  # fmt: skip
        if self._contact:
            self._contact.set_pair(number, link, body)

    def _switch_motor_off(self, number: int, link: int, joint: PlacedJoint) -> None:
        if joint.kind == "ball":
            # The call for several degrees of freedom with a zero force leaves the motor in the
            # solver past the 30th ball joint; this one takes it out.
            self.client.build(
                "setJointMotorControl2", number, link, Constant("POSITION_CONTROL"),
                targetPosition=0.0, force=0.0,
            )  # fmt: skip
        elif joint.kind != "fixed":
            self.client.build(
                "setJointMotorControl2", number, link, Constant("VELOCITY_CONTROL"), force=0.0
            )

    def _close(self, joint: PlacedJoint) -> int:
        """Close a loop with constraints; return their number of rows."""
        self.client.note(f"{joint.name!r} closes a loop")
        if joint.kind == "fixed":
            return self._constrain("JOINT_FIXED", joint, np.zeros(3), 6)
        if joint.kind == "ball":
            return self._constrain("JOINT_POINT2POINT", joint, np.zeros(3), 3)
        arm = hinge_arm(self.mechanism, joint)
        ends = (-arm * joint.axis, arm * joint.axis)
        return sum(self._constrain("JOINT_POINT2POINT", joint, shift, 3) for shift in ends)

    def _constrain(self, kind: str, joint: PlacedJoint, shift: Array, rows: int) -> int:
        """Tie the points of both bodies at the anchor plus a shift; return the number of rows."""
        first, pivot = self._carrier(joint.child, joint.in_child + shift)
        second, other = self._carrier(joint.parent, joint.in_parent + shift)
        if first == second:
            return 0  # rigidly joined in the tree already
        ends = [(second, 1), (first, 0)]
        if first == WORLD_INDEX:
            first, pivot, second, other = second, other, first, pivot
            ends = [(first, 0), (second, 1)]
        turn_first, turn_second = self._into_principal(first), self._into_principal(second)
        number = self.client.build(
            "createConstraint", *self.address(first), *self.address(second), Constant(kind),
            [0.0, 0.0, 0.0], rotation.rotate(turn_first, pivot).tolist(),
            rotation.rotate(turn_second, other).tolist(), _xyzw(turn_first), _xyzw(turn_second),
        )  # fmt: skip
        self.client.build("changeConstraint", number, maxForce=IMPULSE_CAP)
        forwards = self.mechanism.joints[joint.index].child == joint.child
        tie = (int(number), ends if forwards else ends[::-1])
        self._ties.setdefault(joint.index, []).append(tie)
        return rows

    def _carrier(self, body: int, point: Array) -> tuple[int, Array]:
        """Return the body that the tree's fixed joints weld a body to, and the point in it.

        Bullet treats a link that is welded to a fixed base's first link as static, and silently
        leaves out the constraints on it (ConvertURDF2BulletInternal stops its search there).
        """
        link = self._links.get(body)
        while link is not None and link.joint is not None and link.joint.kind == "fixed":
            point = point + link.joint.in_parent - link.joint.in_child
            body = link.parent
            link = self._links.get(body)
        return body, point

    def _into_principal(self, body: int) -> Array:
        if body == WORLD_INDEX:
            return rotation.IDENTITY
        return np.asarray(rotation.conjugate(self.principal[body]))


def _xyzw(q: Array) -> list[float]:
    return [float(q[1]), float(q[2]), float(q[3]), float(q[0])]

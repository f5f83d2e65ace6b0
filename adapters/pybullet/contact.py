"""Spheres on the ground plane and on each other in Bullet's terms.

Bullet multiplies the coefficients of two bodies that touch. The ground has 1, so a body with
spheres has those of the pair. Where bodies also collide with each other, they have the square roots
of their common coefficients, and the ground has the factors that are then missing.

Bullet has a friction row along each of two axes, x and y of the world. In every sweep a row adds to
its impulse −v/w, which would stop the slip along its axis alone, with w its diagonal element of
W = J M⁻¹ Jᵀ; both are then cut to the cone together. So a lasting slip ends with impulses
proportional to v/w, whatever the step and the number of sweeps. Where a body yields more along one
axis than along the other, as a wheel does along its heading, friction is off the slip's direction
by up to 45°. Along axes at 45° to the principal ones of W both w are equal: it opposes the slip.

Bullet's anisotropic friction provides axes other than x and y: factors in a body's own frame scale
them. Factors of 1 and −1 on the ground reflect the axes, so the ground, which is the same in all
directions, is turned by half the angle.

resolveConeFrictionConstraintRows and convertMultiBodyContact of btMultiBodyConstraintSolver,
https://github.com/bulletphysics/bullet3
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.simulate.claims import ContactLaw

from .carriers import MOST_SPHERES
from .client import Client, Constant
from .parts import FREEDOMS

CONTACT_LAW = ContactLaw(
    normal="rigid: impulses within one step, by sweeps over contacts (PGS); act before the touch",
    restitution="a coefficient of each body, for approaches above 0.2 m/s",
    friction="a round cone; leans towards the axis, x or y, along which the body is harder to move",
    mixing="the product of frictions, at most 10, and of restitutions",
    adapter="The ground has friction and restitution 1, so that the products are the pair's. "
    "Between bodies, each carries the square root of the pair's coefficient, and the ground is "
    "adjusted to that. With matched settings contacts act from a gap of 1 µm or less, not a step "
    "ahead; overlaps are pushed out over a second, not within steps; every approach faster than "
    "four steps of free fall rebounds; and Bullet's linear and quadratic drag, which native "
    "settings keep, is off. Once a frame the axes of friction are turned so that friction opposes "
    "the slip. "
    "A sphere that has fallen through the ground is a failure.",
)

# btManifoldResult::calculateCombinedFriction cuts the product to this.
_FRICTION_CAP = 10.0
# Bits of Bullet's collision filter, two for each ground: a ground and its spheres collide with each
# other and nothing else. With more bodies than grounds, some bodies share a ground.
_GROUND, _SPHERE, _GROUNDS = 1, 2, 15
# Relative difference of the moments up to which a ball yields alike along all axes.
_EVEN = 1e-9
# Factors of anisotropic friction that reflect the axes of friction at the ground's own x axis.
_REFLECTION = [1.0, -1.0, 1.0]
# Steps of free fall that still count as rest.
_FALLS = 4.0


class BulletContact:
    """The spheres of a mechanism, and the ground, if there is one.

    Args:
        client: The connection.
        mechanism: A mechanism with contact spheres.
        options: The adapter's options by name.
        step: Step [s].
    """

    def __init__(
        self,
        client: Client,
        mechanism: Mechanism,
        options: Mapping[str, Any],
        step: float,
    ) -> None:
        self._client = client
        self._mechanism = mechanism
        self._body = mechanism.sphere_body
        self._offset = mechanism.sphere_offset
        self._radius = mechanism.sphere_radius
        self._arm = np.linalg.norm(self._offset, axis=-1)
        self._gravity = float(np.linalg.norm(mechanism.scene.gravity))
        self._names = [body.name for body in mechanism.scene.bodies]
        scene = mechanism.scene
        self._friction, self._restitution = (
            _split(name, getattr(scene.ground, name, None), getattr(scene.collisions, name, None))
            for name in ("friction", "restitution")
        )
        self.collides = scene.collisions is not None
        """Whether bodies may collide, including those of one multibody."""
        self._reach = float(options["contact_reach"])
        moments = np.linalg.eigvalsh(mechanism.inertia)
        even = mechanism.has_only_balls and np.ptp(moments, axis=-1).max() <= _EVEN * moments.max()
        turns = options["friction_axes"] and scene.ground and scene.ground.friction and not even
        self._yielding = Yielding(mechanism) if turns else None
        self._set_solver(options, step)
        bodies = np.unique(self._body).tolist() if turns else [int(self._body[0])]
        grounds = range(min(len(bodies), _GROUNDS)) if scene.ground else ()
        self._planes = [self._lay_ground(k) for k in grounds]
        self._ground = {
            body: k % len(self._planes) for k, body in enumerate(bodies if grounds else ())
        }
        self._filter = client.function("setCollisionFilterGroupMask")
        self._turn_ground = client.put

    def _set_solver(self, options: Mapping[str, Any], step: float) -> None:
        recovery = float(options["contact_recovery"])
        if recovery < step:
            raise InputError(
                f"option contact_recovery of pybullet: got {recovery:g} s, allowed is the step "
                f"{step:g} s or longer"
            )
        fastest = _FALLS * math.hypot(*self._mechanism.scene.gravity) * step  # at rest
        threshold = float(options["bounce_threshold"]) or fastest
        self._client.build(
            "setPhysicsEngineParameter",
            contactERP=step / recovery,
            restitutionVelocityThreshold=threshold,
            contactSlop=float(options["contact_slop"]),
            enableConeFriction=1,
        )

    def _lay_ground(self, number: int) -> int:
        build = self._client.build
        shape = build("createCollisionShape", Constant("GEOM_PLANE"), planeNormal=[0, 0, 1])
        plane = build("createMultiBody", 0.0, shape)
        # The smaller threshold of two bodies counts in their contact: the ground's is enough.
        build(
            "changeDynamics", plane, -1,
            lateralFriction=self._friction[0], restitution=self._restitution[0],
            contactProcessingThreshold=self._reach,
        )  # fmt: skip
        if self._yielding:
            self._client.note("is turned once a frame, by half the angle of the friction's axes")
            build("changeDynamics", plane, -1, anisotropicFriction=_REFLECTION)
        build("setCollisionFilterGroupMask", plane, -1, *_bits(number, _GROUND, _SPHERE))
        return int(plane)

    def shapes(self, body: int, com: Array) -> list[int]:
        """Make the shapes of a body's spheres; return their numbers, −1 if it has none.

        Args:
            body: Index of the body.
            com: Its centre of mass in its link frame, which is parallel to the native one [m].
        """
        rows = np.flatnonzero(self._body == body)
        groups = [rows[k : k + MOST_SPHERES] for k in range(0, len(rows), MOST_SPHERES)]
        return [self._shape(group, com) for group in groups] or [-1]

    def _shape(self, rows: Index, com: Array) -> int:
        shape = self._client.build(
            "createCollisionShapeArray",
            shapeTypes=[Constant("GEOM_SPHERE")] * len(rows),
            radii=self._radius[rows].tolist(),
            collisionFramePositions=(com + self._offset[rows]).tolist(),
        )
        return int(shape)

    def set_pair(self, number: int, link: int, body: int) -> None:
        """Set the contact coefficients of a body with spheres."""
        if body in self._body:
            reach = {"contactProcessingThreshold": self._reach} if self.collides else {}
            self._client.build(
                "changeDynamics", number, link,
                lateralFriction=self._friction[1], restitution=self._restitution[1], **reach,
            )  # fmt: skip
            bits = _bits(self._ground.get(body, 0), _SPHERE, _GROUND)
            self._client.build("setCollisionFilterGroupMask", number, link, *bits)

    def join(self, addresses: Callable[[int], list[tuple[int, int]]]) -> None:
        """Enable the collisions between bodies that may touch."""
        pairs = self._body[self._mechanism.sphere_pairs]
        for one, other in np.unique(pairs, axis=0).tolist():
            for ends in product(addresses(one), addresses(other)):
                numbers, links = zip(*ends, strict=True)
                self._client.build("setCollisionFilterPair", *numbers, *links, 1)

    def forget(self) -> None:
        """Drop the points where spheres touched in an earlier trajectory.

        Bullet keeps them from step to step; setting a filter, even to its old value, drops them.
        """
        for number, plane in enumerate(self._planes):
            self._filter(plane, -1, *_bits(number, _GROUND, _SPHERE))
        self._turn_ground = self._client.put

    def turn(self, bodies: BodyStates, frame: float) -> None:
        """Turn the axes of friction for a frame [s] if a sphere may touch within it.

        They follow from a body's lowest sphere and from its yaw half a frame later.
        """
        if self._yielding is None:
            return
        gap = self.heights(bodies) - self._radius
        velocity, spin = bodies.velocity[self._body], bodies.angular_velocity[self._body]
        speed = np.linalg.norm(velocity, axis=-1) + np.linalg.norm(spin, axis=-1) * self._arm
        near = np.flatnonzero(gap < frame * (speed + self._gravity * frame))
        if not len(near):
            return
        # The lowest sphere of a ground comes last, and its entry stays.
        lowest = {self._ground[int(self._body[k])]: k for k in near[np.argsort(-gap[near])]}
        spheres = np.array(list(lowest.values()))
        half = 0.5 * self._yielding.alike(bodies, spheres) + 0.25 * frame * spin[spheres, 2]
        for number, at, (sine, cosine) in zip(
            lowest,
            bodies.position[self._body[spheres], :2].tolist(),
            np.stack([np.sin(half / 2), np.cos(half / 2)], axis=-1).tolist(),
            strict=True,
        ):
            self._turn_ground(
                "resetBasePositionAndOrientation",
                self._planes[number], [*at, 0.0], [0.0, 0.0, sine, cosine],
            )  # fmt: skip
        # Only the first turn belongs to the start that a listing records.
        self._turn_ground = self._client.call

    def heights(self, state: BodyStates) -> Array:
        """Return the heights of the spheres' centres [m], shape (…, sphere)."""
        return self._mechanism.sphere_heights(state.position, state.native)

    def trouble(self, state: BodyStates) -> str:
        """Describe the contact that was lost: the ground's with the lowest sphere, or another."""
        height = self.heights(state)
        sphere = int(height.argmin())
        if not self._planes or height[sphere] >= 0.0:
            return "contact is lost: a sphere is in another with its centre"
        return (
            f"contact is lost: sphere {sphere} on {self._names[self._body[sphere]]!r} is "
            f"{self._radius[sphere] - height[sphere]:.3g} m in the ground, deeper than its radius"
        )

    def readback(
        self, addresses: Callable[[int], list[tuple[int, int]]], reading: Array
    ) -> dict[str, Array]:
        """Return the fields of `Readback` on contact, with the coefficients that Bullet combines.

        Args:
            addresses: Function that returns the numbers of a body and its links in Bullet.
            reading: The present state, from `Multibodies.read`.
        """
        dynamics = self._client.function("getDynamicsInfo")
        shapes_of = self._client.function("getCollisionShapeData")
        planes = [dynamics(plane, -1) for plane in self._planes] or [(np.nan,) * 6]
        count = len(self._body)
        pairs, places, own = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
        for body in np.unique(self._body).tolist():
            rows, plane = self._body == body, planes[self._ground.get(body, 0)]
            links = [(dynamics(*link), shapes_of(*link)) for link in addresses(body)]
            own[rows] = [(info[1], info[5]) for info, shapes in links for _ in shapes]
            shapes = [shape for _, shapes in links for shape in shapes]
            pairs[rows, 0] = [shape[3][0] for shape in shapes]
            pairs[rows, 1:] = own[rows] * (plane[1], plane[5])
            # Bullet reports places in the inertial frame.
            local = np.array([shape[5] for shape in shapes])
            places[rows] = reading[body, :3] + rotation.rotate(reading[body, [6, 3, 4, 5]], local)
        one, other = self._mechanism.sphere_pairs.T
        return {"contact": pairs, "collision": own[one] * own[other], "sphere": places}


def flags_of(contact: BulletContact | None) -> int:
    """Return the flags of a multibody."""
    order = Constant("URDF_MAINTAIN_LINK_ORDER")  # else Bullet numbers the links depth first
    if not (contact and contact.collides):
        return order
    # Links may also collide with their parents; the filters decide which spheres may touch.
    parents = Constant("URDF_USE_SELF_COLLISION_INCLUDE_PARENT")
    return order | Constant("URDF_USE_SELF_COLLISION") | parents


def _split(name: str, ground: float | None, collisions: float | None) -> tuple[float, float]:
    """Split a coefficient of pairs into those of the ground and of bodies, which Bullet multiplies.

    Raises:
        Unsupported: No such values exist, or Bullet would cut the product.
    """
    for where, value in (("ground", ground), ("collisions", collisions)):
        if name == "friction" and value is not None and value > _FRICTION_CAP:
            raise Unsupported(
                f"pybullet: {where}.friction: got {value:g}, allowed is up to {_FRICTION_CAP:g}, "
                "to which Bullet silently cuts it"
            )
    if collisions is None:
        return 1.0, ground or 0.0
    if ground and not collisions:
        raise Unsupported(
            f"pybullet: collisions.{name}: got 0, but the ground has {ground:g}, which would be "
            "0 too, since Bullet multiplies those of two bodies"
        )
    root = math.sqrt(collisions)
    return (ground or 0.0) / (root or 1.0), root


def _bits(ground: int, *bits: int) -> list[int]:
    return [bit << 2 * ground for bit in bits]


class Yielding:
    """Yielding of bodies to pushes of the ground, from mass matrices of the spanning tree.

    Joints that close loops are left out.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        sizes = [FREEDOMS[link.joint.kind] if link.joint else 6 for link in mechanism.links]
        ends = np.cumsum(sizes)
        self._count = int(ends[-1])
        self._plan = [
            (link.body, link.parent, link.joint, slice(end - size, end))
            for link, size, end in zip(mechanism.links, sizes, ends.tolist(), strict=True)
        ]
        moments, axes = np.linalg.eigh(mechanism.inertia)
        self._inertia_root = np.sqrt(moments)[..., None] * np.swapaxes(axes, -1, -2)
        self._mass_root = np.sqrt(mechanism.mass)[:, None, None]

    def alike(self, bodies: BodyStates, spheres: Index) -> Array:
        """Find the horizontal axes along which bodies yield alike.

        Args:
            bodies: A state of all bodies, shape (body, …).
            spheres: Indices of the spheres that touch.

        Returns:
            Angle from x to one axis; the other is perpendicular [rad], shape (sphere,).
        """
        xx, xy, yy = self._horizontal(bodies, spheres)
        return np.asarray(0.5 * np.arctan2(2.0 * xy, xx - yy) + np.pi / 4)

    def _horizontal(self, bodies: BodyStates, spheres: Index) -> Array:
        """Return xx, xy and yy of W at the spheres' lowest points [1/kg], shape (3, sphere)."""
        mechanism, turn = self._mechanism, rotation.matrix(bodies.native)
        twist = self._twists(bodies, turn)
        scaled = np.concatenate(
            [
                self._mass_root * twist[:, :3],
                self._inertia_root @ np.swapaxes(turn, -1, -2) @ twist[:, 3:],
            ],
            axis=1,
        ).reshape(-1, self._count)
        body = mechanism.sphere_body[spheres]
        arm = np.einsum("sij,sj->si", turn[body], mechanism.sphere_offset[spheres])
        arm[:, 2] -= mechanism.sphere_radius[spheres]
        slip = twist[body, :2] - (_cross_matrix(arm) @ twist[body, 3:])[:, :2]
        x, y = slip[:, 0], slip[:, 1]
        response = np.linalg.solve(scaled.T @ scaled, np.concatenate([x, y]).T).T
        for_x, for_y = response[: len(x)], response[len(x) :]
        return np.stack([np.vecdot(x, for_x), np.vecdot(x, for_y), np.vecdot(y, for_y)])

    def _twists(self, bodies: BodyStates, turn: Array) -> Array:
        """Return velocity and angular velocity per rate of the tree, shape (body, 6, rate)."""
        twist = np.zeros((len(turn), 6, self._count))
        for body, parent, joint, columns in self._plan:
            if joint is None:
                twist[body, :, columns] = np.eye(6)
                continue
            above = np.eye(3)
            if parent != WORLD_INDEX:
                above, apart = turn[parent], bodies.position[body] - bodies.position[parent]
                twist[body] = twist[parent]
                twist[body, :3] -= _cross_matrix(apart) @ twist[parent, 3:]
            twist[body, :, columns] += _rates(joint, above, -turn[body] @ joint.in_child)
        return twist


def _rates(joint: PlacedJoint, above: Array, arm: Array) -> Array:
    """Return a link's twist per own rate, (6, rate); the arm is from the joint to its centre."""
    if joint.kind == "fixed":
        return np.zeros((6, 0))
    if joint.kind == "ball":
        return np.concatenate([-_cross_matrix(arm), np.eye(3)])
    axis = (above @ joint.axis)[:, None]
    if joint.kind == "slider":
        return np.concatenate([axis, np.zeros((3, 1))])
    return np.concatenate([-_cross_matrix(arm) @ axis, axis])


def _cross_matrix(v: Array) -> Array:
    """Return the matrix of v ×, shape (…, 3, 3)."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = v
    matrix[..., [1, 2, 0], [2, 0, 1]] = -v
    return matrix

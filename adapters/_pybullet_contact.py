"""Spheres on the ground plane in Bullet's terms.

Bullet multiplies the coefficients of two bodies that touch; the ground has 1, so that a body with
spheres has those of the pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.engine import ContactLaw
from mbds_xsim.errors import InputError, Unsupported
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.reference.ball import has_only_balls
from mbds_xsim.scene import Ground

from ._pybullet_client import Client, Constant
from ._pybullet_friction import REFLECTION, Yielding

__all__ = ["CONTACT_LAW", "Contact", "Law"]

Array = NDArray[np.float64]

CONTACT_LAW = ContactLaw(
    normal="rigid: impulses of one step, by sweeps over contacts (PGS); acts ahead of the touch",
    restitution="a coefficient of each body, above 0.2 m/s",
    friction="a round cone, turned towards where a body yields less (along x or y)",
    mixing="the product of frictions, cut to 10, and of restitutions",
    adapter="The ground has friction and restitution 1, so that the products are the pair's. At "
    "matched, contacts act from a gap of 1 µm on and not a step ahead, overlaps are pushed out "
    "over a second and not within steps, and all that is faster than four steps' fall bounces; "
    "Bullet's drag of linear and of quadratic order, on at native, is off; and the axes of "
    "friction are turned, once a frame, to where a body yields alike along both, so that friction "
    "opposes the slip. A sphere that the ground has lost is a failure.",
)
"""What contact is in the engine."""

# btManifoldResult::calculateCombinedFriction cuts the product to this.
_FRICTION_CAP = 10.0
# Bits of Bullet's collision filter, two for each ground: it and its spheres see each other, and
# nothing else. Beyond so many bodies some share a ground.
_GROUND, _SPHERE, _GROUNDS = 1, 2, 15
# Of the moments of a ball, which yields alike along all axes.
_EVEN = 1e-9


@dataclass(frozen=True)
class Law:
    """How the engine resolves contact."""

    recovery: float
    """Time in which an overlap is pushed out [s]; Bullet's ERP is the step over it."""
    threshold: float
    """Approach speed below which nothing bounces [m/s]."""
    reach: float
    """Gap from which on a contact acts on the velocities [m]."""
    slop: float
    """Overlap that counts as none [m]."""
    turns: bool
    """Whether the axes of friction are turned."""


class Contact:
    """The ground, and the spheres of a mechanism on it."""

    def __init__(
        self, client: Client, mechanism: Mechanism, ground: Ground, law: Law, step: float
    ) -> None:
        if ground.friction > _FRICTION_CAP:
            msg = (
                f"pybullet: ground.friction: got {ground.friction:g}, allowed is up to "
                f"{_FRICTION_CAP:g}, to which Bullet cuts it without a word"
            )
            raise Unsupported(msg)
        self._client = client
        self._body = mechanism.sphere_body
        self._offset = mechanism.sphere_offset
        self._radius = mechanism.sphere_radius
        self._arm = np.linalg.norm(self._offset, axis=-1)
        self._gravity = float(np.linalg.norm(mechanism.scene.gravity))
        self._names = [body.name for body in mechanism.scene.bodies]
        self._pair = ground
        moments = np.linalg.eigvalsh(mechanism.inertia)
        even = has_only_balls(mechanism) and np.ptp(moments, axis=-1).max() <= _EVEN * moments.max()
        turns = law.turns and ground.friction > 0.0 and not even
        self._yielding = Yielding(mechanism) if turns else None
        self._set_solver(law, step)
        bodies = np.unique(self._body).tolist() if turns else [int(self._body[0])]
        self._planes = [self._lay_ground(law, k) for k in range(min(len(bodies), _GROUNDS))]
        self._ground = {body: k % len(self._planes) for k, body in enumerate(bodies)}
        self._filter = client.function("setCollisionFilterGroupMask")
        self._turn_ground = client.put

    def _set_solver(self, law: Law, step: float) -> None:
        if law.recovery < step:
            msg = (
                f"option contact_recovery of pybullet: got {law.recovery:g} s, allowed is the step "
                f"{step:g} s or longer"
            )
            raise InputError(msg)
        self._client.build(
            "setPhysicsEngineParameter",
            contactERP=step / law.recovery,
            restitutionVelocityThreshold=law.threshold,
            contactSlop=law.slop,
            enableConeFriction=1,
        )

    def _lay_ground(self, law: Law, number: int) -> int:
        build = self._client.build
        shape = build("createCollisionShape", Constant("GEOM_PLANE"), planeNormal=[0, 0, 1])
        plane = build("createMultiBody", 0.0, shape)
        # The smaller threshold of two bodies holds for their contact: the ground's is enough.
        build(
            "changeDynamics", plane, -1, lateralFriction=1.0, restitution=1.0,
            contactProcessingThreshold=law.reach,
        )  # fmt: skip
        if self._yielding:
            self._client.note("is turned once a frame, by half the angle of the friction's axes")
            build("changeDynamics", plane, -1, anisotropicFriction=list(REFLECTION))
        build("setCollisionFilterGroupMask", plane, -1, *_bits(number, _GROUND, _SPHERE))
        return int(plane)

    def shape(self, body: int, com: Array) -> int:
        """Make the shape of a body's spheres; −1 stands for none.

        Args:
            body: Its index.
            com: Its centre of mass in its link frame, which is parallel to the native one [m].
        """
        rows = np.flatnonzero(self._body == body)
        if not len(rows):
            return -1
        shape = self._client.build(
            "createCollisionShapeArray",
            shapeTypes=[Constant("GEOM_SPHERE")] * len(rows),
            radii=self._radius[rows].tolist(),
            collisionFramePositions=(com + self._offset[rows]).tolist(),
        )
        return int(shape)

    def set_pair(self, number: int, link: int, body: int) -> None:
        """Give a body with spheres the coefficients of the pair."""
        if body in self._body:
            self._client.build(
                "changeDynamics", number, link,
                lateralFriction=self._pair.friction, restitution=self._pair.restitution,
            )  # fmt: skip
            bits = _bits(self._ground.get(body, 0), _SPHERE, _GROUND)
            self._client.build("setCollisionFilterGroupMask", number, link, *bits)

    def forget(self) -> None:
        """Let go of the points where spheres touched in an earlier trajectory.

        Bullet keeps them from step to step; setting a filter, even to what it is, drops them.
        """
        for number, plane in enumerate(self._planes):
            self._filter(plane, -1, *_bits(number, _GROUND, _SPHERE))
        self._turn_ground = self._client.put

    def turn(self, bodies: BodyStates, frame: float) -> None:
        """Turn the axes of friction for a frame [s] where a sphere may touch within it.

        The lowest sphere of a body counts, and the yaw that the body has half a frame on.
        """
        if self._yielding is None:
            return
        gap = self.heights(bodies) - self._radius
        velocity, spin = bodies.velocity[self._body], bodies.angular_velocity[self._body]
        speed = np.linalg.norm(velocity, axis=-1) + np.linalg.norm(spin, axis=-1) * self._arm
        near = np.flatnonzero(gap < frame * (speed + self._gravity * frame))
        if not len(near):
            return
        # The lowest of a ground's come last, and stay.
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
        # A listing starts as a trajectory does.
        self._turn_ground = self._client.call

    def heights(self, state: BodyStates) -> Array:
        """Heights of the spheres' centres [m], shape (…, sphere)."""
        arms = rotation.rotate(state.native[..., self._body, :], self._offset)
        return np.asarray(state.position[..., self._body, 2] + arms[..., 2])

    def trouble(self, state: BodyStates) -> str:
        """Say how the ground has failed to hold the lowest sphere."""
        height = self.heights(state)
        sphere = int(height.argmin())
        return (
            f"contact is lost: sphere {sphere} on {self._names[self._body[sphere]]!r} is "
            f"{self._radius[sphere] - height[sphere]:.3g} m in the ground, deeper than its radius"
        )

    def centers(self, address: Callable[[int], tuple[int, int]], told: Array) -> Array:
        """Centres of the spheres in W at the states that `Model.read` tells [m], (sphere, 3)."""
        shapes = self._client.function("getCollisionShapeData")
        places = np.empty((len(self._body), 3))
        for body in np.unique(self._body).tolist():
            # Bullet tells them in the inertial frame.
            local = np.array([shape[5] for shape in shapes(*address(body))])
            turned = rotation.rotate(told[body, [6, 3, 4, 5]], local)
            places[self._body == body] = told[body, :3] + turned
        return places

    def readback(self, address: Callable[[int], tuple[int, int]]) -> Array:
        """Radius [m], friction and restitution of the pair as Bullet combines them, (sphere, 3)."""
        told = np.empty((len(self._body), 3))
        dynamics = self._client.function("getDynamicsInfo")
        shapes = self._client.function("getCollisionShapeData")
        plane = dynamics(self._planes[0], -1)
        for body in np.unique(self._body).tolist():
            rows = np.flatnonzero(self._body == body)
            info = dynamics(*address(body))
            told[rows, 0] = [shape[3][0] for shape in shapes(*address(body))]
            told[rows, 1:] = info[1] * plane[1], info[5] * plane[5]
        return told


def _bits(ground: int, *bits: int) -> list[int]:
    return [bit << 2 * ground for bit in bits]

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
from mbds_xsim.scene import Ground

from ._pybullet_client import Client, Constant

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
    "Bullet's drag of linear and of quadratic order, on at native, is off. A sphere that the "
    "ground has lost is a failure.",
)
"""What contact is in the engine."""

# btManifoldResult::calculateCombinedFriction cuts the product to this.
_FRICTION_CAP = 10.0
# Bits of Bullet's collision filter: ground and spheres see each other, and nothing else.
_GROUND, _SPHERE = 1, 2


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
        self._names = [body.name for body in mechanism.scene.bodies]
        self._pair = ground
        self._set_solver(law, step)
        self._plane = self._lay_ground(law)
        self._filter = client.function("setCollisionFilterGroupMask")

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

    def _lay_ground(self, law: Law) -> int:
        build = self._client.build
        shape = build("createCollisionShape", Constant("GEOM_PLANE"), planeNormal=[0, 0, 1])
        plane = build("createMultiBody", 0.0, shape)
        # The smaller threshold of two bodies holds for their contact: the ground's is enough.
        build(
            "changeDynamics", plane, -1, lateralFriction=1.0, restitution=1.0,
            contactProcessingThreshold=law.reach,
        )  # fmt: skip
        build("setCollisionFilterGroupMask", plane, -1, _GROUND, _SPHERE)
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
            self._client.build("setCollisionFilterGroupMask", number, link, _SPHERE, _GROUND)

    def forget(self) -> None:
        """Let go of the points where spheres touched in an earlier trajectory.

        Bullet keeps them from step to step; setting a filter, even to what it is, drops them.
        """
        self._filter(self._plane, -1, _GROUND, _SPHERE)

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
        plane = dynamics(self._plane, -1)
        for body in np.unique(self._body).tolist():
            rows = np.flatnonzero(self._body == body)
            info = dynamics(*address(body))
            told[rows, 0] = [shape[3][0] for shape in shapes(*address(body))]
            told[rows, 1:] = info[1] * plane[1], info[5] * plane[5]
        return told

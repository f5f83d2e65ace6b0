"""The DART model of a scene, and conversion between its coordinates and body states."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism


class SkeletonModel:
    """One skeleton for all bodies.

    DART's coordinates, as measured on 6.20: a ball joint's positions are the rotation vector of
    the child in its parent, its velocities the relative angular velocity in the child; a free
    joint's positions are the rotation vector and the position in W, its velocities ω and v in W.
    """

    def __init__(self, mechanism: Mechanism, listing: str) -> None:
        names: dict[str, Any] = {}
        # The listing that users are shown is the program that builds the model.
        exec(compile(listing, "<DART model>", "exec"), names)
        self.mechanism = mechanism
        self.world = names["world"]
        self.skeleton = names["skeleton"]
        self.bodies: list[Any] = [names["bodies"][k] for k in range(mechanism.body_count)]
        self.joints: list[Any] = [names["joints"][k] for k in range(mechanism.body_count)]
        self.shapes: list[Any] = names["shapes"]
        self.floor = names.get("floor")
        # The listing's functions hold its names in a cycle, which would outlive the run.
        names.clear()
        self.turning, self.turning_at = self._columns("ball", 0, 3)
        self.free, self.free_turn_at = self._columns(None, 0, 3)
        self.free_shift_at = self._columns(None, 3, 6)[1]
        hinges, hinge_at = self._columns("hinge", 0, 1)
        sliders, slider_at = self._columns("slider", 0, 1)
        self.scalar = np.concatenate([hinges, sliders])
        self.scalar_at = np.concatenate([hinge_at, slider_at])[:, 0]

    @property
    def coordinate_count(self) -> int:
        """Number of generalised coordinates."""
        return int(self.skeleton.getNumDofs())

    def armature(self) -> Array:
        """Return the rotors' part of the mass matrix, shape (coordinate, coordinate)."""
        diagonal = np.zeros(self.coordinate_count)
        joints = (self.mechanism.links[k].joint for k in self.scalar)
        diagonal[self.scalar_at] = [joint.armature if joint else 0.0 for joint in joints]
        return np.diag(diagonal)

    def set_state(self, q: Array, u: Array) -> None:
        """Set the skeleton's generalised coordinates q and velocities u."""
        self.skeleton.setPositions(q)
        self.skeleton.setVelocities(u)

    def coordinates(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Convert body states to generalised coordinates and velocities (…, coordinate)."""
        links = to_links(self.mechanism, bodies)
        q = np.zeros((*links.coordinate.shape[:-1], self.coordinate_count))
        u = np.zeros_like(q)
        q[..., self.turning_at] = rotation.to_vector(links.rotation[..., self.turning, :])
        u[..., self.turning_at] = links.angular_velocity[..., self.turning, :]
        q[..., self.scalar_at] = links.coordinate[..., self.scalar]
        u[..., self.scalar_at] = links.rate[..., self.scalar]
        turn = links.rotation[..., self.free, :]
        q[..., self.free_turn_at] = rotation.to_vector(turn)
        u[..., self.free_turn_at] = rotation.rotate(turn, links.angular_velocity[..., self.free, :])
        q[..., self.free_shift_at] = links.position[..., self.free, :]
        u[..., self.free_shift_at] = links.velocity[..., self.free, :]
        return q, u

    def body_states(self, q: Array, u: Array) -> BodyStates:
        """Convert generalised coordinates and velocities (…, coordinate) to body states."""
        links = LinkStates.still((*q.shape[:-1], self.mechanism.body_count))
        links.rotation[..., self.turning, :] = rotation.from_vector(q[..., self.turning_at])
        links.angular_velocity[..., self.turning, :] = u[..., self.turning_at]
        links.coordinate[..., self.scalar] = q[..., self.scalar_at]
        links.rate[..., self.scalar] = u[..., self.scalar_at]
        free = rotation.from_vector(q[..., self.free_turn_at])
        links.rotation[..., self.free, :] = free
        spin = rotation.rotate(rotation.conjugate(free), u[..., self.free_turn_at])
        links.angular_velocity[..., self.free, :] = spin
        links.position[..., self.free, :] = q[..., self.free_shift_at]
        links.velocity[..., self.free, :] = u[..., self.free_shift_at]
        return to_bodies(self.mechanism, links)

    def _columns(self, kind: str | None, first: int, last: int) -> tuple[Index, Index]:
        """Return the links with joints of a kind, and their coordinates' skeleton indices."""
        links = self.mechanism.links
        indices = [k for k, x in enumerate(links) if (x.joint.kind if x.joint else None) == kind]
        joints = [self.joints[links[k].body] for k in indices]
        at = [[joint.getIndexInSkeleton(c) for c in range(first, last)] for joint in joints]
        columns = np.array(at, dtype=np.int64).reshape(-1, last - first)
        return np.array(indices, dtype=np.int64), columns

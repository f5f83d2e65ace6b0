"""The DART model of a scene, and conversion between its coordinates and body states."""

from __future__ import annotations

from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.columns import LinkColumns, link_kinds, links_of


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
        kinds, joints = link_kinds(mechanism), [self.joints[k.body] for k in mechanism.links]
        first = np.array([j.getIndexInSkeleton(0) if j.getNumDofs() else 0 for j in joints])
        sizes, spin = (self.coordinate_count,) * 2, {"ball": 0, "free": 0}
        self._columns = LinkColumns(kinds, (first, first), sizes, turn={}, spin=spin, shift=(3, 3))
        self.turning, self._free = links_of(kinds, "ball", "free"), links_of(kinds, "free")
        self.turning_at, self._free_at = (
            first[links, None] + np.arange(3) for links in (self.turning, self._free)
        )
        self.side = np.repeat([1.0, -1.0], [len(self.turning) - len(self._free), len(self._free)])
        """1 for a ball joint among `turning`, whose increments stand on the right; −1 otherwise."""

    @property
    def coordinate_count(self) -> int:
        """Number of generalised coordinates."""
        return int(self.skeleton.getNumDofs())

    def armature(self) -> Array:
        """Return the rotors' part of the mass matrix, shape (coordinate, coordinate)."""
        links = LinkStates.still((self.mechanism.body_count,))
        joints = (link.joint for link in self.mechanism.links)
        links.rate[:] = [joint.armature if joint else 0.0 for joint in joints]
        return np.diag(self._columns.of_links(links)[1])

    def set_state(self, q: Array, u: Array) -> None:
        """Set the skeleton's generalised coordinates q and velocities u."""
        self.skeleton.setPositions(q)
        self.skeleton.setVelocities(u)

    def coordinates(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Convert body states to generalised coordinates and velocities (…, coordinate)."""
        links = to_links(self.mechanism, bodies)
        q, u = self._columns.of_links(links)
        q[..., self.turning_at] = rotation.to_vector(links.rotation[..., self.turning, :])
        turn, spin = links.rotation[..., self._free, :], links.angular_velocity[..., self._free, :]
        u[..., self._free_at] = rotation.rotate(turn, spin)
        return q, u

    def body_states(self, q: Array, u: Array) -> BodyStates:
        """Convert generalised coordinates and velocities (…, coordinate) to body states."""
        links = self._columns.to_links(q, u)
        links.rotation[..., self.turning, :] = rotation.from_vector(q[..., self.turning_at])
        back = rotation.conjugate(links.rotation[..., self._free, :])
        spin = rotation.rotate(back, u[..., self._free_at])
        links.angular_velocity[..., self._free, :] = spin
        return to_bodies(self.mechanism, links)

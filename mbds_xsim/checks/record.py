"""Input of the checks: a batch, the motion recorded for it, and the method that made it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.coordinates import clear_of_stops, coordinate_of
from mbds_xsim.checks.spheres import (
    Neighbours,
    Spheres,
    neighbours_of,
    out_of_reach,
    spheres_of,
)
from mbds_xsim.scene.fixed import fixed_spheres
from mbds_xsim.scene.joint_space import BodyStates, joint_rate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Ground, Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import Method

if TYPE_CHECKING:
    from mbds_xsim.checks.balance_kernel import Masses
    from mbds_xsim.checks.motion_kernel import FlatMotion

EVERY_SECOND = (0, 2)
"""First step and stride that cover every frame once."""

_EARTH = 9.81
_STEADY = 0.02  # share of the largest rate; below it a joint with dry friction may stop in a step
_CREEP = 1e-6  # share of √(g · length) at which soft friction creeps (measured: 5e-8)


@dataclass(frozen=True, eq=False)
class Record:
    """A batch and the motion recorded for it, as the checks read them."""

    scene: Scene
    batch: Batch
    trajectory: Trajectory
    method: Method | None = None
    """Method that made the motion; None if unknown, as for a file from elsewhere."""
    step: float | None = None
    """Integration step [s]; None: the frame interval."""
    contact_time: float | None = None
    """Declared time over which the engine spreads an impact [s]; None if unknown."""
    steps_compared: tuple[int, int] = EVERY_SECOND
    """First step and stride for comparing displacements with velocities."""
    many: bool = False
    """Whether to use compiled kernels where possible, which pays over thousands of trajectories.
    These must have finite numbers only, and nothing may meet the ground or a stop."""

    @functools.cached_property
    def mechanism(self) -> Mechanism:
        """The scene as arrays."""
        return Mechanism.of(self.scene)

    @functools.cached_property
    def finite(self) -> Mask:
        """Frames before the first number that is not finite, shape (trajectory, frame)."""
        if self.trajectory.finite.all():
            return np.ones(self.trajectory.position.shape[:2], dtype=bool)
        each = [np.isfinite(field).all(axis=(2, 3)) for field in vars(self._states).values()]
        return np.logical_and.accumulate(np.logical_and.reduce(each), axis=1)

    @functools.cached_property
    def _states(self) -> BodyStates:
        return BodyStates.of(self.mechanism, self.trajectory).each(np.asfortranarray)

    @functools.cached_property
    def bodies(self) -> BodyStates:
        """States with native rotations, NaN from the first frame that is not finite.

        In memory components vary slowest, then bodies, then frames, so numpy works on long rows.
        """
        if self.finite.all():
            return self._states
        keep = self.finite[:, :, None, None]
        return self._states.each(lambda values: np.where(keep, values, np.nan))

    @functools.cached_property
    def motion(self) -> FlatMotion:
        """Bodies and forces as kernels read them; trajectories repeat to make at least eight."""
        from mbds_xsim.checks.motion_kernel import FlatMotion  # imports a compiler
        from mbds_xsim.reference.lanes import LANES

        fields, count = [*vars(self.bodies).values(), self.force], len(self.batch)
        if count < LANES:
            rows = np.resize(np.arange(count), LANES)
            fields, count = [np.asfortranarray(values[rows]) for values in fields], LANES
        frames, bodies = fields[0].shape[1:3]
        flat = (values.T.reshape(-1) for values in fields)
        return FlatMotion._make([*flat, bodies, frames, count])

    def by_kernel(self, kernel: Callable[..., None], shape: tuple[int, ...], *about: Any) -> Array:
        """Return what a compiled kernel of `motion` writes, with the axes of `shape` backwards.

        Shape (trajectory, …); the kernel's array is flat, of shape (*shape, trajectory).
        """
        written = np.empty((*shape, self.motion.rows))
        kernel(self.motion, *about, written.reshape(-1))
        return np.asarray(written.T)[: len(self.batch)]

    @property
    def masses(self) -> Masses:
        """Masses, inertias and gravity as kernels read them."""
        from mbds_xsim.checks.balance_kernel import Masses  # imports a compiler

        mechanism = self.mechanism
        return Masses(mechanism.mass, mechanism.inertia, np.array(self.scene.gravity))

    @functools.cached_property
    def world(self) -> BodyStates:
        """States of the bodies, with the world as last body."""
        return self.bodies.with_world()

    @functools.cached_property
    def moved(self) -> Array:
        """Displacements of the centres of mass in each step [m], (trajectory, step, body, 3)."""
        return np.diff(self.bodies.position, axis=1)

    @functools.cached_property
    def force(self) -> Array:
        """Held forces [N], shape (trajectory, step, body, 3), in the memory layout of `bodies`."""
        return np.asfortranarray(self.batch.force[:, : self.steps])

    @functools.cached_property
    def torque(self) -> Array:
        """Held torques of hinges, then pushes of drives, shape (trajectory, step, input)."""
        return with_pushes(self.mechanism.drives, self.batch.torque)

    @functools.cached_property
    def spheres(self) -> Spheres:
        """Gaps and speeds of contact spheres, shape (trajectory, frame, sphere)."""
        return spheres_of(self.mechanism, self.bodies)

    @functools.cached_property
    def clear(self) -> Mask:
        """Steps in which a contact sphere cannot reach the ground, (trajectory, step, sphere).

        At both ends it must be higher than it can fall in a whole frame, at its own speed and what
        gravity, held forces and the body's rotation add to it. Spheres that are fixed to the world
        never hit the ground.
        """
        if self.scene.ground is None:
            return np.ones((*self.moved.shape[:2], self.spheres.gap.shape[2]), dtype=bool)
        climb = np.abs(self.spheres.climb)
        clear = out_of_reach(self.spheres.gap, climb, self.pulls, self.frame)
        clear[..., fixed_spheres(self.scene)] = True
        return clear

    @functools.cached_property
    def loads(self) -> Array:
        """Sizes of held forces over the masses of their bodies [m/s²], (trajectory, step, body)."""
        return np.asarray(rotation.norm(self.force) / self.mechanism.mass)

    @functools.cached_property
    def pulls(self) -> Array:
        """Largest acceleration of each sphere by loads, gravity and its body's rotation [m/s²].

        Shape (trajectory, frame, sphere).
        """
        padded = np.pad(self.loads, ((0, 0), (1, 1), (0, 0)))[..., self.mechanism.sphere_body]
        loads = np.maximum(padded[:, 1:], padded[:, :-1])
        spin = self.bodies.angular_velocity[..., self.mechanism.sphere_body, :]
        reach = np.linalg.norm(self.mechanism.sphere_offset, axis=-1)
        driven = np.asarray(self.pull + np.sum(spin**2, axis=-1) * reach)
        return loads + driven

    @functools.cached_property
    def neighbours(self) -> Neighbours:
        """Gaps and speeds of the pairs of spheres that may touch, (trajectory, frame, pair)."""
        return neighbours_of(self.mechanism, self.bodies)

    @functools.cached_property
    def parted(self) -> Mask:
        """Steps in which two contact spheres cannot reach each other, (trajectory, step, pair)."""
        pulls = self.pulls[:, :, self.mechanism.sphere_pairs].sum(axis=3)
        return out_of_reach(self.neighbours.gap, self.neighbours.speed, pulls, self.frame)

    def flying(self, group: tuple[int, ...] | None = None) -> Mask:
        """Find the steps in which nothing can touch a group of bodies, shape (trajectory, step).

        None of its spheres can reach the ground or a sphere outside the group, and none of its
        joints to the world can reach a stop. Without a group, all bodies, pairs and joints count.
        """
        owner, pairs = self.mechanism.sphere_body, self.mechanism.sphere_pairs
        own = np.isin(owner, range(len(self.scene.bodies)) if group is None else group)
        crossing = own[pairs].any(axis=1) & (group is None or ~own[pairs].all(axis=1))
        alone = self.clear[:, :, own].all(axis=2)
        if crossing.any():
            alone = alone & self.parted[:, :, crossing].all(axis=2)
        return alone & clear_of_stops(self, group)

    @functools.cached_property
    def spin(self) -> Array:
        """Angular velocities in the native frames [rad/s], shape (trajectory, frame, body, 3)."""
        back = rotation.conjugate(self.bodies.native)
        return rotation.rotate(back, self.bodies.angular_velocity)

    @functools.cached_property
    def turning(self) -> Array:
        """Angular momenta about centres of mass in the native frames [kg·m²/s], shape as spin."""
        inertia, (x, y, z) = self.mechanism.inertia, np.moveaxis(self.spin, -1, 0)
        momenta = np.empty_like(self.spin)
        for k, row in enumerate(np.moveaxis(inertia, 1, 0)):  # einsum takes four times as long
            np.add(row[:, 0] * x + row[:, 1] * y, row[:, 2] * z, out=momenta[..., k])
        return momenta

    @functools.cached_property
    def steady(self) -> Mask:
        """Steps in which no force of a joint has a jump or kink, (trajectory, step).

        No joint sticks or reverses under dry friction, and no drive enters or leaves saturation.
        """
        world, length = self.world, self.scene.length
        steady = np.ones(world.position[:, 1:, 0, 0].shape, dtype=bool)
        creep = _CREEP * np.sqrt(self.usual_pull * length)
        for joint in self.mechanism.frictional:
            rate = joint_rate(joint, world)
            least = _STEADY * np.nanmax(np.abs(rate), axis=1, keepdims=True, initial=0.0)
            least = np.maximum(least, creep / (length if joint.kind == "hinge" else 1.0))
            begin, end = rate[:, :-1], rate[:, 1:]
            steady &= np.minimum(end * np.sign(begin), np.abs(begin)) > least
        for k, drive in enumerate(self.mechanism.drives, len(self.mechanism.hinges)):
            place, rate = coordinate_of(self, drive.joint), joint_rate(drive.joint, world)
            push = self.torque[..., : self.steps, k]
            ends = (
                drive.demand(push, place[:, s], rate[:, s]) for s in (slice(-1), slice(1, None))
            )
            begin, end = (np.sign(u) * (np.abs(u) > drive.limit) for u in ends)
            steady &= begin == end
        return steady

    def by_step(self, parts: Sequence[Array]) -> Array:
        """Put values of steps at the frames at their ends, 0 at frame 0, (…, frame, part)."""
        return self.by_frame([np.pad(part, ((0, 0), (1, 0))) for part in parts])

    def by_frame(self, parts: Sequence[Array]) -> Array:
        """Put values of frames side by side, apart in memory, shape (trajectory, frame, part)."""
        shape = len(parts), *self.finite.T.shape
        return np.array([part.T for part in parts], dtype=float).reshape(shape).T

    def at_end(self, values: Array) -> Array:
        """Put values of trajectories at their last finite frames, (trajectory, frame, part)."""
        series = np.full((values.shape[-1], *self.finite.T.shape), np.nan).T
        last = np.maximum(self.finite.sum(axis=1) - 1, 0)
        series[np.arange(len(series)), last] = values
        return series

    @property
    def ground(self) -> Ground:
        """Ground of the scene, which must have one."""
        assert self.scene.ground is not None
        return self.scene.ground

    @property
    def pull(self) -> float:
        """Size of gravity [m/s²]."""
        return float(np.linalg.norm(self.scene.gravity))

    @property
    def usual_pull(self) -> float:
        """Size of gravity, or the earth's, which sets scales in scenes without any [m/s²]."""
        return self.pull or _EARTH

    @property
    def fall(self) -> float:
        """Speed that gravity adds in a frame [m/s]."""
        return self.frame * self.pull

    @property
    def lag(self) -> float:
        """Declared lag of velocities [s]: recorded ones belong to frame time + lag."""
        if self.method is None or self.step is None:
            return 0.0
        return self.method.velocity_lag * self.step

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return len(self.trajectory.time) - 1

    @property
    def frame(self) -> float:
        """Interval between frames [s]."""
        return self.scene.clock.frame

    @property
    def order(self) -> int:
        """Order of convergence that the method claims for the scene; 1 where none is known."""
        return 1 if self.method is None else self.method.order_for(self.scene)

    @property
    def energy_budget(self) -> float:
        """Relative budget of conserved quantities, which depends on the method's order."""
        budget = self.scene.budget
        return budget.energy if self.order >= 2 else budget.energy_first_order

"""What particles alone tell of a motion: the figures by which models are judged like engines.

A model gives positions of particles and nothing else, so orientations, velocities and impulses are
not there to be checked. What can be seen is compared with the reference seen in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.shift.rigid import RigidPairs
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.state import Batch

__all__ = ["Seen", "gap", "particle_error", "sunk", "unexplained_energy", "way"]

Array = NDArray[np.float64]

_REACH = 2  # frames to either side that a velocity is made of
_ON = 1e-9  # of the scene's length: a sphere is at a particle
_EARTH = 9.81
_FLOOR = 1e-3  # of Σ m·g·length, as in the check of energy


@dataclass(frozen=True, eq=False)
class Seen:
    """The particles of one motion."""

    graph: Graph
    start: Batch
    """A batch of one, with the inputs that act."""
    position: Array
    """[m], shape (frame, particle, 3)."""

    @property
    def mechanism(self) -> Mechanism:
        """The scene's arrays."""
        return self.graph.mechanism


def particle_error(motion: Seen, truth: Seen) -> Array:
    """Root mean square over particles of their distance [m], (frame,)."""
    apart = motion.position - truth.position
    return np.asarray(np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1)))


def gap(motion: Seen) -> Array:
    """Largest deviation of a distance that no motion changes [m], (frame,); NaN without any."""
    nodes = motion.graph.with_anchors(torch.from_numpy(motion.position))
    return np.asarray(RigidPairs.of(motion.graph).gap(nodes).numpy())


def sunk(motion: Seen) -> Array:
    """Deepest overlap with the ground of contact spheres that are at a particle [m], (frame,)."""
    mechanism, graph = motion.mechanism, motion.graph
    own = mechanism.com[mechanism.sphere_body] + mechanism.sphere_offset
    apart = np.linalg.norm(own[:, None] - graph.reference[: graph.particle_count].numpy(), axis=-1)
    spheres, particles = np.nonzero(apart <= _ON * graph.length)
    if not len(spheres):
        return np.full(len(motion.position), np.nan)
    depth = mechanism.sphere_radius[spheres] - motion.position[:, particles, 2]
    return np.asarray(np.maximum(depth, 0.0).max(axis=1))


def way(motion: Seen) -> Array:
    """Mean way of the particles from the start on [m], (frame,)."""
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=-1).mean(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def unexplained_energy(motion: Seen, truth: Seen) -> Array:
    """Energy that came or went without a reason, over the truth's scale, with its sign; (frame,).

    Kinetic energy of points, potential energy and the inputs' work, against the reference's. With
    contact, where a bounce at another time is no error, the rise above what there was at the
    start. NaN at frames that were given, and all over where particles do not tell it: with springs,
    driven hinges, and bodies without particles.

    A velocity is made of frames to either side, so a value stands where the last of them is.
    """
    mechanism, frames = motion.mechanism, len(motion.position)
    hidden = bool(mechanism.springs) or (mechanism.particles_per_body == 0).any()
    if hidden or motion.start.torque.any():
        return np.full(frames, np.nan)
    kinetic, potential = _energy(truth)
    scale = max(np.nanmax(kinetic) + np.ptp(potential[np.isfinite(potential)]), _floor(motion))
    due = kinetic + potential - _work(truth)
    kinetic, potential = _energy(motion)
    balance = kinetic + potential - _work(motion)
    if motion.graph.scene.contacts:
        due = np.full(frames, np.nanmax(due[:HISTORY]))
        balance = np.maximum(balance, due)
    told = np.full(frames, np.nan)
    told[_REACH:] = ((balance - due) / scale)[:-_REACH]
    told[:HISTORY] = np.nan
    return told


def _energy(seen: Seen) -> tuple[Array, Array]:
    """Kinetic and potential [J], each (frame,)."""
    mass = seen.graph.mass[: seen.graph.particle_count].numpy()
    differences = _kinked if seen.graph.scene.contacts else _smooth
    velocity = np.full(seen.position.shape, np.nan)
    velocity[_REACH:-_REACH] = differences(seen.position) / seen.graph.frame_s
    kinetic = 0.5 * np.sum(velocity**2, axis=-1) @ mass
    return kinetic, -(seen.position @ seen.graph.gravity.numpy()) @ mass


def _smooth(position: Array) -> Array:
    """Change of positions over a frame, of fourth order."""
    near, far = position[3:-1] - position[1:-3], position[4:] - position[:-4]
    return (8.0 * near - far) / 12.0


def _kinked(position: Array) -> Array:
    """The same of second order, which at a bounce overshoots neither side."""
    return 0.5 * (position[3:-1] - position[1:-3])


def _work(seen: Seen) -> Array:
    """Of the forces on centres of mass, held over frames, from frame 0 on [J], (frame,)."""
    mass = seen.graph.mass[: seen.graph.particle_count].numpy()
    body = seen.graph.body[: seen.graph.particle_count].numpy()
    share = np.zeros((seen.graph.body_count, len(mass)))
    share[body, np.arange(len(mass))] = mass
    centre = np.einsum("bp,fpi->fbi", share / share.sum(axis=1, keepdims=True), seen.position)
    steps = np.einsum("fbi,fbi->f", seen.start.force[0, : len(centre) - 1], np.diff(centre, axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _floor(seen: Seen) -> float:
    pull = float(seen.graph.gravity.norm()) or _EARTH
    return _FLOOR * float(seen.graph.mass.sum()) * pull * seen.graph.length

"""Recorded motion as compiled kernels read it: eight trajectories, or eight frames, at once."""

from __future__ import annotations

from typing import NamedTuple

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.compiling import compiled
from mbds_xsim.reference.lanes import spread
from mbds_xsim.reference.traced import eight


class FlatMotion(NamedTuple):
    """Recorded states and held forces: flat arrays of shape (component, body, frame, trajectory).

    Numbers of one body and component are contiguous, so that an index among them stands for a
    frame of a trajectory.
    """

    position: Array
    native: Array
    velocity: Array
    spin: Array
    force: Array
    """One per step, so one fewer than the frames."""
    bodies: int
    frames: int
    rows: int
    """Number of trajectories, at least eight."""


@compiled
def vector(m, a, body, frame, t):
    """Read vectors of a body for eight trajectories from `t` on, or indices from a frame on."""
    return _three(a, m.bodies * m.frames * m.rows, (body * m.frames + frame) * m.rows + t)


@compiled
def facing(m, body, frame, t):
    """Read rotations of a body."""
    far, at = m.bodies * m.frames * m.rows, (body * m.frames + frame) * m.rows + t
    x, y, z = _three(m.native, far, at)
    return x, y, z, eight(m.native, at + 3 * far)


@compiled
def force_on(m, body, step, t):
    """Read forces on a body."""
    steps = m.frames - 1
    return _three(m.force, m.bodies * steps * m.rows, (body * steps + step) * m.rows + t)


@compiled
def _three(a, far, at):
    return eight(a, at), eight(a, at + far), eight(a, at + 2 * far)


@compiled
def conjugate(q):
    """Return the inverse of a rotation."""
    return q[0], -q[1], -q[2], -q[3]


@compiled
def spread3(x, y, z):
    """Put one vector into all lanes."""
    return spread(x), spread(y), spread(z)

"""Impulses with which engines that close loops by impulses begin.

Such an engine makes velocities that keep loops closed where a step begins, not where it ends, so
that what loops force on velocities comes a step late. The drawn start knows nothing of that: in the
first step velocities change by an impulse of the loops' constraints besides.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]


def unexplained_by_loops(
    mechanism: Mechanism,
    start: BodyStates,
    change: tuple[Array, Array],
    load: tuple[Array, Array],
    step: float,
) -> tuple[Array, Array]:
    """Take off changes of velocities what an impulse of the loops' constraints makes of it.

    That is what the tree's joints allow and no motion of the closed mechanism has a part in, by the
    metric of kinetic energy; at most what the loops' own forces make in a step.

    Args:
        mechanism: One with loops or distance links.
        start: Drawn states, shape (trajectory, body, …).
        change: Linear [m/s] and angular [rad/s], shape (trajectory, body, 3).
        load: Forces on bodies and torques of hinges in the first step.
        step: Of integration [s].
    """
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference import accelerations

    joints = tuple(joint for joint in mechanism.joints if joint not in mechanism.loops)
    tree = dataclasses.replace(mechanism, joints=joints, loops=(), distances=())
    open_loops, closed = (_allowed(each, start, change) for each in (tree, mechanism))
    impulse = [a - b for a, b in zip(open_loops, closed, strict=True)]
    pulls = (accelerations(each, start, *load) for each in (tree, mechanism))
    forced = [step * (a - b) for a, b in zip(*pulls, strict=True)]
    most, found = (_size(mechanism, start, *each) for each in (forced, impulse))
    share = np.minimum(1.0, most / np.maximum(found, np.finfo(float).tiny))[:, None, None]
    linear, angular = (a - share * b for a, b in zip(change, impulse, strict=True))
    return linear, angular


def _allowed(
    mechanism: Mechanism, start: BodyStates, change: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Part of velocities that a mechanism's joints allow."""
    from mbds_xsim.reference.dynamics import dynamics_of

    dynamics = dynamics_of(mechanism)
    packed = dynamics.pack(BodyStates(start.position, start.native, *change))
    found = dynamics.unpack(dynamics.project(packed))
    return found.velocity, found.angular_velocity


def _size(mechanism: Mechanism, start: BodyStates, linear: Array, angular: Array) -> Array:
    """Root of twice the kinetic energy, shape (trajectory,)."""
    own = rotation.rotate(rotation.conjugate(start.native), angular)
    turning = np.einsum("tbi,bij,tbj->t", own, mechanism.inertia, own)
    return np.asarray(np.sqrt(np.einsum("b,tbi,tbi->t", mechanism.mass, linear, linear) + turning))

"""From a batch to the bodies of a native model, and from their motion to a trajectory.

Every adapter starts and ends so; between them only its engine counts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Batch, Failure, Trajectory

Array = NDArray[np.float64]

# A body that crosses so many scene lengths in a frame has blown up.
_LENGTHS_PER_FRAME = 1e3


def starts(mechanism: Mechanism, batch: Batch) -> BodyStates:
    """Give the starts of a batch with rotations of native frames, shape (trajectory, body, …)."""
    native = mechanism.native_rotation(batch.orientation)
    return BodyStates(batch.position, native, batch.velocity, batch.angular_velocity)


def recorded(
    mechanism: Mechanism, bodies: BodyStates, failures: tuple[Failure | None, ...]
) -> Trajectory:
    """Make a trajectory of the motion of bodies, shape (trajectory, frame, body, …).

    Frames from a failure on become NaN, in the given arrays as well.
    """
    motion = Trajectory(
        mechanism.scene.clock.frame * np.arange(bodies.position.shape[1], dtype=np.float64),
        bodies.position,
        mechanism.body_orientation(bodies.native),
        bodies.velocity,
        bodies.angular_velocity,
        failures,
    )
    return motion.cut_at_failures()


def first_failures(
    bad: NDArray[np.bool_], reason: Callable[[int, int], str], *, earliest: int = 0
) -> tuple[Failure | None, ...]:
    """Turn each trajectory's first bad frame into a failure.

    Args:
        bad: Shape (trajectory, frame).
        reason: Says what is wrong, by row and frame.
        earliest: Frame of a failure at the least; 1 where the start is recorded as it was given.
    """
    first = bad.argmax(axis=1).tolist()
    return tuple(
        Failure(max(earliest, frame), reason(row, frame)) if bad[row, frame] else None
        for row, frame in enumerate(first)
    )


def blow_up(mechanism: Mechanism) -> str:
    """Say what is wrong with the frames that `too_fast` finds."""
    return f"a body's speed passes {_top_speed(mechanism):.3g} m/s or is not a number"


def too_fast(mechanism: Mechanism, velocity: Array) -> NDArray[np.bool_]:
    """Find the frames of a blow-up; a NaN counts as one.

    Args:
        mechanism: Of the scene.
        velocity: Of the bodies [m/s], shape (…, body, 3).
    """
    return ~(rotation.norm(velocity).max(axis=-1) < _top_speed(mechanism))


def _top_speed(mechanism: Mechanism) -> float:
    scene = mechanism.scene
    return _LENGTHS_PER_FRAME * scene.length / scene.clock.frame

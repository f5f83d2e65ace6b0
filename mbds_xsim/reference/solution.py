"""The reference solution: the neutral scene integrated independently of any engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.errors import InputError
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.reference import cache as entries
from mbds_xsim.reference.dynamics import Dynamics, dynamics_of
from mbds_xsim.reference.marching import Inputs, Marched, march
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory

__all__ = ["checked_tolerance", "solve", "start_states"]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

_TOGETHER = 16  # trajectories; more do not get cheaper
_TIGHTEST, _LOOSEST = 1e-14, 1e-3


def solve(
    scene: Scene,
    batch: Batch,
    *,
    rtol: float = 1e-11,
    cache: bool = True,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate every trajectory of a batch to high accuracy.

    Rigid bodies in maximal coordinates, joints kept by constraints at acceleration level and a
    projection at every frame. There is no contact: a trajectory ends, with a failure that says
    so, in the frame in which a contact sphere reaches the ground.

    Args:
        scene: What to simulate.
        batch: Starts and inputs.
        rtol: Allowed error of a step, relative to the size of each component of the state.
        cache: Whether results are taken from disk, and kept there.
        progress: Called now and then with the number of frames done and of all frames.

    Raises:
        InputError: The tolerance is out of range.
    """
    rtol = checked_tolerance(rtol)
    keys = [entries.key_of("solve", scene, batch, row, rtol) for row in range(len(batch))]
    found = {row: entries.load(key) for row, key in enumerate(keys)} if cache else {}
    ready = {row: entry for row, entry in found.items() if entry is not None}
    missing = [row for row in range(len(batch)) if row not in ready]
    for first in range(0, len(missing), _TOGETHER):
        rows = missing[first : first + _TOGETHER]
        report = _shifted(progress, batch.steps, len(ready), len(batch))
        marched = _integrate(scene, batch[rows], rtol, report)
        for k, row in enumerate(rows):
            ready[row] = {"states": marched.states[k], "failure": _encoded(marched.failures[k])}
            if cache:
                entries.store(keys[row], ready[row])
    return _trajectory(scene, batch, [ready[row] for row in range(len(batch))])


def checked_tolerance(rtol: float) -> float:
    """Give the tolerance back, or raise InputError."""
    if not _TIGHTEST <= rtol <= _LOOSEST:
        msg = f"rtol: got {rtol}, allowed is {_TIGHTEST:.0e} to {_LOOSEST:.0e}"
        raise InputError(msg)
    return rtol


def start_states(dynamics: Dynamics, mechanism: Mechanism, batch: Batch) -> Array:
    """States of a batch's starts, shape (trajectory, body + world, 13)."""
    native = mechanism.native_rotation(batch.orientation)
    return dynamics.pack(BodyStates(batch.position, native, batch.velocity, batch.angular_velocity))


def _integrate(scene: Scene, batch: Batch, rtol: float, progress: Progress | None) -> Marched:
    mechanism = Mechanism.of(scene)
    dynamics = dynamics_of(mechanism)
    start = start_states(dynamics, mechanism, batch)
    inputs = Inputs(batch.force, batch.torque)
    return march(dynamics, start, inputs, scene.clock.frame, rtol=rtol, progress=progress)


def _trajectory(scene: Scene, batch: Batch, ready: list[entries.Arrays]) -> Trajectory:
    mechanism = Mechanism.of(scene)
    bodies = dynamics_of(mechanism).unpack(np.stack([entry["states"] for entry in ready]))
    orientation = mechanism.body_orientation(bodies.native)
    # Frame 0 is the start, bit by bit.
    orientation[:, 0] = batch.orientation
    return Trajectory(
        scene.clock.frame * np.arange(batch.steps + 1, dtype=float),
        bodies.position.copy(),
        orientation,
        bodies.velocity.copy(),
        bodies.angular_velocity.copy(),
        tuple(_decoded(entry["failure"]) for entry in ready),
    )


def _encoded(failure: Failure | None) -> NDArray[np.str_]:
    return np.array([] if failure is None else [str(failure.frame), failure.reason], dtype=np.str_)


def _decoded(text: NDArray[np.str_]) -> Failure | None:
    return Failure(int(text[0]), str(text[1])) if len(text) else None


def _shifted(
    progress: Progress | None, frames: int, done: int, trajectories: int
) -> Progress | None:
    """Count the frames of the trajectories that were there before."""
    if progress is None:
        return None
    report = progress
    return lambda now, _: report(done * frames + now, trajectories * frames)

"""The reference solution: the neutral scene integrated independently of any engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import cache as entries
from mbds_xsim.reference.bouncing import march_balls
from mbds_xsim.reference.dynamics import dynamics_of
from mbds_xsim.reference.first_impact import FirstImpact
from mbds_xsim.reference.marching import Inputs, Marched, march
from mbds_xsim.reference.stiff import is_stiff, march_stiff
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory

Progress = Callable[[int, int], None]

_TOGETHER = 64  # trajectories; more do not get cheaper
_SUNK = 1e-9  # what rounding may do to a start on the ground [m]
TIGHTEST, LOOSEST = 1e-14, 1e-3
_CONFIRMED = 1e-13


def solve(
    scene: Scene,
    batch: Batch,
    *,
    rtol: float = 1e-11,
    cache: bool = True,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate every trajectory of a batch to high accuracy.

    Rigid bodies in coordinates of their spanning tree, loops kept closed by constraints at
    acceleration level and a projection at every frame, by compiled kernels (`compiled`); scenes
    with contact or stiff dampers in maximal coordinates (`marching`). Free bodies with one contact
    sphere around their centre of mass are followed through flight, impacts, sliding and rolling,
    exactly (`bouncing`). Any other contact has no unique solution: there a trajectory ends, with a
    `FirstImpact` in place of a failure, when a contact sphere first reaches the ground; its later
    frames are NaN.

    Args:
        scene: What to simulate.
        batch: Starts and inputs.
        rtol: Allowed error of a step, relative to the size of each component of the state.
        cache: Whether results are taken from disk, and kept there.
        progress: Called now and then with the number of frames done and of all frames.

    Raises:
        InputError: The tolerance is out of range, or a contact sphere starts in the ground.
    """
    return _solved("solve", integrate, scene, batch, checked_tolerance(rtol), cache, progress)


def confirmed(scene: Scene, batch: Batch, cache: bool) -> Trajectory:
    """Solve again by other equations, slowly, for what the reference itself is held against.

    In maximal coordinates, all joints closed by multipliers, without the compiled kernels, at a
    tolerance of 1e-13; an explicit method whatever is stiff.
    """
    return _solved("confirm", _marched, scene, batch, _CONFIRMED, cache, None)


def _solved(
    what: str,
    method: Callable[..., Marched],
    scene: Scene,
    batch: Batch,
    rtol: float,
    cache: bool,
    progress: Progress | None,
) -> Trajectory:
    def compute(rows: list[int], report: Progress | None) -> list[entries.Arrays]:
        start = start_states(Mechanism.of(scene), batch[rows])
        _check_above_ground(Mechanism.of(scene), start)
        marched = method(scene, start, batch[rows], rtol, progress=report)
        return [
            {"states": states, "failure": _encoded(failure)}
            for states, failure in zip(marched.states, marched.failures, strict=True)
        ]

    ready = entries.complete(
        what, scene, batch, rtol, compute, keep=cache, together=_TOGETHER, progress=progress
    )
    return _trajectory(scene, batch, ready)


def _marched(
    scene: Scene, start: Array, batch: Batch, rtol: float, *, progress: Progress | None
) -> Marched:
    dynamics, inputs = dynamics_of(Mechanism.of(scene)), Inputs(batch.force, batch.torque)
    return march(dynamics, start, inputs, scene.clock.frame, rtol=rtol, progress=progress)


def checked_tolerance(rtol: float) -> float:
    """Give the tolerance back, or raise InputError."""
    if not TIGHTEST <= rtol <= LOOSEST:
        msg = f"rtol: got {rtol}, allowed is {TIGHTEST:.0e} to {LOOSEST:.0e}"
        raise InputError(msg)
    return rtol


def _check_above_ground(mechanism: Mechanism, start: Array) -> None:
    height, _ = dynamics_of(mechanism).heights(start)
    if height.size and height.min() < -_SUNK:
        sphere = int(height.min(axis=0).argmin())
        body = mechanism.scene.bodies[mechanism.sphere_body[sphere]].name
        msg = (
            f"contacts[{sphere}] on {body!r} starts {-height.min():.3g} m below the ground z = 0; "
            "start it with its centre at its radius or higher"
        )
        raise InputError(msg)


def start_states(mechanism: Mechanism, batch: Batch) -> Array:
    """States of a batch's starts, shape (trajectory, body + world, 13)."""
    return dynamics_of(mechanism).pack(BodyStates.of(mechanism, batch))


def integrate(
    scene: Scene,
    start: Array,
    batch: Batch,
    rtol: float,
    *,
    companions: int = 1,
    progress: Progress | None = None,
) -> Marched:
    """Integrate states under a batch's inputs with the method that suits the scene."""
    mechanism, inputs = Mechanism.of(scene), Inputs(batch.force, batch.torque)
    if scene.contacts and mechanism.has_only_balls:
        return march_balls(mechanism, start, inputs, progress=progress)
    dynamics, frame = dynamics_of(mechanism), scene.clock.frame
    stiff = is_stiff(dynamics, start, inputs, frame)
    if stiff or scene.contacts:
        method = march_stiff if stiff else march
        found = method(
            dynamics, start, inputs, frame, rtol=rtol, companions=companions, progress=progress
        )
        return found.within_half_turns(mechanism, dynamics)
    from mbds_xsim.reference.compiled import march_compiled  # imports a compiler

    return march_compiled(
        mechanism, start, inputs, rtol=rtol, companions=companions, progress=progress
    )


def _trajectory(scene: Scene, batch: Batch, ready: list[entries.Arrays]) -> Trajectory:
    mechanism = Mechanism.of(scene)
    time = scene.clock.frame * np.arange(batch.steps + 1, dtype=float)
    if not ready:
        return Trajectory.empty(time, 0, mechanism.body_count)
    bodies = dynamics_of(mechanism).unpack(np.stack([entry["states"] for entry in ready]))
    orientation = mechanism.body_orientation(bodies.native)
    # Frame 0 is the start, bit by bit.
    orientation[:, 0] = batch.orientation
    return Trajectory(
        time,
        bodies.position.copy(),
        orientation,
        bodies.velocity.copy(),
        bodies.angular_velocity.copy(),
        tuple(_decoded(entry["failure"]) for entry in ready),
    )


def _encoded(failure: Failure | None) -> NDArray[np.str_]:
    text = [] if failure is None else [str(failure.frame), failure.reason]
    if isinstance(failure, FirstImpact):
        text.append(repr(failure.time))
    return np.array(text, dtype=np.str_)


def _decoded(text: NDArray[np.str_]) -> Failure | None:
    if not len(text):
        return None
    frame, reason, *time = map(str, text)
    return FirstImpact(int(frame), reason, float(time[0])) if time else Failure(int(frame), reason)

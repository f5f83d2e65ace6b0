"""March stiff scenes (strong spring–dampers) with the implicit method Radau IIA of order 5.

An explicit method would take steps as short as the fastest decay, although nothing moves that fast.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.dynamics import Dynamics
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.first_impact import FirstImpact, dips, first_touch, resting
from mbds_xsim.reference.marching import MOST_STEPS, Marched, Problem, branchless, stopped
from mbds_xsim.reference.singular import BIFURCATION
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Failure

if TYPE_CHECKING:
    from scipy.integrate import Radau

# Decay times in a frame above which Radau is faster, measured on a fly-ball governor.
_DECAYS = 2.5
_FIRST_STEP = 0.01  # of a frame


@functools.lru_cache(maxsize=64)
def is_stiff(mechanism: Mechanism) -> bool:
    """Whether some motion decays much faster than in a frame, judged at the scene's own start.

    A trajectory's solution thus never depends on the others that are solved with it.
    """
    dynamics = dynamics_of(mechanism)
    if not dynamics.damped:
        return False
    undrawn = msgspec.structs.replace(mechanism.scene, sampling=())
    batch = draw_batch(undrawn, [0], noise=False)
    start = dynamics.pack(BodyStates.of(mechanism, batch))
    torque = with_pushes(mechanism.drives, batch.torque)[:, 0]
    rate = _Rate(dynamics, np.zeros_like(batch.force[:, 0]), np.zeros_like(torque))
    jacobian = rate.jacobian(0.0, start.reshape(-1))
    if not np.isfinite(jacobian).all():
        return False
    values = np.linalg.eigvals(jacobian)
    return float(-values.real.min()) * mechanism.scene.clock.frame > _DECAYS


def march_stiff(problem: Problem) -> Marched:
    """Integrate states as `marching.march` does, one group of companions after the other."""
    dynamics, frame, frames = problem.dynamics, problem.frame, problem.frames
    batch, companions = len(problem.start), problem.companions
    marched = Marched.from_start(problem)
    failures = marched.failures
    lost = branchless(problem)
    for first in range(0, batch, companions):
        rows = slice(first, first + companions)
        if lost[rows].any():
            failures[rows] = [Failure(1, BIFURCATION)] * companions
            continue
        state, step = dynamics.project(problem.start[rows]), _FIRST_STEP * frame
        if resting(*dynamics.gaps(state)).any():
            failures[rows] = [FirstImpact.at(1, 0.0)] * companions
            continue
        for k in range(frames):
            rate = _Rate(dynamics, problem.force[rows, k], problem.torque[rows, k])
            end, step = _through_frame(rate, state, min(step, frame), frame, k, problem.rtol)
            if isinstance(end, Failure):
                failures[rows] = [end] * companions
                break
            state = dynamics.project(end)
            marched.states[rows, k + 1] = state
    return marched.within_half_turns(dynamics)


def _through_frame(
    rate: _Rate, state: Array, step: float, frame: float, k: int, rtol: float
) -> tuple[Array | Failure, float]:
    """States at the end of frame `k`, or the failure before it, and the next step to try."""
    from scipy.integrate import Radau  # takes long to import

    # Radau's estimate is of order 3 only, so its tolerance is looser (Hairer and Wanner, Solving
    # Ordinary Differential Equations II, 1996, section IV.8: the transformation of radau5).
    loose = 0.1 * rtol ** (2.0 / 3.0)
    y, jacobian = state.reshape(-1), rate.jacobian
    solver = Radau(rate, 0.0, y, frame, rtol=loose, atol=loose, jac=jacobian, first_step=step)
    why = "the implicit method fails"
    for _ in range(MOST_STEPS):
        if solver.status != "running":
            break
        solver.step()
        # `h_abs` is the next step that the error suggests; the frame's end does not cut it short.
        step = float(solver.h_abs)
        impact = _impact(rate, solver) if solver.status != "failed" else None
        if impact is not None:
            return FirstImpact.at(k + 1, k * frame + impact), step
    else:
        why = f"{MOST_STEPS} steps do not reach the end of a frame"
    last = solver.y.reshape(state.shape)
    if solver.status == "finished":
        return last, step
    return stopped(rate.dynamics, last[0], k + 1, k * frame + solver.t, why), step


def _impact(rate: _Rate, solver: Radau) -> float | None:
    """Time in the frame at which a contact sphere touched something in the last step, or None."""
    if not rate.dynamics.mechanism.scene.contacts:
        return None
    path, begin, span = solver.dense_output(), solver.t_old, solver.t - solver.t_old

    def heights(share: float) -> tuple[Array, Array]:
        return rate.dynamics.gaps(path(begin + share * span).reshape(rate.shape))

    places = dips(heights(0.0), heights(1.0), np.full(rate.shape[0], span))
    share = first_touch(lambda at: float(heights(at)[0].min()), places.reshape(-1))
    return None if share is None else float(begin + share * span)


class _Rate:
    """Time derivative of a group of states as one vector, and its Jacobian."""

    def __init__(self, dynamics: Dynamics, force: Array, torque: Array) -> None:
        self.dynamics, self.force, self.torque = dynamics, force, torque
        self.shape = (len(force), dynamics.topology.body_count + 1, 13)

    def __call__(self, time: float, y: Array) -> Array:  # noqa: ARG002
        return self.dynamics.derivative(y.reshape(self.shape), self.force, self.torque).reshape(-1)

    def jacobian(self, time: float, y: Array) -> Array:  # noqa: ARG002
        """Jacobian by forward differences, all columns of a state in one evaluation."""
        size = self.shape[1] * self.shape[2]
        whole = np.zeros((len(y), len(y)))
        for k, state in enumerate(y.reshape(self.shape[0], size)):
            step = np.sqrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(state))
            moved = np.concatenate([state[None], state + np.diag(step)])
            force, torque = (
                np.broadcast_to(load[k], (size + 1, *load.shape[1:]))
                for load in (self.force, self.torque)
            )
            rates = self.dynamics.derivative(moved.reshape(-1, *self.shape[1:]), force, torque)
            rates = rates.reshape(size + 1, size)
            part = slice(k * size, (k + 1) * size)
            whole[part, part] = ((rates[1:] - rates[0]) / step[:, None]).T
        return whole

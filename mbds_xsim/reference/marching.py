"""March a batch through its frames: adaptive steps of order 8, restarted where the inputs change.

Method and error estimate: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I,
1993, section II.10 (`dop853`).

Every state has a clock of its own; states only share the calls that evaluate them. At the end of a
frame a state is projected onto the constraints, which keeps the drift of the acceleration-level
constraints at the tolerance.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Indices, Mask
from mbds_xsim.reference import dop853
from mbds_xsim.reference.dynamics import Dynamics
from mbds_xsim.reference.first_impact import FirstImpact, dips, first_touch, resting
from mbds_xsim.reference.singular import BIFURCATION, has_branch
from mbds_xsim.scene.joint_space import joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Failure

Derivative = Callable[[Array], Array]

_SAFETY = 0.9
_SHRINK, _GROW = 0.2, 6.0


def try_step(derivative: Derivative, y: Array, rate: Array, step: Array) -> tuple[Array, Array]:
    """Make one step.

    Args:
        derivative: Time derivative of states.
        y: States, shape (batch, …).
        rate: Their derivatives, the same shape.
        step: Length of the step [s], shape (batch,).

    Returns:
        The new states, and the derivatives at all stages and at the end, shape (stage, batch, …).
    """
    stages = np.empty((dop853.STAGES + 1, *y.shape))
    flat = stages.reshape(len(stages), -1)
    stages[0] = rate
    h = step.reshape(-1, *[1] * (y.ndim - 1))
    for k in range(1, dop853.STAGES):
        stages[k] = derivative(y + h * (dop853.A[k, :k] @ flat[:k]).reshape(y.shape))
    new = y + h * (dop853.B @ flat[:-1]).reshape(y.shape)
    stages[-1] = derivative(new)
    return new, stages


def error_ratio(stages: Array, step: Array, allowed: Array) -> Array:
    """Estimated error of a step over the allowed one, shape (batch,); above 1 is too much."""
    batch, flat = stages.shape[1], stages[:-1].reshape(len(stages) - 1, -1)
    fifth, third = (
        np.sum(((weights @ flat).reshape(allowed.shape) / allowed).reshape(batch, -1) ** 2, axis=1)
        for weights in (dop853.E5, dop853.E3)
    )
    size = allowed[0].size
    combined = np.sqrt((fifth + 0.01 * third) * size)
    return step * fifth / np.where(combined > 0.0, combined, 1.0)


def next_step(step: Array, ratio: Array) -> Array:
    """Next step, from the error ratio of the last one; a ratio that is not finite shrinks it."""
    with np.errstate(divide="ignore"):
        factor = np.clip(_SAFETY * ratio**-0.125, _SHRINK, _GROW)
    return step * np.where(np.isfinite(ratio), factor, _SHRINK)


FIRST_STEP = 0.1  # of a frame
_NEARLY = 1e-3  # angle short of half a turn that counts as one [rad]
SMALLEST_STEP = 1e-9  # of a frame
MOST_STEPS = 20_000
"""Number of steps tried in one frame before a solution is given up."""
_HALF_TURN = (
    "the sprung, driven or coupled hinge {!r} passes a half turn; with contact, stiff dampers or "
    "singular poses the reference does not count whole turns"
)
_USUAL_STEPS, _SINGULAR_STEPS = 50, 50
# Steps of a frame, and number of further steps that may begin where constraints are nearly
# dependent. Such a step costs as much as tens of others, and a few of them pass a singular pose.


@dataclass(frozen=True, eq=False)
class Problem:
    """An initial value problem of one mechanism, and the accuracy of its solution."""

    dynamics: Dynamics
    start: Array
    """States, shape (batch, body + world, 13)."""
    force: Array
    """Forces held over each frame [N], shape (batch, frame, body, 3)."""
    torque: Array
    """Torques held over each frame [N·m], followed by the pushes of drives, shape
    (batch, frame, hinge + drive)."""
    rtol: float
    """Allowed error of a step, relative to 1 plus the size of each component of the state."""
    companions: int = 1
    """Consecutive states that share their steps, so that their numerical errors cancel in their
    difference."""

    @property
    def mechanism(self) -> Mechanism:
        """Mechanism whose motion is sought."""
        return self.dynamics.mechanism

    @property
    def frame(self) -> float:
        """Length of a frame [s]."""
        return self.mechanism.scene.clock.frame

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.force.shape[1]

    def part(self, rows: slice | Indices) -> Problem:
        """Return the problem of some of the states."""
        loads = self.force[rows], self.torque[rows]
        return Problem(self.dynamics, self.start[rows], *loads, self.rtol, self.companions)


@dataclass(frozen=True, eq=False)
class Marched:
    """Result of a march."""

    states: Array
    """States, shape (batch, frame + 1, body + world, 13); NaN from a failure on."""
    failures: list[Failure | None]

    @staticmethod
    def from_start(problem: Problem) -> Marched:
        """Create a march of which only the start is known so far."""
        batch, *shape = problem.start.shape
        states = np.full((batch, problem.frames + 1, *shape), np.nan)
        states[:, 0] = problem.start
        return Marched(states, [None] * batch)

    def within_half_turns(self, dynamics: Dynamics) -> Marched:
        """End trajectories where the angle of a sprung, driven or coupled hinge jumps by a turn.

        Maximal coordinates lose whole turns, which the compiled kernels count.
        """
        for name, angle in _winding(dynamics, self.states):
            passed = np.abs(np.diff(angle, axis=1)) > np.pi
            for row in np.flatnonzero(passed.any(axis=1)).tolist():
                frame = int(passed[row].argmax()) + 1
                self.failures[row] = Failure(frame, _HALF_TURN.format(name))
                self.states[row, frame:] = np.nan
        return self


def _winding(dynamics: Dynamics, states: Array) -> Iterator[tuple[str, Array]]:
    """Yield names and angles of the hinges whose whole turns matter, angles of shape (…)."""
    bodies = dynamics.unpack(states)
    for joint in dynamics.mechanism.counted:
        if joint.kind == "hinge" and (joint.stiffness or joint.coupled or joint.driven):
            yield joint.name, joint_coordinate(joint, bodies.position, bodies.native)


def march(problem: Problem) -> Marched:
    """Integrate states frame by frame."""
    return _March(problem).run().within_half_turns(problem.dynamics)


def branchless(problem: Problem) -> Mask:
    """Whether states start at a bifurcation without a way to go on, shape (batch,)."""
    if not problem.frames:
        return np.zeros(len(problem.start), dtype=bool)
    loads = zip(problem.start, problem.force[:, 0], problem.torque[:, 0], strict=True)
    return np.array([not has_branch(problem.dynamics, *load) for load in loads], dtype=bool)


def stopped(dynamics: Dynamics, state: Array, frame: int, time: float, why: str) -> Failure:
    """Create the failure of a solution that ended at a time [s] in a frame, with a hint."""
    for name, angle in _winding(dynamics, state):
        if np.pi - abs(float(angle)) < _NEARLY:  # no step leads over the jump of its spring
            return Failure(frame, _HALF_TURN.format(name))
    hint = (
        "the mechanism is in a singular pose there, and its motion could go on in several ways"
        if dynamics.is_singular(state)
        else "something moves too fast or is too stiff there: look at masses, inertias and springs"
    )
    return Failure(frame, f"the solution cannot be continued at {time:.6g} s: {why}; {hint}")


class _March:
    def __init__(self, problem: Problem) -> None:
        self.problem, self.dynamics, self.frame = problem, problem.dynamics, problem.frame
        self.rtol, self.companions, self.frames = problem.rtol, problem.companions, problem.frames
        batch = len(problem.start)
        self.marched = Marched.from_start(problem)
        # The states still under way, and their rows in the batch.
        self.row = np.arange(batch)
        self.y = problem.start
        self.at = np.zeros(batch, dtype=np.intp)
        self.remaining = np.full(batch, self.frame)
        self.step = np.full(batch, FIRST_STEP * self.frame)
        self.tries = np.zeros(batch, dtype=np.intp)
        self.singular = np.zeros(batch, dtype=np.intp)
        self.rate = np.empty_like(self.y)
        self._end(branchless(problem), lambda _: Failure(1, BIFURCATION))
        if not len(self.row):
            return
        self.y = self.dynamics.project(self.y)
        self.rate = self.dynamics.derivative(self.y, *self._forces(slice(None)))
        self._end_at_impact(np.where(resting(*self.dynamics.gaps(self.y)), 0.0, np.nan))

    def run(self) -> Marched:
        while len(self.row):
            self._advance()
            self._finish_frames()
        return self.marched

    def _forces(self, pick: slice | Indices) -> tuple[Array, Array]:
        row, at = self.row[pick], self.at[pick]
        return self.problem.force[row, at], self.problem.torque[row, at]

    def _advance(self) -> None:
        """Try a step with every state; those whose error is too large stay where they are."""
        # Equal steps to the end of the frame, so that the last one is not too short.
        h = self.remaining / np.ceil(self.remaining / self.step)
        forces = self._forces(slice(None))
        new, stages = try_step(lambda y: self.dynamics.derivative(y, *forces), self.y, self.rate, h)
        allowed = self.rtol * (1.0 + np.maximum(np.abs(self.y), np.abs(new)))
        ratio = error_ratio(stages, h, allowed).reshape(-1, self.companions).max(axis=1)
        ratio = np.repeat(ratio, self.companions)
        good = ratio <= 1.0
        impact = self._impacts(new, forces, h, good)
        self.y[good], self.rate[good] = new[good], stages[-1][good]
        self.remaining[good] = np.where(h >= self.remaining, 0.0, self.remaining - h)[good]
        self.step = next_step(h, ratio)
        self._end_at_impact(impact)
        self.tries += 1
        smallest = SMALLEST_STEP * self.frame
        self._end(self.step < smallest, self._stuck(f"a step below {smallest:.1e} s is needed"))
        why = f"{MOST_STEPS} steps do not reach the end of a frame"
        self._end(self.tries > MOST_STEPS, self._stuck(why))
        late = np.flatnonzero(self.tries > _USUAL_STEPS)
        if len(late):
            _, share = self.dynamics.rate(self.y[late], *self._forces(late))
            self.singular[late] += share < self.dynamics.near
        why = f"{_SINGULAR_STEPS} steps begin at nearly dependent constraints: check axes in loops"
        self._end(self.singular > _SINGULAR_STEPS, self._stuck(why))

    def _impacts(self, new: Array, forces: tuple[Array, Array], h: Array, good: Mask) -> Array:
        """Return when contact spheres touch something in good steps [s]; NaN where they do not."""
        times = np.full(len(new), np.nan)
        if not self.dynamics.mechanism.scene.contacts:
            return times
        places = dips(self.dynamics.gaps(self.y), self.dynamics.gaps(new), h)
        for row in np.flatnonzero(good & np.isfinite(places).any(axis=1)).tolist():
            y, rate, step, *load = (each[row : row + 1] for each in (self.y, self.rate, h, *forces))
            lowest = functools.partial(self._lowest, y, rate, step, load)
            share = first_touch(lowest, places[row])
            if share is not None:
                passed = self.frame - self.remaining[row] + share * h[row]
                times[row] = self.at[row] * self.frame + passed
        return times

    def _lowest(self, y: Array, rate: Array, step: Array, load: list[Array], share: float) -> float:
        """Return the smallest gap of one state after a share of its step."""
        new, _ = try_step(
            lambda state: self.dynamics.derivative(state, *load), y, rate, share * step
        )
        return float(self.dynamics.gaps(new)[0].min())

    def _finish_frames(self) -> None:
        """Project and record the states at the end of a frame and give them their new inputs."""
        done = np.flatnonzero(self.remaining <= 0.0)
        if not len(done):
            return
        self.y[done] = self.dynamics.project(self.y[done])
        self.at[done] += 1
        self.remaining[done], self.tries[done], self.singular[done] = self.frame, 0, 0
        self.marched.states[self.row[done], self.at[done]] = self.y[done]
        under_way = self.at < self.frames
        done = done[under_way[done]]
        if len(done):
            self.rate[done] = self.dynamics.derivative(self.y[done], *self._forces(done))
        if not under_way.all():
            self._keep(under_way)

    def _end_at_impact(self, time: Array) -> None:
        """Stop the states that have an impact, and their companions, in the frame they are in."""
        first = np.fmin.reduce(time.reshape(-1, self.companions), axis=1)
        time = np.repeat(first, self.companions)
        self._end(np.isfinite(time), lambda k: FirstImpact.at(int(self.at[k]) + 1, float(time[k])))

    def _end(self, ended: Mask, failure: Callable[[int], Failure]) -> None:
        """Stop some states, and their companions, before the end of the frame they are in."""
        together = np.any(ended.reshape(-1, self.companions), axis=1)
        ended = np.repeat(together, self.companions)
        if ended.any():
            for k in np.flatnonzero(ended).tolist():
                self.marched.failures[self.row[k]] = failure(k)
            self._keep(~ended)

    def _stuck(self, why: str) -> Callable[[int], Failure]:
        def failure(k: int) -> Failure:
            time = (self.at[k] + 1) * self.frame - self.remaining[k]
            return stopped(self.dynamics, self.y[k], int(self.at[k]) + 1, float(time), why)

        return failure

    def _keep(self, kept: Mask) -> None:
        for key in ("row", "y", "at", "remaining", "step", "tries", "singular", "rate"):
            setattr(self, key, getattr(self, key)[kept])

"""March mechanisms with dry friction in joints, from one stop or start of a joint to the next.

Friction of constant size has one motion only, as it never decreases with the rate. Joints that move
have all of it against them. Those that stand still have what keeps them there, as far as it goes:
shares μ of it, within ±1, that make ½ μᵀ H μ − aᵀ μ least, a the accelerations without them and H
what they take of these. Between such events a motion is smooth, and steps are those of `marching`.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.closure_kernel import accelerate_once, project_once
from mbds_xsim.reference.compiled import body_states, chosen, lines, with_signs_of, workspace
from mbds_xsim.reference.lanes import LANES
from mbds_xsim.reference.marching import (
    FIRST_STEP,
    MOST_STEPS,
    SMALLEST_STEP,
    Marched,
    Problem,
    error_ratio,
    next_step,
    try_step,
)
from mbds_xsim.reference.tree import link_number, to_tree
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Failure

_HALVINGS = 50  # of a step, until an event in it is found
_ALL = 1.0 - 1e-9  # share of its friction from which on a joint that stands still gives way
_STILL = 1e-12  # of accelerations without friction: what keeps on standing still
_LOST = 1e-12  # of H's largest eigenvalue: what moves nothing


def march_gripping(problem: Problem) -> Marched:
    """Integrate states frame by frame, one after the other."""
    marched, frames = Marched.from_start(problem), problem.frames
    _, spanned, _ = chosen(problem.mechanism)
    places = to_tree(spanned, problem.dynamics.unpack(problem.start), problem.start)
    for row, place in enumerate(places):
        motion = _Motion(problem.mechanism, place, problem.rtol)
        for k in range(frames):
            if not motion.through_frame(problem.force[row, k], problem.torque[row, k]):
                why = "its steps become too short or too many: see friction, masses and springs"
                marched.failures[row] = Failure(k + 1, f"the solution cannot be continued: {why}")
                break
            marched.states[row, k + 1] = with_signs_of(motion.state(), marched.states[row, k])
            if problem.progress is not None:
                problem.progress(frames * row + k + 1, frames * len(places))
    return marched


class _Motion:
    """One trajectory under way, in coordinates of the tree."""

    def __init__(self, mechanism: Mechanism, y: Array, rtol: float) -> None:
        self._tree, spanned, _ = chosen(mechanism)
        self._work, self._lanes = workspace(self._tree), lines(self._tree.size)
        self._rates = lines(self._tree.size)
        self._frame, self._rtol = mechanism.scene.clock.frame, rtol
        joints = spanned.frictional
        self._law = [spanned.counted.index(joint) for joint in joints]
        self._fast = np.array(
            [self._tree.speed_at[link_number(spanned, joint)] for joint in joints]
        )
        self._most = np.array([joint.friction for joint in joints])
        self._y, self._step = self._closed(y), FIRST_STEP * self._frame
        self._sense = np.sign(self._y[self._fast])
        """Of each joint with friction: −1 or 1 where it moves, 0 where it stands still."""

    def state(self) -> Array:
        """Give the states of the bodies, shape (body + world, 13)."""
        self._lanes[:] = self._y[:, None]
        return body_states(self._tree, self._work, self._lanes)[0]

    def through_frame(self, force: Array, torque: Array) -> bool:
        """Go on to the end of a frame, if that can be reached."""
        loads = self._work.load.reshape(-1, 6, LANES)
        loads[:-1, :3] = force[self._tree.body][..., None]
        self._work.torque[: len(torque)] = torque[:, None]
        left, self._sense = self._frame, self._settled(self._y, self._sense)
        rate = self._derivative(self._y[None])
        for _ in range(MOST_STEPS):
            h = left / np.ceil(left / self._step)
            new, ratio = self._tried(rate, h)
            self._step = float(next_step(np.array([h]), np.array([ratio]))[0])
            if not ratio <= 1.0:
                if self._step < SMALLEST_STEP * self._frame:
                    return False
                continue
            if self._has_turned(new):
                h = self._until_event(rate, h)
                new = self._tried(rate, h)[0]
                self._step = FIRST_STEP * self._frame
                new[self._fast[self._sense * new[self._fast] <= 0.0]] = 0.0
                self._sense = self._settled(new, np.sign(new[self._fast]))
            self._y, left = new, left - h
            if left <= 1e-14 * self._frame:
                self._y = self._closed(self._y)
                return True
            rate = self._derivative(self._y[None])
        return False

    def _tried(self, rate: Array, h: float) -> tuple[Array, float]:
        """Make a step; also give its error over what is allowed."""
        step = np.array([h])
        new, stages = try_step(self._derivative, self._y[None], rate, step)
        allowed = self._rtol * (1.0 + np.maximum(np.abs(self._y), np.abs(new)))
        return new[0], float(error_ratio(stages, step, allowed)[0])

    def _until_event(self, rate: Array, h: float) -> float:
        """Find the shortest part of a step in which something stops or gives way [s]."""
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            turned = self._has_turned(self._tried(rate, middle * h)[0])
            low, high = (low, middle) if turned else (middle, high)
        return high * h

    def _has_turned(self, y: Array) -> bool:
        """Whether a joint that moved has come back to rest, or one that stood gives way."""
        if (self._sense * y[self._fast] < 0.0).any():
            return True
        return bool(self._settled(y, self._sense)[self._sense == 0].any())

    def _settled(self, y: Array, sense: Array) -> Array:
        """Decide which of the joints that stand still go on to do so, and where others go."""
        still = np.flatnonzero(sense == 0)
        if not len(still):
            return sense
        free, taken = self._responses(y, sense)
        values, vectors = np.linalg.eigh((taken + taken.T) / 2)
        kept = values > _LOST * values.max()
        roots, basis = np.sqrt(values[kept]), vectors[:, kept]
        from scipy.optimize import lsq_linear  # takes long to import

        share = lsq_linear(
            roots[:, None] * basis.T, basis.T @ free / roots, (-1.0, 1.0), method="bvls"
        ).x
        gives = np.abs(free - taken @ share) > _STILL * np.abs(free).max(initial=0.0)
        moved = sense.copy()
        moved[still] = np.where((np.abs(share) > _ALL) & gives, np.sign(share), 0.0)
        return moved

    def _responses(self, y: Array, sense: Array) -> tuple[Array, Array]:
        """Accelerations of joints that stand still, without and by the friction of each."""
        still = sense == 0
        found = self._evaluated(y, self._grips(sense))[:, self._fast[still]]
        return found[0], (found[0] - found[1:]).T

    def _derivative(self, y: Array) -> Array:
        """Time derivative of a state, shape (1, number); joints that stand still stay so."""
        still = self._sense == 0
        found = self._evaluated(y[0], self._grips(self._sense))
        if not still.any():
            return found[:1]
        taken = (found[0] - found[1:]).T
        share = np.linalg.lstsq(taken[self._fast[still]], found[0, self._fast[still]])[0]
        rate = found[0] - taken @ share
        rate[self._fast[still]] = 0.0
        return rate[None]

    def _grips(self, sense: Array) -> Array:
        """Friction of joints that move, then also of each that stands still, (column, joint)."""
        base = self._most * sense
        return np.concatenate([base[None], base + np.diag(self._most)[sense == 0]])

    def _evaluated(self, y: Array, grips: Array) -> Array:
        """Derivatives of a state under several frictions, shape (column, number)."""
        self._lanes[:] = y[:, None]
        found = np.empty((len(grips), len(y)))
        for first in range(0, len(grips), LANES):
            part = grips[first : first + LANES]
            self._work.grip[self._law, : len(part)] = part.T
            accelerate_once(self._tree, self._work, self._lanes, self._rates)
            found[first : first + len(part)] = self._rates.T[: len(part), : len(y)]
        return found

    def _closed(self, y: Array) -> Array:
        """Put a state onto the closures; what stood still does so again."""
        still = self._fast[y[self._fast] == 0.0]
        self._lanes[:] = y[:, None]
        project_once(self._tree, self._work, self._lanes)
        closed = self._lanes[:, 0].copy()
        closed[still] = 0.0
        return closed

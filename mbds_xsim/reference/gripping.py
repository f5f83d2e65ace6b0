"""March mechanisms with dry friction or stops in joints, from one event to the next.

Friction of constant size has one motion only, as it never decreases with the rate. Joints that move
have all of it against them. Those that stand still have what keeps them there, as far as it goes,
and so have those that rest against a stop (`brakes`). Events are that a joint stops or gives way,
and that it reaches a stop. Between them a motion is smooth, and steps are those of `marching`. A
motion ends where a contact sphere first reaches the ground (`first_impact`).
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.reference.brakes import Brakes, least_shares
from mbds_xsim.reference.compiled import Kernel, chosen, with_signs_of
from mbds_xsim.reference.dynamics import Dynamics
from mbds_xsim.reference.first_impact import FirstImpact, dips, first_touch, resting
from mbds_xsim.reference.lanes import LANES
from mbds_xsim.reference.march_kernel import ACCELERATE, PROJECT
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
from mbds_xsim.reference.tree import to_tree
from mbds_xsim.scene.state import Failure

_NARROW = 2.0**-50  # share of a step within which an event in it is found
_APART = 1e-9  # the same of two that are looked at one by one
_ALL = 1.0 - 1e-9  # share of its friction from which on a joint that stands still gives way
_STILL = 1e-12  # of all joints' accelerations without friction: what keeps on standing still
_TOUCHING = 1e-12  # [rad or m]: before a stop
_SLOW = 1e-6  # of a joint's fastest approach to its stop: what does not bounce
_NOISE = 1e-6  # of the fastest rate of any joint: at rest against a stop, rounding moves a joint
_MOST_EVENTS = 1000  # in a frame


def march_gripping(problem: Problem) -> Marched:
    """Integrate states frame by frame, one after the other."""
    marched = Marched.from_start(problem)
    _, spanned, _ = chosen(problem.mechanism)
    places = to_tree(spanned, problem.dynamics.unpack(problem.start), problem.start)
    for row, place in enumerate(places):
        motion = _Motion(problem.dynamics, place, problem.rtol)
        for k in range(problem.frames):
            try:
                impact = motion.through_frame(problem.force[row, k], problem.torque[row, k])
            except ArithmeticError as error:
                marched.failures[row] = Failure(k + 1, f"the solution cannot be continued: {error}")
                break
            if impact is not None:
                marched.failures[row] = FirstImpact.at(k + 1, k * problem.frame + impact)
                break
            marched.states[row, k + 1] = with_signs_of(motion.state(), marched.states[row, k])
    return marched


class _Motion:
    """One trajectory under way, in coordinates of the tree."""

    def __init__(self, dynamics: Dynamics, y: Array, rtol: float) -> None:
        mechanism, self._dynamics = dynamics.mechanism, dynamics
        self._lands = bool(mechanism.scene.contacts)
        self._tree, spanned, _ = chosen(mechanism)
        self._kernel = Kernel(self._tree)
        self._frame, self._rtol = mechanism.scene.clock.frame, rtol
        self._brakes = brakes = Brakes.of(self._tree, spanned)
        self._onto = np.equal.outer(np.arange(len(self._tree.law)), brakes.law).astype(float)
        """Which law each brake acts by, shape (law, brake)."""
        self._y, self._step = y, FIRST_STEP * self._frame
        self._sense = np.where(brakes.stops, 1.0, np.sign(y[brakes.fast]))
        """Of joints with friction: −1 or 1 where they move, 0 where they stand still. Of stops: 0
        where a joint rests against them, 1 elsewhere."""
        self._fastest = np.zeros(len(brakes.law))
        """Approach to each stop so far [rad/s or m/s]."""
        self._y = self._closed(y)

    def state(self) -> Array:
        """Give the states of the bodies, shape (body + world, 13)."""
        self._kernel.y[:] = self._y[:, None]
        return self._kernel.body_states()[0]

    def through_frame(self, force: Array, torque: Array) -> float | None:
        """Go on to the end of a frame, or give when in it a sphere first touches the ground [s].

        Raises:
            ArithmeticError: Neither can be reached.
        """
        loads = self._kernel.work.load.reshape(-1, 6, LANES)
        loads[:-1, :3] = force[self._tree.body][..., None]
        self._kernel.work.torque[: len(torque)] = torque[:, None]
        left, events = self._frame, 0
        self._turn_at(self._y)
        if self._lands and resting(*self._heights(self._y)):
            return 0.0
        rate = self._derivative(self._y[None])
        for _ in range(MOST_STEPS):
            h = left / np.ceil(left / self._step)
            new, ratio = self._tried(rate, h)
            self._step = float(next_step(np.array([h]), np.array([ratio]))[0])
            if not ratio <= 1.0:
                if self._step < SMALLEST_STEP * self._frame:
                    break
                continue
            if events > _MOST_EVENTS:
                break
            share = self._event_within(rate, h, new)
            if share is not None:
                h, events = h * share, events + 1
                new = self._tried(rate, h)[0]
            if (touch := self._touch_within(rate, h, new)) is not None:
                return float(self._frame - left + touch * h)
            if share is not None:
                self._step = FIRST_STEP * self._frame
                self._turn_at(new)
            self._y, left = new, left - h
            if left <= 1e-14 * self._frame:
                self._y = self._closed(self._y)
                return None
            rate = self._derivative(self._y[None])
        why = "its steps become too short or too many: see friction, limits, springs"
        raise ArithmeticError(why)

    def _heights(self, y: Array) -> tuple[Array, Array]:
        """Give heights of contact spheres above the ground and their rates, shape (1, sphere)."""
        self._kernel.y[:] = y[:, None]
        return self._dynamics.gaps(self._kernel.body_states()[:1])

    def _touch_within(self, rate: Array, h: float, new: Array) -> float | None:
        """Find the shortest part of a step in which a sphere reaches the ground."""
        if not self._lands:
            return None
        places = dips(self._heights(self._y), self._heights(new), np.array([h]))[0]
        return first_touch(
            lambda share: float(self._heights(self._tried(rate, share * h)[0])[0].min()), places
        )

    def _tried(self, rate: Array, h: float) -> tuple[Array, float]:
        """Make a step; also give its error over what is allowed."""
        step = np.array([h])
        new, stages = try_step(self._derivative, self._y[None], rate, step)
        allowed = self._rtol * (1.0 + np.maximum(np.abs(self._y), np.abs(new)))
        return new[0], float(error_ratio(stages, step, allowed)[0])

    def _event_within(self, rate: Array, h: float, new: Array) -> float | None:
        """Find the shortest part of a step in which something stops, gives way or meets a stop."""
        low, high = 0.0, 1.0
        if not self._has_turned(new):
            places = self._dips(h, new)
            crossed = (p for p in places.tolist() if self._has_turned(self._tried(rate, p * h)[0]))
            if (found := next(crossed, None)) is None:
                return None
            high = found
        return self._narrowed(rate, h, low, high)

    def _narrowed(self, rate: Array, h: float, low: float, high: float) -> float:
        """Find the least share of a step at which it has happened, as it has at the upper one."""
        from scipy.optimize import brentq  # takes long to import

        after = self._left(self._tried(rate, high * h)[0])
        for brake in np.flatnonzero((self._left(self._y) > 0.0) & (after < 0.0)).tolist():
            if self._left_at(high, rate, h, brake) < 0.0:
                root = brentq(self._left_at, low, high, (rate, h, brake), xtol=_NARROW)
                high = min(high, root + 2.0 * _NARROW)
        if not self._has_turned(self._tried(rate, high * (1.0 - _APART) * h)[0]):
            return high  # nothing happens before
        while high - low > _NARROW:
            middle = (low + high) / 2
            turned = self._has_turned(self._tried(rate, middle * h)[0])
            low, high = (low, middle) if turned else (middle, high)
        return high

    def _left_at(self, share: float, rate: Array, h: float, brake: int) -> float:
        return float(self._left(self._tried(rate, share * h)[0])[brake])

    def _left(self, y: Array) -> Array:
        """Give what is left until joints come to rest, or to open stops, shape (brake,)."""
        brakes = self._brakes
        gaps = np.where(self._open, brakes.gaps(y), np.inf)
        return np.where(brakes.stops, gaps, self._sense * y[brakes.fast])

    def _dips(self, h: float, new: Array) -> Array:
        """Find where in a step joints may be past stops that they are before at both ends."""
        ends = [
            (self._brakes.gaps(y)[None, self._open], -self._brakes.approach(y)[None, self._open])
            for y in (self._y, new)
        ]
        places = dips(ends[0], ends[1], np.array([h]))
        return np.sort(places[np.isfinite(places)])

    @property
    def _open(self) -> Mask:
        """Stops against which no joint rests."""
        return self._brakes.stops & (self._sense != 0.0)

    def _has_turned(self, y: Array) -> bool:
        """Whether a joint has come back to rest or gives way, or is past a stop."""
        brakes = self._brakes
        if (self._sense * y[brakes.fast] < 0.0)[~brakes.stops].any():
            return True
        gaps = brakes.gaps(y)
        past = (gaps < 0.0) & ((brakes.approach(y) > 0.0) | (gaps < -_TOUCHING))
        if past[self._open].any():
            return True
        return bool(self._settled(y, self._sense)[self._sense == 0].any())

    def _turn_at(self, y: Array) -> None:
        """Go on from an event, or with other loads: joints stop, bounce, rest or give way."""
        brakes, sense = self._brakes, self._sense
        back = ~brakes.stops & (sense * y[brakes.fast] < 0.0)
        y[brakes.fast[back]] = 0.0
        touched = brakes.gaps(y) <= _TOUCHING
        y[brakes.place[touched]] = brakes.bound[touched]
        if (touched & (brakes.approach(y) > 0.0)).any():
            self._bounce(y, touched)
        resting = touched & (brakes.approach(y) == 0.0)
        moving = np.sign(y[brakes.fast])
        self._sense = self._settled(y, np.where(brakes.stops, 1.0 - resting, moving))

    def _bounce(self, y: Array, touched: Mask) -> None:
        """Let joints rebound from stops by Newton's law, all at once."""
        brakes = self._brakes
        speed = brakes.approach(y)
        least = _NOISE * float(np.abs(y[self._tree.speed_at[0] :]).max())
        self._fastest = np.fmax(self._fastest, np.maximum(speed * touched, least))
        rebound = brakes.restitution * (speed > _SLOW * self._fastest)
        columns = self._columns(y, 0.0 * self._sense, touched)
        change = columns[0] - columns[1:]
        taken = (brakes.turn * change[:, brakes.fast])[:, touched].T  # stops are of size 1
        wanted = (speed + rebound * np.maximum(speed, 0.0))[touched]
        none = 0.0 * wanted
        y -= least_shares(wanted, taken, none, none + np.inf) @ change
        small = np.abs(brakes.approach(y)) < _SLOW * self._fastest.max()
        flat = touched & (rebound == 0.0) & small
        y[brakes.fast[flat]] = 0.0

    def _settled(self, y: Array, sense: Array) -> Array:
        """Decide which of the joints that stand still go on to do so, and where others go."""
        held, brakes = np.flatnonzero(sense == 0), self._brakes
        if not len(held):
            return sense
        found = self._columns(y, sense, sense == 0)
        power = brakes.turn * brakes.size * found[:, brakes.fast]
        free, taken = power[0, held], (power[0, held] - power[1:, held]).T
        least, most, stops = brakes.least[held], brakes.most[held], brakes.stops[held]
        share, size = least_shares(free, taken, least, most), brakes.size[held]
        # As accelerations, of which a joint with both has one.
        left, gripped = (free - taken @ share) / size, np.abs(taken[:, ~stops]).sum(axis=1)
        largest = np.abs(found[0, self._tree.speed_at[0] :]).max()
        small = _STILL * max(largest, ((np.abs(free) + gripped) / size).max())
        opens = stops & (left < -small)
        # Its friction does not give way where a joint still rests against a stop.
        joint = brakes.fast[held]
        rests = np.isin(joint, joint[stops & ~opens])
        yields = (np.abs(share) > _ALL) & (np.abs(left) > small) & ~rests
        settled = sense.copy()
        settled[held] = np.where(stops, opens, np.where(yields, np.sign(share), 0.0))
        return settled

    def _derivative(self, y: Array) -> Array:
        """Time derivative of a state, shape (1, number); joints that stand still stay so."""
        held = self._sense == 0
        found = self._columns(y[0], self._sense, held)
        if not held.any() or not np.isfinite(found).all():
            return found[:1]  # a stage that overflows ends a step, which then is tried shorter
        at, taken = self._brakes.fast[held], (found[0] - found[1:]).T
        share = np.linalg.lstsq(taken[at], found[0, at])[0]
        rate = found[0] - taken @ share
        rate[at] = 0.0
        return rate[None]

    def _columns(self, y: Array, sense: Array, held: Mask) -> Array:
        """Derivatives of a state with the friction of joints that move, then also with each brake.

        Shape (1 + held, number).
        """
        brakes = self._brakes
        size = brakes.turn * brakes.size
        base = np.where(brakes.stops, 0.0, size * sense)
        return self._evaluated(y, np.concatenate([base[None], base + np.diag(size)[held]]))

    def _evaluated(self, y: Array, grips: Array) -> Array:
        """Derivatives of a state under several brakes' forces, shape (column, number)."""
        self._kernel.y[:] = y[:, None]
        found = np.empty((len(grips), len(y)))
        for first in range(0, len(grips), LANES):
            part = grips[first : first + LANES]
            self._kernel.work.grip[: len(self._onto), : len(part)] = self._onto @ part.T
            self._kernel.run(ACCELERATE)
            found[first : first + len(part)] = self._kernel.rates.T[: len(part)]
        return found

    def _closed(self, y: Array) -> Array:
        """Put a state onto the closures; what stood still does so again."""
        brakes, rest = self._brakes, self._sense == 0
        still = brakes.fast[(y[brakes.fast] == 0.0) & rest]
        self._kernel.y[:] = y[:, None]
        self._kernel.run(PROJECT)
        closed = self._kernel.y[:, 0].copy()
        closed[still] = 0.0
        return closed

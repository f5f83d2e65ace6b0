"""March mechanisms with dry friction or stops in joints, from one event to the next.

With friction of constant size the motion is unique, as friction never decreases with the rate. A
joint that moves has all of its friction against it. A joint at rest has as much as keeps it there,
up to that limit; a stop pushes as much as keeps a joint from passing it (`brakes`). Events are that
a joint comes to rest, gives way or reaches a stop. Between them a motion is smooth, and steps are
those of `marching`. A motion ends when a contact sphere first reaches the ground (`first_impact`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.reference import dop853
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

_NARROW = 2.0**-50  # accuracy of an event's place, as a share of the step
_APART = 1e-9  # share of a step within which two events count as one
_ALL = 1.0 - 1e-9  # share of its friction above which a joint at rest gives way
_STILL = 1e-12  # of the joints' accelerations without friction: less leaves a joint at rest
_TOUCHING = 1e-12  # gap that counts as touching a stop [rad or m]
_SLOW = 1e-6  # of a joint's fastest approach to its stop: a slower one does not bounce
_NOISE = 1e-6  # of the fastest rate of any joint: rounding may move a joint at rest on a stop
_MOST_EVENTS = 1000  # in a frame
_CLOSE = 1e-3  # of the largest value in a step: where less is left, events are looked for
_INNER = np.linspace(0.0, 1.0, 257)  # shares of a step at which its stages are interpolated
_EXACT, _ORDER = 3, 5  # first stage accurate enough to interpolate, degree of the polynomial
_FIT = np.linalg.pinv(np.vander(dop853.PLACES[_EXACT:], _ORDER + 1, increasing=True))
_POWERS = np.vander(_INNER, _ORDER + 1, increasing=True)
_VALUES = _POWERS @ _FIT
_INTEGRALS = _POWERS * _INNER[:, None] / np.arange(1, _ORDER + 2) @ _FIT


class _Step(NamedTuple):
    """A step that was tried."""

    new: Array
    """State at its end."""
    ratio: float
    """Estimated error over the allowed one."""
    stages: Array
    """Derivatives at its stages and at its end, shape (stage, number)."""
    held: Array
    """What joints at rest need of their friction and stops there, shape (stage, holding)."""


def march_gripping(problem: Problem) -> Marched:
    """Integrate trajectories one after the other, frame by frame."""
    marched = Marched.from_start(problem)
    _, spanned, _ = chosen(problem.mechanism)
    starts = to_tree(spanned, problem.dynamics.unpack(problem.start), problem.start)
    for row, start in enumerate(starts):
        motion = _Motion(problem.dynamics, start, problem.rtol)
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
        """1 where a brake acts on the joint of a law, else 0, shape (law, brake)."""
        self._step = FIRST_STEP * self._frame
        self._sense = np.where(brakes.stops, 1.0, np.sign(y[brakes.fast]))
        """For friction: −1 or 1 if the joint moves, 0 if it is at rest. For stops: 0 if a joint
        rests against them, else 1."""
        self._fastest = np.zeros(len(brakes.law))
        """Fastest approach to each stop so far [rad/s or m/s]."""
        self._y = self._closed(y)

    def state(self) -> Array:
        """Return the states of the bodies, shape (body + world, 13)."""
        self._kernel.y[:] = self._y[:, None]
        return self._kernel.body_states()[0]

    def through_frame(self, force: Array, torque: Array) -> float | None:
        """Advance to the end of a frame, or return when a sphere first touches the ground [s].

        Raises:
            ArithmeticError: Neither can be reached.
        """
        loads = self._kernel.work.load.reshape(-1, 6, LANES)
        loads[:-1, :3] = force[self._tree.body][..., None]
        self._kernel.work.torque[: len(torque)] = torque[:, None]
        remaining, events = self._frame, 0
        self._turn_at(self._y)
        if self._lands and resting(*self._heights(self._y)):
            return 0.0
        rate = self._rate(self._y)[0][None]
        for _ in range(MOST_STEPS):
            h = remaining / np.ceil(remaining / self._step)
            step = self._tried(rate, h)
            self._step = float(next_step(np.array([h]), np.array([step.ratio]))[0])
            if not step.ratio <= 1.0:
                if self._step < SMALLEST_STEP * self._frame:
                    break
                continue
            if events > _MOST_EVENTS:
                break
            share = self._event_within(rate, h, step)
            if share is not None:
                h, events = h * share, events + 1
                step = self._tried(rate, h)
            new = step.new
            if (touch := self._touch_within(rate, h, new)) is not None:
                return float(self._frame - remaining + touch * h)
            if share is not None:
                self._step = FIRST_STEP * self._frame
                self._turn_at(new)
            self._y, remaining = new, remaining - h
            if remaining <= 1e-14 * self._frame:
                self._y = self._closed(self._y)
                return None
            rate = self._rate(new)[0][None] if share is not None else step.stages[-1:]
        why = "its steps become too short or too many: see friction, limits, springs"
        raise ArithmeticError(why)

    def _heights(self, y: Array) -> tuple[Array, Array]:
        """Return heights of contact spheres above the ground, and their rates, (1, sphere)."""
        self._kernel.y[:] = y[:, None]
        return self._dynamics.gaps(self._kernel.body_states()[:1])

    def _touch_within(self, rate: Array, h: float, new: Array) -> float | None:
        """Find the share of a step after which a sphere reaches the ground; None if it does not."""
        if not self._lands:
            return None
        places = dips(self._heights(self._y), self._heights(new), np.array([h]))[0]
        return first_touch(
            lambda share: float(self._heights(self._tried(rate, share * h).new)[0].min()), places
        )

    def _tried(self, rate: Array, h: float) -> _Step:
        """Try a step."""
        held: list[Array] = []

        def derivative(y: Array) -> Array:
            rate, share = self._rate(y[0])
            held.append(share)
            return rate[None]

        step = np.array([h])
        new, stages = try_step(derivative, self._y[None], rate, step)
        allowed = self._rtol * (1.0 + np.maximum(np.abs(self._y), np.abs(new)))
        ratio = float(error_ratio(stages, step, allowed)[0])
        return _Step(new[0], ratio, stages[:, 0], np.array([held[0], *held]))

    def _event_within(self, rate: Array, h: float, step: _Step) -> float | None:
        """Find the share of a step after which its first event occurs; None if there is none."""
        places = self._dips(h, step.new)
        places = np.sort(np.concatenate([places, self._halts(h, step), self._yields(step)]))
        for place in places[places < 1.0].tolist():
            if self._has_turned(self._tried(rate, place * h).new):
                return self._narrowed(rate, h, place)
        return self._narrowed(rate, h, 1.0) if self._has_turned(step.new) else None

    def _narrowed(self, rate: Array, h: float, high: float) -> float:
        """Find the least share of a step at which an event has occurred, as it has at `high`."""
        from scipy.optimize import brentq  # takes long to import

        after = self._margins(self._tried(rate, high * h).new)
        for brake in np.flatnonzero((self._margins(self._y) > 0.0) & (after < 0.0)).tolist():
            if self._margin_at(high, rate, h, brake) < 0.0:
                root = brentq(self._margin_at, 0.0, high, (rate, h, brake), xtol=_NARROW)
                high = min(high, root + 2.0 * _NARROW)
        if not self._has_turned(self._tried(rate, high * (1.0 - _APART) * h).new):
            return high  # no event occurs before
        low = 0.0
        while high - low > _NARROW:
            middle = (low + high) / 2
            turned = self._has_turned(self._tried(rate, middle * h).new)
            low, high = (low, middle) if turned else (middle, high)
        return high

    def _margin_at(self, share: float, rate: Array, h: float, brake: int) -> float:
        return float(self._margins(self._tried(rate, share * h).new)[brake])

    def _margins(self, y: Array) -> Array:
        """Rates of moving joints and gaps to open stops, shape (brake,); below 0 after an event."""
        brakes = self._brakes
        gaps = np.where(self._open, brakes.gaps(y), np.inf)
        return np.where(brakes.stops, gaps, self._sense * y[brakes.fast])

    def _dips(self, h: float, new: Array) -> Array:
        """Find shares of a step at which joints may be past stops, though not at its ends."""
        ends = [
            (self._brakes.gaps(y)[None, self._open], -self._brakes.approach(y)[None, self._open])
            for y in (self._y, new)
        ]
        places = dips(ends[0], ends[1], np.array([h]))
        return np.asarray(places[np.isfinite(places)])

    def _halts(self, h: float, step: _Step) -> Array:
        """Find shares of a step at which moving joints may come to rest, and move on at its end."""
        slides = ~self._brakes.stops & (self._sense != 0.0)
        fast, sense = self._brakes.fast[slides], self._sense[slides]
        if not len(fast):
            return _INNER[:0]
        change = _INTEGRALS @ (h * step.stages[_EXACT:, fast])
        speed = sense * (self._y[fast] + change)
        return _lows(speed, _CLOSE * np.abs(speed).max(axis=0))

    def _yields(self, step: _Step) -> Array:
        """Find shares of a step at which joints at rest may give way, though not at its end."""
        stops = self._brakes.stops[self._sense == 0.0]
        if not len(stops):
            return _INNER[:0]
        needed = _VALUES @ step.held[_EXACT:]
        size = np.where(stops, np.abs(needed).max(axis=0), 1.0)
        return _lows(np.where(stops, needed, 1.0 - np.abs(needed)), _CLOSE * size)

    @property
    def _open(self) -> Mask:
        """Stops against which no joint rests."""
        return self._brakes.stops & (self._sense != 0.0)

    def _has_turned(self, y: Array) -> bool:
        """Whether a joint has come to rest, gives way or is past a stop."""
        brakes = self._brakes
        if (self._sense * y[brakes.fast] < 0.0)[~brakes.stops].any():
            return True
        gaps = brakes.gaps(y)
        past = (gaps < 0.0) & ((brakes.approach(y) > 0.0) | (gaps < -_TOUCHING))
        if past[self._open].any():
            return True
        return bool(self._settled(y, self._sense)[self._sense == 0].any())

    def _turn_at(self, y: Array) -> None:
        """Update joints at an event, or for new loads: they stop, bounce, rest or give way."""
        brakes, sense = self._brakes, self._sense
        back = ~brakes.stops & (sense * y[brakes.fast] < 0.0)
        y[brakes.fast[back]] = 0.0
        touched = brakes.gaps(y) <= _TOUCHING
        y[brakes.place[touched]] = brakes.bound[touched]
        if (touched & (brakes.approach(y) > 0.0)).any():
            self._bounce(y, touched)
        rests = touched & (brakes.approach(y) == 0.0)
        moving = np.sign(y[brakes.fast])
        self._sense = self._settled(y, np.where(brakes.stops, 1.0 - rests, moving))

    def _bounce(self, y: Array, touched: Mask) -> None:
        """Let joints rebound from stops by Newton's law, all at once."""
        brakes = self._brakes
        speed = brakes.approach(y)
        least = _NOISE * float(np.abs(y[self._tree.speed_at[0] :]).max())
        self._fastest = np.fmax(self._fastest, np.maximum(speed * touched, least))
        rebound = brakes.restitution * (speed > _SLOW * self._fastest)
        columns = self._columns(y, 0.0 * self._sense, touched)
        change = columns[0] - columns[1:]
        reduction = (brakes.turn * change[:, brakes.fast])[:, touched].T  # stops have size 1
        wanted = (speed + rebound * np.maximum(speed, 0.0))[touched]
        none = 0.0 * wanted
        y -= least_shares(wanted, reduction, none, none + np.inf) @ change
        small = np.abs(brakes.approach(y)) < _SLOW * self._fastest.max()
        flat = touched & (rebound == 0.0) & small
        y[brakes.fast[flat]] = 0.0

    def _settled(self, y: Array, sense: Array) -> Array:
        """Decide which joints at rest stay there, and in which direction the others move."""
        holding, brakes = np.flatnonzero(sense == 0), self._brakes
        if not len(holding):
            return sense
        columns = self._columns(y, sense, sense == 0)
        power = brakes.turn * brakes.size * columns[:, brakes.fast]
        free, reduction = power[0, holding], (power[0, holding] - power[1:, holding]).T
        least, most, stops = brakes.least[holding], brakes.most[holding], brakes.stops[holding]
        share, size = least_shares(free, reduction, least, most), brakes.size[holding]
        # As accelerations: a joint with both friction and a stop has only one.
        net, gripped = (free - reduction @ share) / size, np.abs(reduction[:, ~stops]).sum(axis=1)
        largest = np.abs(columns[0, self._tree.speed_at[0] :]).max()
        small = _STILL * max(largest, ((np.abs(free) + gripped) / size).max())
        opens = stops & (net < -small)
        # Friction does not give way while its joint still rests against a stop.
        joint = brakes.fast[holding]
        rests = np.isin(joint, joint[stops & ~opens])
        yields = (np.abs(share) > _ALL) & (np.abs(net) > small) & ~rests
        settled = sense.copy()
        settled[holding] = np.where(stops, opens, np.where(yields, np.sign(share), 0.0))
        return settled

    def _rate(self, y: Array) -> tuple[Array, Array]:
        """Return the time derivative, and the shares of their brakes that hold joints at rest."""
        holding = self._sense == 0
        columns = self._columns(y, self._sense, holding)
        if not holding.any() or not np.isfinite(columns).all():
            # If a stage overflowed, the step fails, and a shorter one follows.
            return columns[0], np.zeros(int(holding.sum()))
        at, reduction = self._brakes.fast[holding], (columns[0] - columns[1:]).T
        share = np.linalg.lstsq(reduction[at], columns[0, at])[0]
        rate = columns[0] - reduction @ share
        rate[at] = 0.0
        return rate, share

    def _columns(self, y: Array, sense: Array, holding: Mask) -> Array:
        """Derivatives of a state with friction of moving joints, then also with each holding brake.

        Shape (1 + holding, number).
        """
        brakes = self._brakes
        size = brakes.turn * brakes.size
        base = np.where(brakes.stops, 0.0, size * sense)
        grips = np.concatenate([base[None], base + np.diag(size)[holding]])
        self._kernel.y[:] = y[:, None]
        rates = np.empty((len(grips), len(y)))
        for first in range(0, len(grips), LANES):
            part = grips[first : first + LANES]
            self._kernel.work.grip[: len(self._onto), : len(part)] = self._onto @ part.T
            self._kernel.run(ACCELERATE)
            rates[first : first + len(part)] = self._kernel.rates.T[: len(part)]
        return rates

    def _closed(self, y: Array) -> Array:
        """Project a state onto the closures; joints at rest stay at rest."""
        brakes, rest = self._brakes, self._sense == 0
        still = brakes.fast[(y[brakes.fast] == 0.0) & rest]
        self._kernel.y[:] = y[:, None]
        self._kernel.run(PROJECT)
        closed = self._kernel.y[:, 0].copy()
        closed[still] = 0.0
        return closed


def _lows(values: Array, limits: Array) -> Array:
    """Find the inner places of a step at which values, shape (place, part), dip below limits."""
    inner = values[1:-1]
    near = inner < limits
    if not near.any():
        return _INNER[:0]
    # A plateau has as many minima as roundings: a dip lies below both ends of the step.
    deep = inner < np.minimum(values[0], values[-1]) - 1e-6 * limits
    low = near & deep & (inner <= values[:-2]) & (inner <= values[2:])
    return np.asarray(_INNER[1:-1][low.any(axis=1)])

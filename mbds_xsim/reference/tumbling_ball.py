"""Motion of a ball with any inertia; all but the flight of its centre of mass is integrated.

A tangential force f at the lowest point changes the slip by K f, where K depends on the
orientation. While the ball slides, the scaled time σ of `ball` keeps the equations smooth up to the
stop: there the slip fades exponentially, and its last direction results from the equations.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.ball import STILL, BallContact, BallState, Load, flown
from mbds_xsim.reference.turning import cross, integrated, turning

_SEED = 2.0 * STILL  # slip with which sliding starts if there is none [m/s]
_FIRM = 1.0 - 1e-12  # share of the largest friction up to which rolling goes on
_FOREVER = 1e15
_CROSS = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Matrix of z × v for vectors in the ground plane."""

_FADED = 40.0  # time constants after which an exponential is below rounding


def _panels(count: int) -> tuple[Array, Array]:
    """Nodes in [0, 1] and weights of Gauss's 16-point rule on equal panels."""
    x, w = np.polynomial.legendre.leggauss(16)
    places = (np.arange(count)[:, None] + 0.5 * (1.0 + x)) / count
    return places.reshape(-1), np.tile(0.5 * w / count, count)


_PLACES, _WEIGHTS = _panels(128)


@dataclass(frozen=True, slots=True)
class TumblingBall:
    """Laws of motion of a ball with any inertia."""

    contact: BallContact
    moments: Array
    """Principal moments of inertia [kg·m²], shape (3,)."""

    def fly(self, motion: BallState, load: Load, duration: float) -> BallState:
        """Move without contact: a parabola, and a rotation by Euler's equations."""
        if not duration:
            return motion

        def rate(_: float, y: Array) -> Array:
            turn, spin = y[:4], y[4:]
            return np.concatenate([turning(turn, spin), self._free(turn, spin)[1]])

        y = integrated(rate, np.concatenate([motion.turn, _spin_of(motion)]), duration).y[:, -1]
        return _turned(flown(motion, load, duration), y[:4], y[4:])

    def hit(self, motion: BallState) -> BallState:
        """Bounce: friction acts against a slip that may turn during the impact."""
        inverse, _ = self._free(motion.turn, _spin_of(motion))
        slip, most = _pair(self.contact.slip(motion)), self.contact.impulse(motion)
        yielding = self._yielding(inverse)
        impulse = _impact(yielding, slip, self.contact.friction * most)
        spin = _spin_of(motion) + self._gain(inverse, impulse)
        velocity = motion.velocity + complex(*impulse) / self.contact.mass
        moved = dataclasses.replace(motion, velocity=velocity, climb=self.contact.rebound(motion))
        return _turned(moved, motion.turn, spin)

    def keep_contact(self, motion: BallState, load: Load, limit: float) -> tuple[float, BallState]:
        """Slide until the slip stops, or roll until friction cannot hold against the loads."""
        most = self.contact.friction * self.contact.mass * -load.lift
        slip, push = _pair(self.contact.slip(motion)), _pair(load.push)
        if math.hypot(*slip) > STILL:
            return self._slide(motion, push, most, limit, slip, "DOP853")
        drive, yielding, _ = self._drive(motion.turn, _spin_of(motion), push)
        if math.hypot(*np.linalg.solve(yielding, drive)) <= _FIRM * most:
            return self._roll(motion, push, most, limit)
        # A slip that starts with hardly any growth turns much faster than it grows.
        seed = _SEED * _breakaway(yielding, drive, most)
        return self._slide(motion, push, most, limit, seed, "LSODA")

    def _slide(
        self, motion: BallState, push: Array, most: float, limit: float, slip: Array, method: str
    ) -> tuple[float, BallState]:
        def rate(_: float, y: Array) -> Array:
            slip, turn, spin = y[3:5], y[5:9], y[9:]
            speed = math.hypot(*slip)
            drive, yielding, inverse = self._drive(turn, spin, push)
            velocity = slip - self.contact.radius * (_CROSS @ spin[:2])
            gain = speed * self._free(turn, spin)[1] - self._gain(inverse, most * slip)
            change = speed * drive - most * (yielding @ slip)
            moving = speed * np.concatenate([[1.0], velocity])
            return np.concatenate([moving, change, speed * turning(turn, spin), gain])

        def over(_: float, y: Array) -> float:
            return limit - float(y[0])

        def stopped(_: float, y: Array) -> float:
            return math.hypot(y[3], y[4]) - 0.5 * STILL

        place, spin = _pair(motion.place), _spin_of(motion)
        start = np.concatenate([np.zeros(1), place, slip, motion.turn, spin])
        y = integrated(rate, start, _FOREVER, over, stopped, method=method)
        end = y.y[:, -1]
        duration = limit if len(y.t_events[0]) else min(limit, float(end[0]))
        return duration, self._moved(motion, end[1:3], end[3:5], end[5:9], end[9:])

    def _roll(
        self, motion: BallState, push: Array, most: float, limit: float
    ) -> tuple[float, BallState]:
        def friction(y: Array) -> tuple[Array, Array]:
            drive, yielding, inverse = self._drive(y[2:6], y[6:], push)
            return np.asarray(-np.linalg.solve(yielding, drive)), inverse

        def rate(_: float, y: Array) -> Array:
            turn, spin = y[2:6], y[6:]
            force, inverse = friction(y)
            velocity = -self.contact.radius * (_CROSS @ spin[:2])
            gain = self._free(turn, spin)[1] + self._gain(inverse, force)
            return np.concatenate([velocity, turning(turn, spin), gain])

        def slips(_: float, y: Array) -> float:
            return most - math.hypot(*friction(y)[0])

        start = np.concatenate([_pair(motion.place), motion.turn, _spin_of(motion)])
        y = integrated(rate, start, limit, slips)
        end = y.y[:, -1]
        return float(y.t[-1]), self._moved(motion, end[:2], np.zeros(2), end[2:6], end[6:])

    def _moved(
        self, motion: BallState, place: Array, slip: Array, turn: Array, spin: Array
    ) -> BallState:
        velocity = complex(*(slip - self.contact.radius * (_CROSS @ spin[:2])))
        moved = dataclasses.replace(motion, place=complex(*place), velocity=velocity)
        return _turned(moved, turn, spin)

    def _drive(self, turn: Array, spin: Array, push: Array) -> tuple[Array, Array, Array]:
        """Change of the slip without friction, K, and the inverse inertia in W."""
        inverse, free = self._free(turn, spin)
        drive = push + self.contact.radius * (_CROSS @ free[:2])
        return drive, self._yielding(inverse), inverse

    def _yielding(self, inverse: Array) -> Array:
        turning = self.contact.radius**2 * (_CROSS.T @ inverse[:2, :2] @ _CROSS)
        return np.asarray(np.eye(2) / self.contact.mass + turning)

    def _gain(self, inverse: Array, force: Array) -> Array:
        """Change of the spin by a tangential force at the lowest point."""
        return -self.contact.radius * (inverse[:, :2] @ (_CROSS @ force))

    def _free(self, turn: Array, spin: Array) -> tuple[Array, Array]:
        """Inverse inertia in W, and the change of the spin without any moment."""
        axes = rotation.matrix(turn / np.linalg.norm(turn))
        own = axes.T @ spin
        bend = cross(self.moments * own, own) / self.moments
        return (axes / self.moments) @ axes.T, axes @ bend


def _impact(yielding: Array, slip: Array, most: float) -> Array:
    """Impulse of friction in an impact; `most` is μ times the whole normal impulse.

    Along each eigenvector of K the slip fades as exp(−k σ), where |s| dσ = μ dp and p is the normal
    impulse so far. The impact ends when p is complete; if that takes forever in σ, the ball sticks.
    """
    from scipy.optimize import brentq  # takes long to import

    rates, axes = np.linalg.eigh(yielding)
    parts = axes.T @ slip
    longest = _FADED / rates[0]

    def passed(end: float) -> float:
        remaining = parts[:, None] * np.exp(-rates[:, None] * (end * _PLACES))
        return end * float(np.hypot(*remaining) @ _WEIGHTS)

    if passed(longest) <= most:
        remaining = np.zeros(2)
    else:
        end = brentq(lambda at: passed(at) - most, 0.0, longest, xtol=1e-300, rtol=1e-14)
        remaining = parts * np.exp(-rates * end)
    return np.asarray(np.linalg.solve(yielding, axes @ remaining - slip))


def _breakaway(yielding: Array, drive: Array, most: float) -> Array:
    """Direction d in which a slip starts to grow: drive − most · K d = λ d with λ ≥ 0."""
    from scipy.optimize import brentq  # takes long to import

    def direction(growth: float) -> Array:
        return np.asarray(np.linalg.solve(most * yielding + growth * np.eye(2), drive))

    def excess(growth: float) -> float:
        return math.hypot(*direction(growth)) - 1.0

    free = math.hypot(*drive)
    d = direction(brentq(excess, 0.0, free) if most and excess(0.0) > 0.0 > excess(free) else 0)
    return np.asarray(d / math.hypot(*d))


def _turned(motion: BallState, turn: Array, spin: Array) -> BallState:
    x, y, z = spin.tolist()
    turn = turn / np.linalg.norm(turn)
    return dataclasses.replace(motion, turn=turn, spin=complex(x, y), twist=z)


def _spin_of(motion: BallState) -> Array:
    return np.array([motion.spin.real, motion.spin.imag, motion.twist])


def _pair(plane: complex) -> Array:
    return np.array([plane.real, plane.imag])

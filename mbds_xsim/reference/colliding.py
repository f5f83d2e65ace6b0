"""March balls that collide with each other and touch nothing else, from impact to impact.

Between impacts a ball's path is a parabola and its spin is constant. An impact of two balls is
central: normal and tangential motion do not couple, so that Newton's restitution and Coulomb's
friction together have one solution. An impact of three balls at once has no unique solution.
"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.first_impact import TOUCHING, FirstImpact
from mbds_xsim.reference.marching import Marched, Problem
from mbds_xsim.reference.topology import topology_of
from mbds_xsim.scene.mechanism import Mechanism

_MOST_IMPACTS = 20_000  # in a frame
_PRESSED = 1e-9  # overlap above which balls are pressed together [m]
_GRAZING = 1e-12  # approach over the fastest speed below which it is rounding, and no impact
_REAL = 1e-7  # largest imaginary part of a real root, over its size
_ROUNDING = 1e-14  # of the terms: a larger residual remains if Newton's steps leave a grazing root


def march_colliding(problem: Problem) -> Marched:
    """Solve a scene of colliding balls without ground, exactly whatever the tolerance."""
    marched = Marched.from_start(problem)
    states = marched.states
    states[:, :, -1] = problem.start[:, None, -1]
    for row in range(len(problem.start)):
        balls = _Balls(problem.mechanism, states[row, 0, :-1].copy())
        for k in range(problem.frames):
            time = k * problem.frame
            try:
                meeting = balls.through_frame(problem.force[row, k], problem.frame)
            except ArithmeticError as error:
                why = f"{error} after {time:.6g} s: from then on, not only impacts act"
                marched.failures[row] = FirstImpact(k + 1, why, time)
                break
            if meeting is not None:
                marched.failures[row] = FirstImpact.at(k + 1, time + meeting)
                break
            states[row, k + 1, :-1] = balls.state
        if (failure := marched.failures[row]) is not None:
            states[row, failure.frame :] = np.nan
    return marched


class _Balls:
    """Moving balls; `state` has the shape (ball, 13)."""

    def __init__(self, mechanism: Mechanism, state: Array) -> None:
        collisions = mechanism.scene.collisions
        assert collisions is not None
        self.state, self._mass = state, mechanism.mass
        self._moment = topology_of(mechanism).inertia_root[:-1].mean(axis=1) ** 2
        self._radius = np.empty(len(state))
        self._radius[mechanism.sphere_body] = mechanism.sphere_radius
        self._pairs = mechanism.sphere_body[mechanism.sphere_pairs]
        self._reach = self._radius[self._pairs].sum(axis=1)
        self._friction, self._restitution = collisions.friction, collisions.restitution
        self._gravity = np.array(mechanism.scene.gravity)

    def through_frame(self, force: Array, duration: float) -> float | None:
        """Advance to the end of a frame, or return when three balls first meet in it [s].

        Raises:
            ArithmeticError: There are too many impacts, or balls press on each other.
        """
        pull, remaining = self._gravity + force / self._mass[:, None], duration
        for _ in range(_MOST_IMPACTS):
            times = self._times(pull, remaining)
            first = float(times.min(initial=np.inf))
            self._fly(pull, min(first, remaining))
            if first > remaining:
                if (self._gaps() < -_PRESSED).any():
                    break
                return None
            remaining -= first
            pair = int(times.argmin())
            near = np.flatnonzero(self._gaps() <= TOUCHING)
            if np.isin(self._pairs[near[near != pair]], self._pairs[pair]).any():
                return duration - remaining
            self._hit(*self._pairs[pair].tolist())
        raise ArithmeticError("balls are pressed together")

    def _apart(self, values: Array) -> Array:
        return values[self._pairs[:, 0]] - values[self._pairs[:, 1]]

    def _gaps(self) -> Array:
        return rotation.norm(self._apart(self.state[:, :3])) - self._reach

    def _fly(self, pull: Array, time: float) -> None:
        state = self.state
        state[:, :3] += time * state[:, 7:10] + 0.5 * time**2 * pull
        state[:, 7:10] += time * pull
        turn = rotation.multiply(rotation.from_vector(time * state[:, 10:]), state[:, 3:7])
        state[:, 3:7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)

    def _times(self, pull: Array, most: float) -> Array:
        """Return when each pair touches next [s], infinite if not within `most`, shape (pair,)."""
        place, speed = self._apart(self.state[:, :3]), self._apart(self.state[:, 7:10])
        bend, times = self._apart(pull), np.full(len(self._pairs), np.inf)
        fastest = float(rotation.norm(self.state[:, 7:10]).max())
        way = most * (rotation.norm(speed) + 0.5 * most * rotation.norm(bend))
        for k in np.flatnonzero(self._gaps() <= way).tolist():
            times[k] = _touch(place[k], speed[k], bend[k], self._reach[k], most, fastest)
        return times

    def _hit(self, one: int, other: int) -> None:
        """Let two balls that touch rebound, by Newton's and Coulomb's laws."""
        state, mass, radius, pair = self.state, self._mass, self._radius, [one, other]
        normal = state[one, :3] - state[other, :3]
        normal /= np.linalg.norm(normal)
        slip = state[one, 7:10] - state[other, 7:10]
        approach = -float(slip @ normal)
        slip -= np.cross(radius[pair] @ state[pair, 10:], normal)
        slip -= (slip @ normal) * normal
        yields = (1.0 / mass[pair]).sum()
        push = (1.0 + self._restitution) * approach / yields
        across, speed = (radius[pair] ** 2 / self._moment[pair]).sum(), np.linalg.norm(slip)
        drag = min(self._friction * push, speed / (yields + across))
        impulse = push * normal - (drag / speed * slip if speed else 0.0)
        for ball, sign in ((one, 1.0), (other, -1.0)):
            state[ball, 7:10] += sign * impulse / mass[ball]
            state[ball, 10:] -= radius[ball] * np.cross(normal, impulse) / self._moment[ball]


def _touch(
    place: Array, speed: Array, bend: Array, reach: float, most: float, fastest: float
) -> float:
    """Time at which |place + speed t + bend t²/2| first falls to `reach`, infinite if never.

    It is a root of a polynomial of degree four, which is scaled to the time `most`.
    """
    u, b = most * speed, most**2 * bend
    terms = np.array(
        [place @ place - reach**2, 2.0 * place @ u, u @ u + place @ b, u @ b, b @ b / 4.0]
    )
    if not terms[1:].any():
        return float(np.inf)
    polynomial = np.polynomial.Polynomial(np.trim_zeros(terms, "b"))
    slope, grazing = polynomial.deriv(), _GRAZING * reach * fastest * most
    for root in sorted(polynomial.roots(), key=lambda each: float(each.real)):
        if abs(root.imag) > _REAL * (1.0 + abs(root.real)):
            continue
        share = float(root.real)
        for _ in range(3):
            share -= float(polynomial(share) / (slope(share) or np.inf))
        met = abs(float(polynomial(share))) <= _ROUNDING * np.abs(terms).sum()
        if met and -TOUCHING <= share <= 1.0 and slope(share) < -grazing:
            return max(0.0, share) * most
    return float(np.inf)

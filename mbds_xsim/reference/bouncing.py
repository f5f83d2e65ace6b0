"""March balls through flight, impacts, sliding and rolling, from event to event.

Frames only cut the motion where the inputs change. With restitution e < 1 a ball bounces infinitely
often in a finite time: after a rebound v, under the downward acceleration a, the remaining bounces
take 2 v / (|a| (1 − e)). They are followed until that is less than 1e-8 s. From then on the ball
keeps contact. That moves it by less than a · (1e-8 s)², 1e-15 m.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.ball import BallContact, BallState, EvenBall, Load, time_to_ground
from mbds_xsim.reference.first_impact import TOUCHING
from mbds_xsim.reference.marching import Marched, Problem
from mbds_xsim.reference.topology import topology_of
from mbds_xsim.reference.tumbling_ball import TumblingBall
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Failure

Ball = EvenBall | TumblingBall
"""Laws of motion of one ball: it can `fly`, `hit` the ground and `keep_contact` with it."""

_SHORTEST = 1e-8  # duration of the remaining bounces below which they are skipped [s]
_MOST_EVENTS = 20_000  # in a frame
_EVEN = 1e-12


def march_balls(problem: Problem) -> Marched:
    """Solve a scene of balls, exactly except for the motions that `tumbling_ball` integrates.

    Args:
        problem: Problem of a mechanism with `has_only_balls`; its tolerance is not used.
    """
    mechanism = problem.mechanism
    marched = Marched.from_start(problem)
    states = marched.states
    states[:, :, -1] = problem.start[:, None, -1]
    for row in range(len(problem.start)):
        outcomes = [
            _march_one(mechanism, body, states[row, :, body], problem.force[row, :, body])
            for body in range(mechanism.body_count)
        ]
        failures = [failure for failure in outcomes if failure is not None]
        if failures:
            first = marched.failures[row] = min(failures, key=lambda failure: failure.frame)
            states[row, first.frame :] = np.nan
    return marched


def through_frame(ball: Ball, motion: BallState, load: Load, duration: float) -> BallState:
    """Follow a ball under a constant load.

    Raises:
        ArithmeticError: There are too many impacts, or the integration fails.
    """
    remaining = duration
    for _ in range(_MOST_EVENTS):
        if motion.gap == 0.0 and motion.climb == 0.0 and load.lift < 0.0:
            used, motion = ball.keep_contact(motion, load, remaining)
        else:
            fall = time_to_ground(motion, load)
            used = min(remaining, fall)
            motion = ball.fly(motion, load, used)
            if fall <= remaining:
                motion = _settled(ball.hit(dataclasses.replace(motion, gap=0.0)), load, ball)
        remaining -= used
        if remaining <= 0.0:
            return motion
    raise ArithmeticError(f"more than {_MOST_EVENTS} impacts in a frame")


def _settled(motion: BallState, load: Load, ball: Ball) -> BallState:
    """Stop the vertical motion of a ball whose bounces are practically over."""
    last = 2.0 * motion.climb <= -load.lift * (1.0 - ball.contact.restitution) * _SHORTEST
    return dataclasses.replace(motion, climb=0.0) if last else motion


def _march_one(mechanism: Mechanism, body: int, states: Array, force: Array) -> Failure | None:
    """Fill in the states of one body, shape (frame, 13), as far as they can be found."""
    radius = float(mechanism.sphere_radius[list(mechanism.sphere_body).index(body)])
    ball = _ball_of(mechanism, body, states[0], force, radius)
    motion = _motion_of(states[0], radius)
    gravity, frame = np.array(mechanism.scene.gravity), mechanism.scene.clock.frame
    for k, (x, y, z) in enumerate((gravity + force / mechanism.mass[body]).tolist()):
        try:
            motion = through_frame(ball, motion, Load(complex(x, y), z), frame)
        except ArithmeticError as error:
            when = f"between {k * frame:.6g} and {(k + 1) * frame:.6g} s"
            return Failure(k + 1, f"the solution cannot be continued {when}: {error}")
        states[k + 1] = _state_of(motion, radius)
    return None


def _ball_of(mechanism: Mechanism, body: int, state: Array, force: Array, radius: float) -> Ball:
    ground = mechanism.scene.ground
    assert ground is not None
    mass = float(mechanism.mass[body])
    contact = BallContact(mass, radius, ground.friction, ground.restitution)
    moments = topology_of(mechanism).inertia_root[body] ** 2
    if np.ptp(moments) <= _EVEN * moments.max():
        return EvenBall(contact, float(moments.mean()))
    turn = rotation.matrix(state[3:7])
    inertia = turn @ np.diag(moments) @ turn.T
    if _in_plane(mechanism, state, force, inertia):
        return EvenBall(contact, float(inertia[1, 1]))
    return TumblingBall(contact, moments)


def _in_plane(mechanism: Mechanism, state: Array, force: Array, inertia: Array) -> bool:
    """Whether the motion stays in the x–z plane, with rotation about y only."""
    across = [mechanism.scene.gravity[1], state[8], state[10], state[12], *force[:, 1]]
    mixed = np.abs(inertia[1, ::2]).max() > _EVEN * inertia[1, 1]
    return not (np.any(across) or mixed)


def _motion_of(state: Array, radius: float) -> BallState:
    x, y, z = state[:3].tolist()
    vx, vy, vz, wx, wy, wz = state[7:].tolist()
    gap = z - radius
    if gap <= TOUCHING:
        gap, vz = 0.0, vz if abs(vz) > TOUCHING else 0.0
    return BallState(complex(x, y), gap, complex(vx, vy), vz, complex(wx, wy), wz, state[3:7])


def _state_of(motion: BallState, radius: float) -> Array:
    place, velocity, spin = motion.place, motion.velocity, motion.spin
    moving = [velocity.real, velocity.imag, motion.climb, spin.real, spin.imag, motion.twist]
    turn = motion.turn / np.linalg.norm(motion.turn)
    return np.array([place.real, place.imag, motion.gap + radius, *turn, *moving])

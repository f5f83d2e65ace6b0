"""What positions do between frames that velocities do not tell.

Over every second step, so that each frame is looked at, or over fewer, the displacement of points
on the bodies is compared with the integral of their velocities: of the quintic that meets the
velocity, and the acceleration and jerk that the scene gives, at both ends of the step. Its error is
H⁷/100800 of the velocity's sixth derivative (Davis & Rabinowitz 1984, Methods of Numerical
Integration, 2.9).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.carried import CarriedPoints, carried
from mbds_xsim.checks.flights import usual
from mbds_xsim.scene.joint_space import (
    BodyStates,
    joint_coordinate,
    to_bodies,
    to_links,
)
from mbds_xsim.scene.mechanism import Mechanism

EVERY_SECOND = (0, 2)
"""First step, and every how many: these take in every frame once."""

MOMENT = 5e-4  # of the interval of the frames: jerks are differences of accelerations over it
_FACTOR = 8.0  # errors of the quintic are up to so many times their estimate (measured: 7.3)


@dataclass(frozen=True, eq=False)
class Mismatch:
    """Mean velocity over a step as positions have it, less what velocities make of it.

    Shapes (trajectory, step, body, point, 3); NaN where frames are lost or something may touch.
    """

    points: CarriedPoints
    frame: Index
    """At which each step ends, shape (step,)."""
    left: Array
    """[m/s]"""
    velocity: Array
    """At the beginnings of all steps, then at their ends [m/s], shape (trajectory, 2 step, …)."""
    acceleration: Array
    """Mean over the step [m/s²]."""
    rate_acceleration: Array
    """The part of it that changes of the velocity coordinates make [m/s²]."""
    unclear: Array
    """What that may err by, being a difference over a moment [m/s²], (trajectory, step)."""
    jerk: Array
    """Larger RMS of the two ends [m/s³], shape (trajectory, step)."""
    blur: Array
    """What the integral itself leaves open [m/s], RMS, shape (trajectory, step)."""
    jerk_each: Array
    """As jerk, but of each body with points at its ends, shape (trajectory, step, body)."""
    blur_each: Array
    """As blur, of the same."""


class _Points(NamedTuple):
    """Positions of points and their first three derivatives, shapes (…, body, point, 3)."""

    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    rate_acceleration: Array


def mismatch_of(
    mechanism: Mechanism,
    bodies: BodyStates,
    force: Array,
    torque: Array,
    flying: Mask,
    *,
    frame: float,
    lag: float,
    steps: tuple[int, int],
    many: bool = False,
) -> Mismatch:
    """Compare positions and velocities over some steps, outside contact.

    Args:
        mechanism: Whose motion.
        bodies: Recorded states, NaN where they are lost, shape (trajectory, frame, body, …).
        force: [N], shape (trajectory, step, body, 3).
        torque: [N·m], with the pushes of drives, shape (trajectory, step, hinge + drive).
        flying: Steps outside contact, shape (trajectory, step).
        frame: Interval of the frames [s].
        lag: Recorded velocities belong to frame time + lag [s].
        steps: First step, and every how many; every second takes in all frames.
        many: As in `Record`.
    """
    first = np.arange(steps[0], bodies.position.shape[1] - 1, steps[1])
    flow = Flow(mechanism, MOMENT * frame, many)
    begin, end = _ends(flow, bodies, first, (flying, force, torque), lag)
    # Hermite's formulas with no, one and two derivatives at each end.
    trapezoid = (begin.velocity + end.velocity) / 2
    bend = (begin.acceleration - end.acceleration) * frame
    cubic = trapezoid + bend / 12
    quintic = trapezoid + bend / 10 + frame**2 / 120 * (begin.jerk + end.jerk)
    points = CarriedPoints(mechanism)
    gaps = trapezoid - cubic, cubic - quintic
    jerk = np.maximum(points.rms(begin.jerk), points.rms(end.jerk))
    return Mismatch(
        points=points,
        frame=first + 1,
        left=(end.position - begin.position) / frame - quintic,
        velocity=np.concatenate([begin.velocity, end.velocity], axis=1),
        acceleration=(begin.acceleration + end.acceleration) / 2,
        rate_acceleration=(begin.rate_acceleration + end.rate_acceleration) / 2,
        unclear=flow.moment * jerk,
        jerk=jerk,
        blur=_blur(*map(points.rms, gaps)),
        jerk_each=np.maximum(points.each(begin.jerk), points.each(end.jerk)),
        blur_each=_blur(*map(points.each, gaps)),
    )


def _ends(
    flow: Flow, bodies: BodyStates, first: Index, held: tuple[Mask, Array, Array], lag: float
) -> tuple[_Points, _Points]:
    """Give the points at the beginnings of steps and at their ends; flight and loads are held."""
    # Both at once: calls cost as much as numbers here.
    both, count = np.concatenate([first, first + 1]), len(first)
    free, force, torque = (np.concatenate([each[:, first]] * 2, axis=1) for each in held)
    if flow.mechanism.compliant or flow.mechanism.drives:
        torque = torque + wound(flow.mechanism, bodies)[:, both]
    points = _points_at(flow, bodies[:, both], free, force, torque, lag)
    begin, end = (
        _Points(*(each[:, half] for each in points))
        for half in (slice(0, count), slice(count, None))
    )
    return begin, end


def wound(mechanism: Mechanism, bodies: BodyStates) -> Array:
    """Torques of springs for whole turns, which states do not show [N·m], (…, frame, input)."""
    springs = [(joint, joint.stiffness) for joint in mechanism.hinges]
    springs += [(drive.joint, drive.servo.stiffness) for drive in mechanism.drives]
    torque = np.zeros((*bodies.position.shape[:2], len(springs)))
    for k, (joint, stiffness) in enumerate(springs):
        if joint.kind == "hinge":
            angle = joint_coordinate(joint, bodies.position, bodies.native)
            torque[..., k] = stiffness * (angle - np.unwrap(angle, axis=1))
    return torque


def _blur(coarse: Array, fine: Array) -> Array:
    """Error of the quintic, from what the cubic adds to the trapezoid and the quintic to that.

    What the quintic adds may be small by chance in a step, so none has less than what is usual in
    its trajectory.
    """
    return np.maximum(_left(coarse, fine), _left(usual(coarse), usual(fine)))


def _left(coarse: Array, fine: Array) -> Array:
    """Go on from what two formulas added, which fall alike; where they do not, nothing is resolved.

    Of several bodies the slowest fall counts for all.
    """
    gain = np.minimum(1.0, fine / np.maximum(coarse, np.finfo(float).tiny))
    if gain.ndim > 2:
        gain = gain.max(axis=-1, keepdims=True)
    return np.asarray(_FACTOR * gain**2 * np.maximum(coarse, fine))


def _points_at(
    flow: Flow,
    states: BodyStates,
    free: Mask,
    force: Array,
    torque: Array,
    lag: float,
) -> _Points:
    known = known_states(states) & free
    kept = states[known].each(np.asfortranarray)  # components apart, as in `Record`
    near = flow.closed(kept)
    if lag:
        rates = flow.accelerations(near, force[known], torque[known])
        gain = flow.of_rates(near, *rates)
        kept = _faster(kept, *gain, -lag)
        near = flow.closed(_faster(near, *gain, -lag))
    points = _derivatives(flow, kept, near, force[known], torque[known])
    return _Points(*(_placed(known, values) for values in points))


def _placed(known: Mask, values: Array) -> Array:
    """Put values of known states where these are, NaN elsewhere."""
    shape = *known.shape, *values.shape[1:]
    if known.all():
        return values.reshape(shape)
    found = np.full(shape, np.nan)
    found[known] = values
    return found


def _derivatives(
    flow: Flow, states: BodyStates, closed: BodyStates, force: Array, torque: Array
) -> _Points:
    mechanism = flow.mechanism
    rates = flow.accelerations(closed, force, torque)
    later = flow.closed(flow.later(closed, *rates))
    then = flow.accelerations(later, force, torque)
    position, velocity, acceleration = carried(mechanism, states, *rates)
    change = carried(mechanism, later, *then)[2] - carried(mechanism, closed, *rates)[2]
    pull, push = flow.of_rates(closed, *rates)
    gained = dataclasses.replace(states, velocity=pull, angular_velocity=push)
    swung = carried(mechanism, gained, *rates)[1]
    return _Points(position, velocity, acceleration, change / flow.moment, swung)


def _faster(states: BodyStates, pull: Array, push: Array, time: float) -> BodyStates:
    return dataclasses.replace(
        states,
        velocity=states.velocity + time * pull,
        angular_velocity=states.angular_velocity + time * push,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Flow:
    """The flow of a mechanism outside contact."""

    mechanism: Mechanism
    moment: float
    """Over which rates are differences [s]."""
    many: bool = False

    def accelerations(self, states: BodyStates, force: Array, torque: Array) -> tuple[Array, Array]:
        """Linear and angular accelerations, shapes (state, body, 3)."""
        # The reference loads the compiled parts of scipy, which most uses do without.
        from mbds_xsim.reference import accelerations

        return accelerations(self.mechanism, states, force, torque, many=self.many)

    def later(self, states: BodyStates, pull: Array, push: Array) -> BodyStates:
        """Give states a moment later, by their linear and angular accelerations."""
        moment = self.moment
        turn = moment * (states.angular_velocity + moment / 2 * push)
        return BodyStates(
            states.position + moment * (states.velocity + moment / 2 * pull),
            rotation.multiply(rotation.from_vector(turn), states.native),
            states.velocity + moment * pull,
            states.angular_velocity + moment * push,
        )

    def of_rates(self, states: BodyStates, pull: Array, push: Array) -> tuple[Array, Array]:
        """Give the part of accelerations that the velocity coordinates make by their change.

        These are joint rates, and velocities of free bodies. The rest comes from places that
        change while the coordinates stand still. Shapes (state, body, 3).
        """
        here = to_links(self.mechanism, states)
        then = to_links(self.mechanism, self.later(states, pull, push))
        changes = dataclasses.replace(
            here,
            angular_velocity=(then.angular_velocity - here.angular_velocity) / self.moment,
            rate=(then.rate - here.rate) / self.moment,
            velocity=(then.velocity - here.velocity) / self.moment,
        )
        found = to_bodies(self.mechanism, changes)
        return found.velocity, found.angular_velocity

    def closed(self, states: BodyStates) -> BodyStates:
        """Close the joints of mechanisms whose loops may hold their bodies twice.

        Where constraints depend on one another, gaps as small as engines leave tear them apart,
        and accelerations jump. The tree's joints are closed first, so that a flat loop is flat.
        Ball joints alone never depend on one another, but at single configurations.
        """
        mechanism = self.mechanism
        if not mechanism.loops or all(joint.kind == "ball" for joint in mechanism.joints):
            return states
        from mbds_xsim.reference.equations import dynamics_of

        known, dynamics = known_states(states), dynamics_of(mechanism)
        tree = to_bodies(mechanism, to_links(mechanism, states[known]))
        found = dynamics.unpack(dynamics.project(dynamics.pack(tree)))
        filled = states.each(lambda values: np.full_like(values, np.nan))
        for name, values in vars(filled).items():
            values[known] = getattr(found, name)
        return filled


def known_states(states: BodyStates) -> Mask:
    """Tell which states are not lost, shape of the leading axes."""
    return np.asarray(np.isfinite(states.position).all(axis=(-1, -2)))

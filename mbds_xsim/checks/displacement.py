"""Do displacements and turns, in flight and in contact, stay within what velocities allow?

Over a frame H the mean velocity is the mean of the velocities at its ends, except for what happens
in between. In smooth motion the difference is H²/12 of the second derivative, which the second
differences of recorded velocities show. In contact it comes from impulses that act early or late: a
velocity with recorded values at both ends, and with changes in between that add up to V, has a mean
within V/2 of the mean of its ends. The ground only pushes, and friction stays within its cone, so
that V follows from the vertical impulse of the frame, which the momentum shows exactly. It does not
matter how often, or when, a contact was hit.

Between two frames that are far apart, a light link that whips round or a joint that falls back on
its stop has velocities that differences of recorded ones do not show. The equations of motion at
both ends do.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.balances import groups_of
from mbds_xsim.checks.finding import Figures, check, side_by_side
from mbds_xsim.checks.flights import numbers, usual
from mbds_xsim.checks.ground import Push, pushes_of, responses
from mbds_xsim.checks.mismatch import MOMENT, Flow, winding_torque
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.stops import kicked
from mbds_xsim.scene.joint_space import BodyStates, joint_rate

_BEND = 0.5  # share of second differences: 1/12 in smooth motion, ½ for a jump in the frame
_SWING = 0.5  # share of the difference of accelerations at the ends: three times the cubic's error
_PATH = 0.5  # share of a velocity's changes by which its mean is off that of its ends
_POSE = 1.5  # times the responses at the reference pose, for bodies that joints move
_LASTING = 0.5  # factor on `_POSE` if the ground carries the weight steadily (0.02 would do)
_FLOOR = 1e-3  # share of the trajectory's largest speed, for solvers' tolerances
_LAG = 3.0  # turning bodies' places do not lag, and accelerations of both kinds may cancel
_METHOD = 5.0  # times second differences · (step/frame)²: a method's error, as in `kinematics`
_LATE = 0.5  # share of a frame; a delay of a whole one must show
_SYSTEMATIC = 0.5  # share of the allowance for bending, in the mean over a trajectory
_STEADY = 0.1  # share of the floor, in the same mean
_ERRORS = 4.0  # standard errors
_FAINT = 1e-12  # floor on the weighted sum of squared gains; anything smaller is rounding
_TINY = np.finfo(float).tiny


@check("displacement", 1.0)
def displacement(record: Record) -> Figures | None:
    """Measure how far displacements differ from velocities, over what is allowed; 1 is the limit.

    Every frame is checked for each body's place and turn, and for the centre of mass of each group
    that the ground alone supports. The whole trajectory is checked for the mean residual of each
    body (of turns in its own frame, too), and for the slope of residuals over accelerations, which
    is a delay. A body whose pose repeats exactly must be at rest. Without contacts, a trajectory
    that seems off is checked again, by the equations of motion.
    """
    if record.steps < 1:
        return None
    figures, note = (_of_many(record), "") if record.many else _of_few(record)
    doubted = np.flatnonzero(np.nan_to_num(figures).max(axis=(1, 2)) > 1.0).tolist()
    if doubted and not record.scene.contacts:
        batch, motion = record.batch[doubted], record.trajectory[doubted]
        again = dataclasses.replace(record, batch=batch, trajectory=motion, many=False)
        figures[doubted], _ = _of_few(again, _forced(again))
    return Figures(figures, _names(record), note)


def _of_few(record: Record, more: _Forced | None = None) -> tuple[Array, str]:
    """Compute the parts, with the effect of forces within frames if given, and a note."""
    parts = []
    place, turn = (_Residual.of(record, more, angular=kind) for kind in (False, True))
    for residual in (place, turn):
        share = rotation.norm(residual.difference) / residual.allowed
        parts += [_framed(share), record.at_end(residual.drift(residual.difference))]
    own = rotation.rotate(rotation.conjugate(record.bodies.native[:, :-1]), turn.difference)
    parts += [record.at_end(turn.drift(own)), record.at_end(_delay(place, turn)[:, None])]
    parts += [_of_group(record, push, place) for push in pushes_of(record)]
    figures = side_by_side(parts)
    figures[:, 0] = np.where(record.finite[:, :1], np.nan_to_num(figures[:, 0]), np.nan)
    allowed = np.nanmedian(turn.allowed) if record.finite[:, 1:].any() else np.nan
    return figures, f"turns are known to {allowed:.2g} rad/s in half of the frames"


def _names(record: Record) -> list[str]:
    """Return the names of the parts: those of every body, the delay, and those of groups."""
    kinds = ["place of {}", "mean place of {}", "turn of {}", "mean turn of {}"]
    kinds.append("mean turn of {} about its own axes")
    names = [kind.format(body.name) for kind in kinds for body in record.scene.bodies]
    groups = [f"centre of mass, {push.name}" for push in pushes_of(record)]
    return [*names, "delay of places", *groups]


def _of_many(record: Record) -> Array:
    """Compute the parts by compiled kernels."""
    # The kernels import a compiler, which takes long.
    from mbds_xsim.checks.displacement_kernel import STEP, Rule, displace
    from mbds_xsim.reference.compiled import lines

    share, late = (record.step or 0.0) / record.frame, record.lag / record.frame
    speed = record.frame * record.usual_pull
    rule = Rule(
        frame=record.frame,
        lag=late,
        bend=_BEND + min(_METHOD * share**2, _BEND),
        late=_LAG * abs(late),
        share=share,
        least=(speed, speed / record.scene.length),
        floor=_FLOOR,
        systematic=_SYSTEMATIC,
        errors=_ERRORS,
        steady=_STEADY,
        slope=_LATE,
        faint=_FAINT,
    )
    motion = record.motion
    figures = np.full((5 * motion.bodies + 1, motion.frames, motion.rows), np.nan)
    figures[:, 0] = 0.0
    displace(motion, rule, lines(STEP * record.steps), figures.reshape(-1))
    return np.asarray(figures.T)[: len(record.batch)]


@dataclass(frozen=True, eq=False)
class _Residual:
    """Mean velocities by displacements less those by recorded velocities, body by body."""

    difference: Array
    """Residual velocity [m/s] or [rad/s], shape (trajectory, step, body, 3)."""
    gain: Array
    """Change of the velocity over the step, same shape."""
    bend: Array
    """Allowance for velocities between frames without contact, (trajectory, step, body)."""
    allowed: Array
    """Whole allowance: `bend`, that for contact, and `floor`; same shape as `bend`."""
    floor: Array
    """Resolution, shape (trajectory, 1, 1)."""
    share: float
    """Share of a frame that a step takes, as errors of a method do not average out."""

    @staticmethod
    def of(record: Record, more: _Forced | None, *, angular: bool) -> _Residual:
        """Compare displacements with velocities, or turns with angular ones."""
        frame, share = record.frame, (record.step or 0.0) / record.frame
        velocity = record.bodies.angular_velocity if angular else record.bodies.velocity
        gained = np.diff(velocity, axis=1)
        change = _bending(gained)
        if more is not None:
            swing = more.turns if angular else more.places
            change = np.maximum(change, np.maximum(_SWING * swing, _unresolved(swing, gained)))
        bend = (_BEND + min(_METHOD * share**2, _BEND)) * change
        means = (velocity[:, 1:] + velocity[:, :-1]) / 2
        residual = _of_turns(record) if angular else record.moved / frame - means
        if record.lag:
            residual = residual + record.lag / frame * gained
            fastest = _window(rotation.norm(gained).max(axis=2, keepdims=True))
            bend = bend + _LAG * abs(record.lag) / frame * fastest
        repeats = _repeats(record)
        speed = np.nanmax(rotation.norm(velocity), axis=(1, 2), initial=0.0)
        least = frame * record.usual_pull * (1.0 / record.scene.length if angular else 1.0)
        floor = np.maximum(_FLOOR * np.maximum(speed, least)[:, None, None], _TINY)
        bend, hidden = (
            np.where(repeats, 0.0, each) for each in (bend, _hidden(record, more, angular))
        )
        return _Residual(residual, gained, bend, bend + hidden + floor, floor, share)

    @functools.cached_property
    def weight(self) -> Array:
        """Weight of each step in means, 0 where nothing is known, (trajectory, step, body)."""
        return np.where(np.isfinite(self.difference[..., 0]), 1.0 / self.allowed**2, 0.0)

    def along_gain(self, vectors: Array) -> Array:
        """Sum weighted products of vectors with gains over the bodies, (trajectory, step)."""
        return numbers(self.weight * rotation.dot(self.gain, vectors)).sum(axis=2)

    def drift(self, residual: Array) -> Array:
        """Return the weighted mean residual over its limit, (trajectory, body)."""
        share = self.weight / np.maximum(self.weight.sum(axis=1, keepdims=True), _TINY)
        residual, bends = numbers(residual), numbers(self.bend)
        mean = np.einsum("tsb,tsbi->tbi", share, residual)[:, None]
        scatter = share * rotation.norm(residual - mean)
        error = np.sqrt(np.einsum("tsb,tsb->tb", scatter, scatter))
        bend = np.einsum("tsb,tsb->tb", share, bends)
        limit = (
            (_SYSTEMATIC + self.share / 2) * bend
            + _ERRORS * error
            + (_STEADY + self.share) * self.floor[:, 0]
        )
        return rotation.norm(mean[:, 0]) / limit


class _Forced(NamedTuple):
    """Measures of the motion within steps, from the accelerations at both ends."""

    places: Array
    """Differences of linear accelerations between both ends, times the frame interval [m/s], shape
    (trajectory, step, body)."""
    turns: Array
    """The same for angular accelerations [rad/s]."""
    pull: Array
    """Accelerations that joints with limits would have without stops, the larger size of both ends
    [rad/s² or m/s²], shape (trajectory, step, joint)."""


def _forced(record: Record) -> _Forced:
    """Evaluate the equations of motion without contact at both ends of steps; 0 if not finite."""
    lost = ~record.finite[..., None, None]
    bodies = record.bodies.each(lambda values: np.where(lost, values[:, :1], values))
    torque = record.torque[:, : record.steps]
    spring_torque = winding_torque(record.mechanism, bodies)
    begin, end = (
        _accelerations(record, bodies[:, part], torque + spring_torque[:, part])
        for part in (slice(-1), slice(1, None))
    )
    places, turns = (
        record.frame * rotation.norm(a - b) for a, b in zip(begin[:2], end[:2], strict=True)
    )
    pull = np.maximum(np.abs(begin[2]), np.abs(end[2]))
    return _Forced(*(np.where(np.isfinite(each), each, 0.0) for each in (places, turns, pull)))


def _accelerations(record: Record, states: BodyStates, torque: Array) -> tuple[Array, Array, Array]:
    """Return linear and angular accelerations of bodies, and those of joints with limits."""
    flow = Flow(record.mechanism, MOMENT * record.frame)
    closed = flow.closed(states)
    pull, push = flow.accelerations(closed, record.force, torque)
    here, then = (each.with_world() for each in (closed, flow.later(closed, pull, push)))
    rates = np.zeros((*pull.shape[:2], len(record.mechanism.limited)))
    for k, joint in enumerate(record.mechanism.limited):
        rates[..., k] = (joint_rate(joint, then) - joint_rate(joint, here)) / flow.moment
    return pull, push, rates


def _of_turns(record: Record) -> Array:
    """Compare recorded turns with those that velocities give to third order (Magnus) [rad/s]."""
    spin, facing, frame = record.bodies.angular_velocity, record.bodies.native, record.frame
    begin, end = spin[:, :-1], spin[:, 1:]
    predicted = frame / 2 * (begin + end) - frame**2 / 12 * rotation.cross(begin, end)
    turned = rotation.multiply(facing[:, 1:], rotation.conjugate(facing[:, :-1]))
    back = rotation.multiply(rotation.from_vector(-predicted), turned)
    return rotation.to_vector(back) / frame


def _unresolved(swing: Array, gained: Array) -> Array:
    """Bound velocities hidden between frames that are too far apart, shape (trajectory, 1, body).

    Accelerations that change by their own size may be equal by chance at both ends of a frame. So
    every frame may hide the largest such change of the trajectory.
    """
    gain = usual(swing) / np.maximum(usual(rotation.norm(gained)), _TINY)
    return swing.max(axis=1, keepdims=True) * np.minimum(1.0, gain) ** 2


@functools.lru_cache(maxsize=1)
def _repeats(record: Record) -> Mask:
    """Return whether bodies keep their pose in steps to the last bit, (trajectory, step, body)."""
    # Component by component: reductions along a short axis are several times slower.
    parts = (
        part
        for values in (record.bodies.position, record.bodies.native)
        for part in np.moveaxis(values, -1, 0)
    )
    return functools.reduce(np.logical_and, (part[:, 1:] == part[:, :-1] for part in parts))


def _bending(gained: Array) -> Array:
    """Return the largest second differences of velocities around steps, (trajectory, step, body).

    At frames at the ends, where one neighbour is missing, they are extrapolated linearly.
    """
    inside = np.diff(gained, axis=1)
    sizes = np.zeros((len(gained), gained.shape[1] + 1, gained.shape[2]))
    sizes[:, 1:-1] = rotation.norm(inside)
    if inside.shape[1]:
        for end, near, next_ in ((0, 0, 1), (-1, -1, -2)):
            beyond = inside[:, next_ % inside.shape[1]]
            sizes[:, end] = rotation.norm(2.0 * inside[:, near] - beyond)
    window = _window(np.maximum(sizes[:, 1:], sizes[:, :-1]))
    # The first and last step, which lack a neighbour, take the next one's.
    extended = window.copy("K")
    for end, near in ((0, 1), (-1, -2)):
        extended[:, end] = np.maximum(window[:, end], window[:, near % window.shape[1]])
    return extended


def _window(values: Array) -> Array:
    """Return the largest value of each step and its two neighbours, (trajectory, step, body)."""
    highest = values.copy("K")
    np.maximum(values[:, 1:], values[:, :-1], out=highest[:, 1:])
    highest[:, :-1] = np.maximum(highest[:, :-1], values[:, 1:])
    return highest


def _hidden(record: Record, more: _Forced | None, angular: bool) -> Array:
    """Bound the effect of impulses on mean velocities of bodies, (trajectory, step, body)."""
    mechanism = record.mechanism
    bounds = np.zeros_like(record.bodies.position[:, 1:, :, 0])
    if mechanism.limited:
        bounds += _PATH * kicked(record, 0.0 if more is None else more.pull)[angular]
    bounds[_struck(record)] = np.inf  # impulses are unknown
    if not len(mechanism.sphere_body):
        return bounds
    response = responses(mechanism)[angular]
    for push in pushes_of(record):
        group = list(push.bodies)
        path = np.full(push.steady.shape, _PATH * np.hypot(1.0, record.ground.friction))
        if len(group) > 1:  # a single body's responses are exact
            path *= _POSE * np.where(push.steady, _LASTING, 1.0)
        most = response[push.spheres][:, group].max(axis=0)
        bounds[:, :, group] = (path * _upward(push))[..., None] * most
    return bounds


def _struck(record: Record) -> Mask:
    """Find bodies that impulses of unknown size may move in a step, (trajectory, step, body).

    They may collide, may touch the ground while something else supports them, too, or are joined to
    such bodies.
    """
    mechanism, struck = record.mechanism, np.zeros(record.moved.shape[:3], dtype=bool)
    groups = {body: list(group) for group in groups_of(mechanism) for body in group}
    for k, pair in enumerate(mechanism.sphere_body[mechanism.sphere_pairs].tolist()):
        met = ~record.parted[..., k]
        for body in (one for end in pair for one in groups[end]):
            struck[..., body] |= met
    known = {body for push in pushes_of(record) for body in push.bodies}
    for k, body in enumerate(mechanism.sphere_body.tolist()):
        if body not in known:
            struck[..., groups[body]] |= ~record.clear[..., k, None]
    return struck


def _upward(push: Push) -> Array:
    """Return the ground's upward impulse [N·s], 0 if no sphere may touch, (trajectory, step)."""
    reached = push.reach.any(axis=2) & (push.impulse[..., 2] > 0.0)
    return np.where(reached, push.impulse[..., 2], 0.0)


def _of_group(record: Record, push: Push, place: _Residual) -> Array:
    """Compute the residual of a group's centre of mass over its bound, (trajectory, frame, 1).

    The vertical impulse only grows, and horizontal changes add up to at most μ times as much. The
    bound is exact except for a lag, by which impulses of neighbouring steps belong to this one.
    """
    centre = push.middle(place.difference)
    gain = _upward(push)[..., None] / push.mass
    late = abs(record.lag) / record.frame * (_window(gain) + push.blur[..., None] / push.mass)
    sizes = np.stack([np.hypot(centre[..., 0], centre[..., 1]), np.abs(centre[..., 2])], axis=-1)
    limit = _PATH * gain * np.array([record.ground.friction, 1.0]) + late + place.floor
    return _framed((sizes / limit).max(axis=-1, keepdims=True))


def _delay(place: _Residual, turn: _Residual) -> Array:
    """Compute the slope of residuals over accelerations, over its limit, shape (trajectory,)."""
    squares = [each.along_gain(each.gain) for each in (place, turn)]
    products = [each.along_gain(each.difference) for each in (place, turn)]
    square = np.maximum(sum(each.sum(axis=1) for each in squares), _FAINT)
    slope = sum(each.sum(axis=1) for each in products) / square
    rests = [b - slope[:, None] * a for a, b in zip(squares, products, strict=True)]
    error = np.sqrt(sum(np.sum(rest**2, axis=1) for rest in rests)) / square
    return np.asarray(np.abs(slope) / (_LATE + _ERRORS * error))


def _framed(values: Array) -> Array:
    """Put a figure of each step at the frame at its end."""
    return np.pad(values, ((0, 0), (1, 0), (0, 0)))

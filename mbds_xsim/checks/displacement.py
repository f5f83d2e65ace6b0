"""Displacements and turns of every frame, in flight and in contact, within what velocities allow.

Over a frame H the mean velocity is the mean of the velocities at its ends but for what the velocity
does between them. In smooth motion that is H²/12 of its second derivative, which the second
differences of recorded velocities show. In contact it is what impulses do that come early or late:
a velocity that starts and ends where it is recorded, and whose changes in between add up to V, has
a mean within V/2 of the mean of its ends. The ground only pushes, and friction is within its cone,
so that V follows from the vertical impulse of the frame, which the momentum shows exactly. None of
this asks how often, or when, a contact was hit.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.balances import groups_of
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.flights import numbers, usual
from mbds_xsim.checks.forced import Forced, forced
from mbds_xsim.checks.ground import Push, pushes_of, responses
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.stops import kicked

_BEND = 0.5  # of second differences: 1/12 in smooth motion, ½ where a jump is anywhere in the frame
_SWING = 0.5  # of what accelerations at the ends differ by: three times what the cubic leaves
_PATH = 0.5  # of the changes of a velocity, by which its mean is off that of its ends
_POSE = 1.5  # times the responses at the reference pose, of bodies that joints move
_LASTING = 0.5  # of the same, where the ground carries the weight steadily (0.02 is needed)
_FLOOR = 1e-3  # of the largest speed of the trajectory: solvers' tolerances
_LAG = 3.0  # turning bodies' places do not lag, and accelerations of both kinds may cancel
_METHOD = (
    5.0  # of second differences, times (step/frame)²: a method's own error, as in `kinematics`
)
_LATE = 0.5  # of a frame; what is late by a whole one must show
_SYSTEMATIC = 0.5  # of the allowance for bending, in the mean over a trajectory
_STEADY = 0.1  # of the floor, in the same
_ERRORS = 4.0  # standard errors
_FAINT = 1e-12  # squares of gains over what is allowed, all together: less is rounding
_TINY = np.finfo(float).tiny


@check("displacement", 1.0)
def displacement(record: Record) -> Figures | None:
    """Measure how far a frame's places are off what its velocities allow; 1 is all they allow.

    Looked at are, in every frame, each body's place and turn, and the centre of mass of each group
    that the ground alone supports; over the trajectory, the mean of what is left of each body, in W
    and in its own frame, and its slope over the accelerations, which is a delay. A body whose pose
    repeats exactly must be at rest. What seems off is looked at again, by the equations of motion.
    """
    if record.steps < 1:
        return None
    found, note = (_of_many(record), "") if record.many else _of_few(record)
    doubted = np.flatnonzero(np.nan_to_num(found).max(axis=(1, 2)) > 1.0).tolist()
    if doubted and not record.scene.contacts:
        batch, motion = record.batch[doubted], record.trajectory[doubted]
        again = dataclasses.replace(record, batch=batch, trajectory=motion, many=False)
        found[doubted], _ = _of_few(again, forced(again))
    return Figures(found, _names(record), note)


def _of_few(record: Record, more: Forced | None = None) -> tuple[Array, str]:
    """Compute the parts, with what forces do within frames where that is asked; and a note."""
    parts = []
    place, turn = _Residual.of_places(record, more), _Residual.of_turns(record, more)
    for residual in (place, turn):
        parts += [residual.by_frame, residual.drift(residual.left)]
    own = rotation.rotate(rotation.conjugate(record.bodies.native[:, :-1]), turn.left)
    parts += [turn.drift(own), _delay(record, place, turn)]
    parts += [_of_group(record, push, place.left) for push in pushes_of(record)]
    found = record.by_frame([each[..., k] for each in parts for k in range(each.shape[-1])])
    found[:, 0] = np.where(record.finite[:, :1], np.nan_to_num(found[:, 0]), np.nan)
    allowed = np.nanmedian(turn.allowed) if record.finite[:, 1:].any() else np.nan
    return found, f"turns are known to {allowed:.2g} rad/s in half of the frames"


def _names(record: Record) -> list[str]:
    """Of the parts that every body has, of the delay, and of groups."""
    kinds = ["place of {}", "mean place of {}", "turn of {}", "mean turn of {}"]
    kinds.append("mean turn of {} about its own axes")
    names = [kind.format(body.name) for kind in kinds for body in record.scene.bodies]
    groups = [f"centre of mass, {push.name}" for push in pushes_of(record)]
    return [*names, "delay of places", *groups]


def _of_many(record: Record) -> Array:
    """Compute the same parts by compiled kernels."""
    # They are loaded by a compiler, which takes long to import.
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
    found = np.full((5 * motion.bodies + 1, motion.frames, motion.rows), np.nan)
    found[:, 0] = 0.0
    displace(motion, rule, lines(STEP * record.steps), found.reshape(-1))
    return np.asarray(found.T)[: len(record.batch)]


@dataclass(frozen=True, eq=False)
class _Residual:
    """Mean velocities of the frames less those of the recorded velocities, body by body."""

    left: Array
    """[m/s] or [rad/s], shape (trajectory, step, body, 3)."""
    gained: Array
    """Change of the velocity over the step, shape as left."""
    bend: Array
    """What velocities may do between frames without contact, shape (trajectory, step, body)."""
    hidden: Array
    """What contact may do besides, shape as bend."""
    floor: Array
    """Resolution, shape (trajectory, 1, 1)."""
    share: float
    """Of a frame that a step takes: what a method leaves does not average out."""

    @staticmethod
    def of_places(record: Record, more: Forced | None) -> _Residual:
        velocity = record.bodies.velocity
        mean = record.moved / record.frame
        left = mean - (velocity[:, 1:] + velocity[:, :-1]) / 2
        bend = None if more is None else more.places
        return _residual(record, left, velocity, 1.0, _hidden(record, more, False), bend)

    @staticmethod
    def of_turns(record: Record, more: Forced | None) -> _Residual:
        """Take the turn that velocities give, to third order (Magnus), back from the recorded."""
        spin, facing, frame = record.bodies.angular_velocity, record.bodies.native, record.frame
        begin, end = spin[:, :-1], spin[:, 1:]
        given = frame / 2 * (begin + end) - frame**2 / 12 * rotation.cross(begin, end)
        turned = rotation.multiply(facing[:, 1:], rotation.conjugate(facing[:, :-1]))
        back = rotation.multiply(rotation.from_vector(-given), turned)
        left = rotation.to_vector(back) / frame
        bend = None if more is None else more.turns
        hidden = _hidden(record, more, True)
        return _residual(record, left, spin, 1.0 / record.scene.length, hidden, bend)

    @functools.cached_property
    def allowed(self) -> Array:
        return self.bend + self.hidden + self.floor

    @property
    def by_frame(self) -> Array:
        """Left over allowed, shape (trajectory, frame, body)."""
        return _framed(rotation.norm(self.left) / self.allowed)

    @functools.cached_property
    def weight(self) -> Array:
        """Of each step in means, 0 where nothing is known, shape (trajectory, step, body)."""
        return np.where(np.isfinite(self.left[..., 0]), 1.0 / self.allowed**2, 0.0)

    def drift(self, left: Array) -> Array:
        """Weighted mean over the trajectory of what is left over what it may be, at its end."""
        known = np.isfinite(left[..., 0])
        share = self.weight / np.maximum(self.weight.sum(axis=1, keepdims=True), _TINY)
        left, bends = numbers(left), numbers(self.bend)
        mean = np.einsum("tsb,tsbi->tbi", share, left)[:, None]
        scatter = share * rotation.norm(left - mean)
        error = np.sqrt(np.einsum("tsb,tsb->tb", scatter, scatter))
        bend = np.einsum("tsb,tsb->tb", share, bends)
        limit = (
            (_SYSTEMATIC + self.share / 2) * bend
            + _ERRORS * error
            + (_STEADY + self.share) * self.floor[:, 0]
        )
        return _at_end(np.asarray(known.any(axis=2)), rotation.norm(mean[:, 0]) / limit)


def _residual(
    record: Record,
    left: Array,
    velocity: Array,
    per_length: float,
    hidden: Array,
    swung: Array | None,
) -> _Residual:
    gained = np.diff(velocity, axis=1)
    share = (record.step or 0.0) / record.frame
    own = min(_METHOD * share**2, _BEND)
    change = _second_differences(gained)
    change = _with_ends(_window(np.maximum(change[:, 1:], change[:, :-1])))
    if swung is not None:
        change = np.maximum(change, np.maximum(_SWING * swung, _unresolved(swung, gained)))
    bend = (_BEND + own) * change
    if record.lag:
        left = left + record.lag / record.frame * gained
        fastest = _window(rotation.norm(gained).max(axis=2, keepdims=True))
        bend = bend + _LAG * abs(record.lag) / record.frame * fastest
    repeats = _repeats(record)
    speed = np.nanmax(rotation.norm(velocity), axis=(1, 2), initial=0.0)
    least = record.frame * record.usual_pull * per_length
    floor = _FLOOR * np.maximum(speed, least)[:, None, None]
    return _Residual(
        left,
        gained,
        np.where(repeats, 0.0, bend),
        np.where(repeats, 0.0, hidden),
        np.maximum(floor, _TINY),
        share,
    )


def _unresolved(swung: Array, gained: Array) -> Array:
    """What frames too far apart hide of velocities, shape (trajectory, 1, body).

    Accelerations that change by as much as they are may be equal by chance at both ends of a frame:
    each may hide what they change by at most.
    """
    gain = usual(swung) / np.maximum(usual(rotation.norm(gained)), _TINY)
    return swung.max(axis=1, keepdims=True) * np.minimum(1.0, gain) ** 2


@functools.lru_cache(maxsize=1)
def _repeats(record: Record) -> Mask:
    """Whether bodies neither move nor turn in a step, to the last bit, (trajectory, step, body)."""
    return _same(record.bodies.position) & _same(record.bodies.native)


def _second_differences(gained: Array) -> Array:
    """Sizes of those of velocities at every frame, shape (trajectory, frame, body).

    Those of the ends go on as they change beside them: on one side the frames see nothing.
    """
    inside = np.diff(gained, axis=1)
    found = np.zeros((len(gained), gained.shape[1] + 1, gained.shape[2]))
    found[:, 1:-1] = rotation.norm(inside)
    if inside.shape[1]:
        for end, near, next_ in ((0, 0, 1), (-1, -1, -2)):
            beyond = inside[:, next_ % inside.shape[1]]
            found[:, end] = rotation.norm(2.0 * inside[:, near] - beyond)
    return found


def _same(values: Array) -> Mask:
    """Whether vectors repeat to the last bit, (trajectory, step, body)."""
    # Component by component: reductions along a short axis are several times slower.
    found = values[:, 1:, :, 0] == values[:, :-1, :, 0]
    for k in range(1, values.shape[-1]):
        found &= values[:, 1:, :, k] == values[:, :-1, :, k]
    return np.asarray(found)


def _window(values: Array) -> Array:
    """Largest of each step and its two neighbours, shape (trajectory, step, body)."""
    found = values.copy("K")
    np.maximum(values[:, 1:], values[:, :-1], out=found[:, 1:])
    found[:, :-1] = np.maximum(found[:, :-1], values[:, 1:])
    return found


def _with_ends(window: Array) -> Array:
    """Let the first and last step have their neighbour's window: on one side they see nothing."""
    found = window.copy("K")
    for end, inside in ((0, 1), (-1, -2)):
        found[:, end] = np.maximum(window[:, end], window[:, inside % window.shape[1]])
    return found


def _hidden(record: Record, more: Forced | None, angular: bool) -> Array:
    """What impulses may do to the mean velocities of bodies, (trajectory, step, body)."""
    mechanism = record.mechanism
    found = np.zeros_like(record.bodies.position[:, 1:, :, 0])
    if mechanism.limited:
        found += _PATH * kicked(record, 0.0 if more is None else more.pull)[angular]
    found[_struck(record)] = np.inf
    if not len(mechanism.sphere_body):
        return found
    moved = responses(mechanism)[angular]
    for push in pushes_of(record):
        group = list(push.bodies)
        path = np.full(push.steady.shape, _PATH * np.hypot(1.0, record.ground.friction))
        if len(group) > 1:  # a single body's responses are exact
            path *= _POSE * np.where(push.steady, _LASTING, 1.0)
        most = moved[push.spheres][:, group].max(axis=0)
        found[:, :, group] = (path * _upward(push))[..., None] * most
    return found


def _struck(record: Record) -> Mask:
    """Bodies that may collide in a step, or hang on such: how often is unknown; shape as bend."""
    mechanism, found = record.mechanism, np.zeros(record.moved.shape[:3], dtype=bool)
    groups = {body: list(group) for group in groups_of(mechanism) for body in group}
    for k, pair in enumerate(mechanism.sphere_body[mechanism.sphere_pairs].tolist()):
        met = ~record.parted[..., k]
        for body in (one for end in pair for one in groups[end]):
            found[..., body] |= met
    return found


def _upward(push: Push) -> Array:
    """Vertical impulse of the ground [N·s], where a sphere may touch, shape (trajectory, step)."""
    reached = push.reach.any(axis=2) & (push.impulse[..., 2] > 0.0)
    return np.where(reached, push.impulse[..., 2], 0.0)


def _of_group(record: Record, push: Push, left: Array) -> Array:
    """Residual of a group's centre of mass over its bound, shape (trajectory, frame, 2).

    Vertically the impulse only grows, horizontally its changes add up to μ times as much: exact but
    for a lag, by which impulses of neighbouring steps belong to this.
    """
    centre = push.middle(left)
    gain = _upward(push)[..., None] / push.mass
    late = abs(record.lag) / record.frame * (_window(gain) + push.blur[..., None] / push.mass)
    speed = np.nanmax(rotation.norm(record.bodies.velocity), axis=(1, 2), initial=0.0)
    floor = _FLOOR * np.maximum(speed, record.frame * record.usual_pull)[:, None, None]
    sizes = np.stack([np.hypot(centre[..., 0], centre[..., 1]), np.abs(centre[..., 2])], axis=-1)
    limit = _PATH * gain * np.array([record.ground.friction, 1.0]) + late + floor
    return _framed((sizes / limit).max(axis=-1, keepdims=True))


def _delay(record: Record, place: _Residual, turn: _Residual) -> Array:
    """Slope of the residuals over the accelerations, over what it may be, at the last frame."""
    known = record.finite[:, 1:] & record.finite[:, :-1]
    squares, products = (
        [
            numbers(each.weight * rotation.dot(each.gained, other)).sum(axis=2)
            for each, other in pairs
        ]
        for pairs in (
            [(place, place.gained), (turn, turn.gained)],
            [(place, place.left), (turn, turn.left)],
        )
    )
    square = np.maximum(sum(each.sum(axis=1) for each in squares), _FAINT)
    slope = sum(each.sum(axis=1) for each in products) / square
    rests = [b - slope[:, None] * a for a, b in zip(squares, products, strict=True)]
    error = np.sqrt(sum(np.sum(rest**2, axis=1) for rest in rests)) / square
    return _at_end(known, (np.abs(slope) / (_LATE + _ERRORS * error))[:, None])


def _framed(values: Array) -> Array:
    """Put a figure of each step at the frame at its end."""
    found = np.empty_like(values, shape=(len(values), values.shape[1] + 1, values.shape[2]))
    found[:, 0], found[:, 1:] = np.nan, values
    return found


def _at_end(known: Mask, values: Array) -> Array:
    """Put figures of trajectories at their last frames, (trajectory, frame, part)."""
    placed = np.full((len(known), known.shape[1] + 1, values.shape[1]), np.nan)
    placed[np.arange(len(known)), known.sum(axis=1)] = values
    return placed

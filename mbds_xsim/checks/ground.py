"""Impulses of the ground on groups of connected bodies, over steps and in single impacts.

An impact between two frames in flight is isolated by the scene's own equations: the frame before
is followed forwards, and the frame after backwards, to where the sphere touches the ground. The
change between the two states is the impact; its impulse follows from the momentum at the frames.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask, Picked
from mbds_xsim.checks.balances import balances_of, groups_of
from mbds_xsim.checks.coordinates import clear_of_own
from mbds_xsim.checks.mismatch import projected
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import Neighbours, Spheres, spheres_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

_CENTRED = 1e-9  # tolerance [m]
_SUPPORT = 2.0  # times the impulse of gravity, and the speed that it adds in a frame
_STEADY = 0.1  # share of the vertical speed that gravity adds in a frame


@dataclass(frozen=True, eq=False)
class Push:
    """Action of the ground on a group of connected bodies that nothing else supports."""

    name: str
    bodies: tuple[int, ...]
    spheres: Index
    """Indices of the group's contact spheres."""
    mass: float
    share: Array
    """Masses of the bodies over their sum, shape (body of the group,)."""
    weight: float
    """Impulse of gravity over a step, of the earth's in scenes without any [N·s]."""
    over: Spheres
    """Gaps and speeds of the group's spheres, shape (trajectory, frame, sphere of the group)."""
    ball: bool
    """Whether it is a single body with one sphere, around its centre of mass, so that normal and
    tangential motion do not mix."""
    impulse: Array
    """Impulse of the ground over each step [N·s], shape (trajectory, step, 3)."""
    blur: Array
    """Impulse that may belong to an adjacent step if velocities lag [N·s], (trajectory, step)."""
    reach: Mask
    """Spheres that may touch in a step, shape (trajectory, step, sphere of the group)."""
    steady: Mask
    """Steps in which the ground carries the weight, and nothing that may touch moves up or down;
    shape (trajectory, step)."""
    supported: Mask
    """Steps in contact without an impact that counts: the ground gives at most twice the impulse of
    gravity, and spheres that may touch move up or down at most twice as fast as gravity makes them
    in a frame; shape (trajectory, step)."""

    @functools.cached_property
    def resting(self) -> Mask:
        """Frames around which the ground carries the weight steadily, (trajectory, frame)."""
        padded = np.pad(self.steady, ((0, 0), (1, 1)), mode="edge")
        return np.asarray(padded[:, 1:] & padded[:, :-1])

    @property
    def untouched(self) -> Mask:
        """Frames in which no sphere of the group touches, shape (trajectory, frame)."""
        return np.asarray((self.over.gap > 0.0).all(axis=2))

    def middle(self, values: Array) -> Array:
        """Return the mean by mass over the group, of values of all bodies, shape (…, 3)."""
        return np.einsum("b,...bi->...i", self.share, values[..., list(self.bodies), :])


@functools.lru_cache(maxsize=1)
def pushes_of(record: Record) -> list[Push]:
    """Find the groups that have contact spheres and no other support, with the ground's action.

    The ground's impulse is the gain of momentum less the impulses of gravity and inputs, which is
    exact, as forces are held over steps. Bodies that collide with each other are one group.
    """
    mechanism = record.mechanism
    if record.scene.ground is None:
        return []
    groups = groups_of(mechanism, colliding=True)
    return [
        _push(record, balance.name.removeprefix("linear momentum, "), balance.bodies)
        for balance in balances_of(mechanism)
        if not balance.angular
        and len(balance.directions) == 3
        and balance.bodies in groups
        and np.isin(mechanism.sphere_body, balance.bodies).any()
    ]


def balls_of(record: Record) -> list[Push]:
    """Find the groups that are a single ball."""
    return [push for push in pushes_of(record) if push.ball]


def _push(record: Record, name: str, bodies: tuple[int, ...]) -> Push:
    mechanism, group = record.mechanism, list(bodies)
    mass, gravity, fall = mechanism.mass[group], np.array(record.scene.gravity), record.fall
    momentum = np.einsum("b,tfbi->tfi", mass, record.bodies.velocity[:, :, group])
    load = record.batch.force[:, : record.steps, group].sum(axis=2) + mass.sum() * gravity
    impulse = np.diff(momentum, axis=1) - record.frame * load
    change = np.linalg.norm(np.diff(load, axis=1, prepend=load[:, :1]), axis=-1)
    spheres = np.flatnonzero(np.isin(mechanism.sphere_body, group))
    reach, over = ~record.clear[:, :, spheres], record.spheres[:, :, spheres]
    climb, offset = np.abs(over.climb), np.abs(mechanism.sphere_offset[spheres])
    fastest = np.where(reach, np.maximum(climb[:, 1:], climb[:, :-1]), 0.0).max(axis=2)
    # From the top of a hop into the next impact both ends are slow, but the way between is not.
    mean = np.abs(np.diff(over.gap, axis=1)) / record.frame
    moving = np.maximum(fastest, np.where(reach, mean, 0.0).max(axis=2))
    lift = impulse[..., 2] / (mass.sum() * (fall or 1.0))
    supported = reach.any(axis=2) & (fastest <= _SUPPORT * fall) & (lift <= _SUPPORT)
    steady = supported & (moving <= _STEADY * fall) & (np.abs(lift - 1.0) <= 0.5)
    return Push(
        name=name,
        bodies=bodies,
        spheres=spheres,
        mass=float(mass.sum()),
        share=mass / mass.sum(),
        weight=float(mass.sum()) * (record.frame * record.usual_pull),
        over=over,
        ball=len(group) == len(spheres) == 1 and bool(offset.max() <= _CENTRED),
        impulse=impulse,
        blur=abs(record.lag) * change,
        reach=reach,
        steady=steady,
        supported=supported,
    )


def pushed(mechanism: Mechanism, bodies: BodyStates, sphere: Index) -> BodyStates:
    """Compute velocities that unit impulses on a sphere's lowest point give to bodies at rest.

    Impulses of joints follow from the least change of kinetic energy.

    Args:
        mechanism: Mechanism with the bodies.
        bodies: Poses of the bodies, shape (state, body, …).
        sphere: Index of the pushed sphere in each state.

    Returns:
        States with these velocities, for impulses along x, y and z, shape (state, 3, body, …).
    """
    each, axis = (k.ravel() for k in np.indices((len(sphere), 3)))
    row, body, states = np.arange(len(each)), mechanism.sphere_body[sphere][each], bodies[each]
    native, push = states.native[row, body], np.eye(3)[axis]
    arm = lowest(mechanism, native, sphere[each])
    turn = rotation.matrix(native)
    inertia = turn @ mechanism.inertia[body] @ np.swapaxes(turn, -1, -2)
    velocity, spin = np.zeros_like(states.velocity), np.zeros_like(states.velocity)
    velocity[row, body] = push / mechanism.mass[body, None]
    moment = rotation.cross(arm, push)
    spin[row, body] = np.linalg.solve(inertia, moment[..., None])[..., 0]
    joined = projected(mechanism, BodyStates(states.position, states.native, velocity, spin))
    shape = (len(sphere), 3, mechanism.body_count)
    return joined.each(lambda values: values.reshape(*shape, -1))


def lowest(mechanism: Mechanism, native: Array, sphere: Index) -> Array:
    """Return arms from centres of mass to spheres' lowest points [m], by bodies' rotations."""
    arm = rotation.rotate(native, mechanism.sphere_offset[sphere])
    arm[..., 2] -= mechanism.sphere_radius[sphere]
    return arm


@functools.lru_cache(maxsize=64)
def responses(mechanism: Mechanism) -> tuple[Array, Array]:
    """Return the largest velocities that unit impulses on spheres' lowest points give to bodies.

    They are largest over all directions of the impulse, at the reference pose. Linear [1/kg] and
    angular [1/(kg·m)], each (sphere, body).
    """
    spheres = np.arange(len(mechanism.sphere_body))
    pose = BodyStates.at_reference(mechanism)
    poses = pose.each(lambda values: np.repeat(values[None], len(spheres), axis=0))
    response = pushed(mechanism, poses, spheres)
    linear, angular = (
        np.linalg.norm(np.moveaxis(each, 1, -1), ord=2, axis=(-2, -1))
        for each in (response.velocity, response.angular_velocity)
    )
    return np.asarray(linear), np.asarray(angular)


_MOMENT = 1e-6  # half the interval of differences for accelerations [s]
_REFINEMENTS = 4  # iterations to the time of touch
_SUBSTEPS = 4  # Runge-Kutta steps to it
_APART = 0.5  # share of the flight after a rebound; a step with more time left has two impacts
SLOW = 3.0
"""Times what gravity and loads add in a frame; slower impacts show no restitution."""


@dataclass(frozen=True, eq=False)
class Impacts(Picked):
    """Impacts of one sphere each, one entry per impact."""

    row: Index
    step: Index
    sphere: Index
    before: BodyStates
    """States at the touch on arrival, shape (impact, body, …)."""
    after: BodyStates
    """States at the touch on leaving, same shape."""
    arriving: Array
    """Downward speed of the sphere [m/s]."""
    leaving: Array
    """Upward speed of the sphere [m/s]."""
    slip: Array
    """Slip on arrival: the lowest point's horizontal velocity [m/s], shape (impact, 2)."""
    rebound: Array
    """Slip on leaving [m/s], shape (impact, 2)."""
    duration: Array
    """Time from arrival to leaving [s], negative if the motions meet above the ground."""
    impulse: Array
    """Impulse of the ground [N·s], shape (impact, 3)."""
    gap: Array
    """Distance from the ground at which the two motions meet [m], negative below it."""


@functools.lru_cache(maxsize=4)
def fast_impacts_of(record: Record, push: Push) -> Impacts:
    """Find the single impacts that are fast enough to show restitution."""
    hits = impacts_of(record, push)
    loads = record.loads[hits.row, hits.step, record.mechanism.sphere_body[hits.sphere]]
    return hits[hits.arriving > SLOW * (record.fall + record.frame * loads)]


@functools.lru_cache(maxsize=4)
def impacts_of(record: Record, push: Push) -> Impacts:
    """Find the steps in which one sphere, and no other of its group, hits the ground once.

    No collision, dry friction or stop may act on the group in such a step.
    """
    free = push.untouched
    alone = (push.reach.sum(axis=2) == 1) & undisturbed(record, push)
    row, step = np.nonzero(free[:, 1:] & free[:, :-1] & alone & (push.impulse[..., 2] > 0.0))
    sphere = push.spheres[push.reach[row, step].argmax(axis=1)]

    def look(bodies: BodyStates) -> Spheres:
        return one_sphere(record, bodies, sphere)

    arrival, before, falling = at_touch(record, row, step, step, look)
    parting, after, rising = at_touch(record, row, step, step + 1, look)
    pull = record.pull or np.finfo(float).tiny
    duration = record.frame - falling + rising
    arriving, leaving = -before.climb, after.climb
    single = (arriving > 0.0) & (leaving > 0.0) & (falling >= 0.0) & (rising <= 0.0)
    single &= duration < np.maximum(_APART * 2.0 * leaving / pull, 0.1 * record.frame)
    slips, impulse = (before.slip, after.slip), push.impulse[row, step]
    gap = -duration / (1.0 / arriving + 1.0 / leaving)
    hits = Impacts(
        row, step, sphere, arrival, parting, arriving, leaving, *slips, duration, impulse, gap
    )
    return hits[single]


def undisturbed(record: Record, push: Push) -> Mask:
    """Find steps in which no bodies of a group may collide and no joint rubs or meets a stop.

    Shape (trajectory, step).
    """
    mechanism, group = record.mechanism, {*push.bodies}
    rubs = any(group & {joint.parent, joint.child} for joint in mechanism.frictional)
    undisturbed = np.full(push.steady.shape, not rubs)
    for joint in mechanism.limited:
        if group & {joint.parent, joint.child}:
            undisturbed &= clear_of_own(record, joint)
    inside = np.isin(mechanism.sphere_pairs, push.spheres).all(axis=1)
    return undisturbed & record.parted[:, :, inside].all(axis=2) if inside.any() else undisturbed


_Touch = TypeVar("_Touch", Spheres, Neighbours)


def at_touch(
    record: Record, row: Index, step: Index, frame: Index, look: Callable[[BodyStates], _Touch]
) -> tuple[BodyStates, _Touch, Array]:
    """Follow frames to a touch; return the bodies and what touches there, and the time to it [s].

    It goes forwards from a step's first frame, backwards from its last; the time is NaN if nothing
    touches. `look` returns what touches in states of shape (touch, body, …).
    """
    bodies = record.bodies[row, frame]
    force, torque = record.batch.force[row, step], record.torque[row, step]
    sense = np.where(frame > step, -1.0, 1.0)
    time, limit = np.zeros(len(row)), 1.5 * record.frame
    there, here, bend = bodies, look(bodies), np.full(len(row), -record.pull)
    for _ in range(_REFINEMENTS + 1):
        # A parabola's root, as Newton's steps would only halve the way to a grazing touch.
        speed = sense * here.climb
        root = np.sqrt(np.maximum(speed**2 - 2.0 * bend * here.gap, 0.0))
        before, climb = time, here.climb
        time = np.clip(time + sense * 2.0 * here.gap / (root - speed), -limit, limit)
        there = followed(record, bodies, force, torque, time)
        here = look(there)
        np.divide(here.climb - climb, time - before, out=bend, where=time != before)
    reached = (np.abs(time) <= record.frame) & (np.abs(here.gap) < 1e-6 * record.scene.length)
    return there, here, np.where(reached, time, np.nan)


def one_sphere(record: Record, bodies: BodyStates, sphere: Index) -> Spheres:
    """Return gap and speeds of one sphere in each state."""
    return spheres_of(record.mechanism, bodies)[np.arange(len(sphere)), sphere]


def free_acceleration(
    record: Record, row: Index, step: Index, sphere: Index, bodies: BodyStates
) -> Array:
    """Compute spheres' lowest points' accelerations without the ground [m/s²], (impact, 3)."""
    force, torque = record.batch.force[row, step], record.torque[row, step]
    ends = []
    for moment in (-_MOMENT, _MOMENT):
        there = followed(record, bodies, force, torque, np.full(len(row), moment))
        point = one_sphere(record, there, sphere)
        ends.append(np.column_stack([point.slip, point.climb]))
    return np.asarray((ends[1] - ends[0]) / (2.0 * _MOMENT))


def followed(
    record: Record, bodies: BodyStates, force: Array, torque: Array, time: Array
) -> BodyStates:
    """Integrate states without contact by Runge-Kutta steps, each over its own time [s]."""
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.equations import dynamics_of

    if not len(time):
        return bodies
    dynamics = dynamics_of(record.mechanism)
    state, h = dynamics.pack(bodies), (time / _SUBSTEPS)[:, None, None]
    for _ in range(_SUBSTEPS):
        a = dynamics.derivative(state, force, torque)
        b = dynamics.derivative(state + h / 2 * a, force, torque)
        c = dynamics.derivative(state + h / 2 * b, force, torque)
        d = dynamics.derivative(state + h * c, force, torque)
        state = state + h / 6 * (a + 2 * b + 2 * c + d)
    return dynamics.unpack(state)

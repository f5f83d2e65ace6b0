"""What the ground gives to groups of connected bodies: impulses in steps, and single impacts.

An impact between two frames in flight is taken apart by the scene's own motion: the frame before
is followed forwards, and the frame after backwards, to where the sphere touches the ground. What
lies between the two states is the impact: its impulse is the one that the momentum of the frames
shows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.checks.balances import balances_of, groups_of
from mbds_xsim.checks.coordinates import clear_of_own
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.spheres import Neighbours, Spheres, spheres_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism

_CENTRED = 1e-9  # [m]
_SUPPORT = 2.0  # times the impulse of gravity
_STEADY = 0.1  # of it, in vertical speed


@dataclass(frozen=True, eq=False)
class Push:
    """What the ground does to a group of connected bodies that nothing else supports."""

    name: str
    bodies: tuple[int, ...]
    spheres: Index
    """Which contact spheres the group has."""
    mass: float
    share: Array
    """Masses of the bodies over that of all, shape (body of the group,)."""
    weight: float
    """Impulse of gravity over a step [N·s]."""
    over: Spheres
    """The group's spheres, shape (trajectory, frame, sphere of the group)."""
    ball: bool
    """A single body with one sphere, around its centre of mass: normal and tangential motion do
    not mix."""
    impulse: Array
    """Of the ground over each step [N·s], shape (trajectory, step, 3)."""
    blur: Array
    """What of it may belong to a neighbouring step, where velocities lag [N·s], (trajectory, step).
    """
    reach: Mask
    """Spheres that may touch in a step, shape (trajectory, step, sphere of the group)."""
    steady: Mask
    """Steps in which the ground carries the weight, and nothing that may touch moves up or down;
    shape (trajectory, step)."""
    supported: Mask
    """Steps with no impact that counts: the ground gives no more than twice what gravity takes, and
    spheres that may touch are slower than gravity would make them; shape (trajectory, step)."""

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
        """Mean over the group's bodies by mass, of values of all bodies, shape (…, 3)."""
        return np.einsum("b,...bi->...i", self.share, values[..., list(self.bodies), :])


@functools.lru_cache(maxsize=1)
def pushes_of(record: Record) -> list[Push]:
    """Find what the ground does to each group that has contact spheres and no other support.

    Linear momentum less the impulses of gravity and inputs: exact, as forces are held over steps.
    Bodies that collide with each other are one group.
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
    reach, over = ~record.clear[:, :, spheres], record.spheres.of(spheres)
    climb = np.abs(over.climb)
    fastest = np.where(reach, np.maximum(climb[:, 1:], climb[:, :-1]), 0.0).max(axis=2)
    # From the top of a hop into the next impact both ends are slow, and the way between is not.
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
        weight=float(mass.sum()) * fall,
        over=over,
        ball=_is_ball(mechanism, bodies, spheres),
        impulse=impulse,
        blur=abs(record.lag) * change,
        reach=reach,
        steady=steady,
        supported=supported,
    )


def _is_ball(mechanism: Mechanism, bodies: tuple[int, ...], spheres: Index) -> bool:
    offset = mechanism.sphere_offset[spheres]
    return len(bodies) == len(spheres) == 1 and bool(np.abs(offset).max() <= _CENTRED)


def pushed(mechanism: Mechanism, bodies: BodyStates, sphere: Index) -> BodyStates:
    """Give the velocities that unit impulses on a sphere's lowest point make of bodies at rest.

    Joints share in an impulse by the least change of kinetic energy.

    Args:
        mechanism: Whose bodies.
        bodies: Where they are, shape (state, body, …).
        sphere: The one that is pushed in each state.

    Returns:
        States with these velocities, of impulses along x, y and z, shape (state, 3, body, …).
    """
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.equations import dynamics_of

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
    dynamics = dynamics_of(mechanism)
    start = dynamics.pack(BodyStates(states.position, states.native, velocity, spin))
    found = dynamics.unpack(dynamics.project(start))
    shape = (len(sphere), 3, mechanism.body_count)
    return found.each(lambda values: values.reshape(*shape, -1))


def lowest(mechanism: Mechanism, native: Array, sphere: Index) -> Array:
    """Arms from centres of mass to the lowest points of spheres [m], by the bodies' turns."""
    arm = rotation.rotate(native, mechanism.sphere_offset[sphere])
    arm[..., 2] -= mechanism.sphere_radius[sphere]
    return arm


@functools.lru_cache(maxsize=64)
def responses(mechanism: Mechanism) -> tuple[Array, Array]:
    """Largest velocities that a unit impulse on a sphere's lowest point gives to each body.

    Over all directions of the impulse, at the reference pose. Linear [1/kg] and angular
    [1/(kg·m)], each (sphere, body).
    """
    shape = (len(mechanism.sphere_body), mechanism.body_count)
    place = np.broadcast_to(mechanism.com, (*shape, 3))
    still = np.broadcast_to(rotation.IDENTITY, (*shape, 4))
    pose = BodyStates(place, still, np.zeros_like(place), np.zeros_like(place))
    given = pushed(mechanism, pose, np.arange(shape[0]))
    linear, angular = (
        np.linalg.norm(np.moveaxis(each, 1, -1), ord=2, axis=(-2, -1))
        for each in (given.velocity, given.angular_velocity)
    )
    return np.asarray(linear), np.asarray(angular)


_REFINEMENTS = 4  # Newton's steps to the time of touch
_SUBSTEPS = 4  # of Runge and Kutta to it
_APART = 0.5  # of the flight that follows a rebound: a step with so much time left has two impacts
_SLOW = 3.0  # times what gravity and loads add in a frame: slower ones tell no restitution


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts of one sphere each, one entry an impact."""

    row: Index
    step: Index
    sphere: Index
    before: BodyStates
    """At the touch on arrival, shape (impact, body, …)."""
    after: BodyStates
    """At the touch on leaving."""
    arriving: Array
    """Downward speed of the sphere [m/s]."""
    leaving: Array
    """Upward speed [m/s]."""
    slip: Array
    """Horizontal velocity of the sphere's lowest point on arrival [m/s], shape (impact, 2)."""
    rebound: Array
    """The same on leaving."""
    duration: Array
    """From arrival to leaving, negative where the motions meet above the ground [s]."""
    impulse: Array
    """Of the ground [N·s], shape (impact, 3)."""
    gap: Array
    """Between sphere and ground where the two motions meet, negative below it [m]."""

    def __getitem__(self, picks: Mask) -> Impacts:
        """Take some of the impacts."""
        return Impacts(**{key: value[picks] for key, value in vars(self).items()})


@check("restitution", "restitution")
def restitution(record: Record) -> Figures | None:
    """Compare the delivered with the scene's coefficient of restitution; None without balls.

    Only for spheres around centres of mass, whose rebound nothing else has a part in.
    """
    pushes = balls_of(record)
    if not pushes:
        return None
    wanted = record.ground.restitution
    found = [fast_impacts_of(record, push) for push in pushes]
    ratios = [hits.leaving / hits.arriving for hits in found]
    off = [(h.row, h.step, np.abs(r - wanted)) for h, r in zip(found, ratios, strict=True)]
    note = told_restitution(np.concatenate(ratios).tolist(), wanted)
    return Figures(at_impacts(record, off), [push.name for push in pushes], note)


def at_impacts(record: Record, groups: Sequence[tuple[Index, Index, Array]]) -> Array:
    """Put values of impacts, by row and step, at the frames after, (trajectory, frame, group)."""
    parts = np.full((*record.finite.shape, len(groups)), np.nan)
    parts[:, 0] = 0.0  # not every trajectory bounces
    for k, (row, step, values) in enumerate(groups):
        parts[row, step + 1, k] = values
    return parts


def told_restitution(ratios: list[float], wanted: float) -> str:
    """Say which coefficients were delivered."""
    if not ratios:
        return f"no impact that tells it, the scene has {wanted:.4f}"
    told = f"{min(ratios):.4f} to {max(ratios):.4f} delivered, median {np.median(ratios):.4f}"
    return f"{told}, the scene has {wanted:.4f}"


@functools.lru_cache(maxsize=4)
def fast_impacts_of(record: Record, push: Push) -> Impacts:
    """Find the single impacts that are a measure of restitution."""
    hits = impacts_of(record, push)
    loads = record.loads[hits.row, hits.step, record.mechanism.sphere_body[hits.sphere]]
    return hits[hits.arriving > _SLOW * (record.fall + record.frame * loads)]


@functools.lru_cache(maxsize=4)
def impacts_of(record: Record, push: Push) -> Impacts:
    """Find the steps in which one sphere, and no other of its group, hits the ground once.

    And nothing but the ground pushes the group's bodies that motions without it would not have.
    """
    free = push.untouched
    alone = (push.reach.sum(axis=2) == 1) & _undisturbed(record, push)
    row, step = np.nonzero(free[:, 1:] & free[:, :-1] & alone & (push.impulse[..., 2] > 0.0))
    sphere = push.spheres[push.reach[row, step].argmax(axis=1)]

    def look(bodies: BodyStates) -> Spheres:
        return one_sphere(record, bodies, sphere)

    arrival, before, falling = at_touch(record, row, step, step, look)
    parting, after, rising = at_touch(record, row, step, step + 1, look)
    pull = record.pull or np.finfo(float).tiny
    left = record.frame - falling + rising
    arriving, leaving = -before.climb, after.climb
    single = (arriving > 0.0) & (leaving > 0.0) & (falling >= 0.0) & (rising <= 0.0)
    single &= left < np.maximum(_APART * 2.0 * leaving / pull, 0.1 * record.frame)
    return Impacts(
        row=row[single],
        step=step[single],
        sphere=sphere[single],
        before=arrival[single],
        after=parting[single],
        arriving=arriving[single],
        leaving=leaving[single],
        slip=before.slip[single],
        rebound=after.slip[single],
        duration=left[single],
        impulse=push.impulse[row, step][single],
        gap=(-left / (1.0 / arriving + 1.0 / leaving))[single],
    )


def _undisturbed(record: Record, push: Push) -> Mask:
    """Steps in which no bodies of a group may collide, and no joint of it rubs or meets a stop.

    Shape (trajectory, step).
    """
    mechanism, group = record.mechanism, {*push.bodies}
    rubs = any(group & {joint.parent, joint.child} for joint in mechanism.frictional)
    found = np.full(push.steady.shape, not rubs)
    for joint in mechanism.limited:
        if group & {joint.parent, joint.child}:
            found &= clear_of_own(joint, record.world, record.frame)
    inside = np.isin(mechanism.sphere_pairs, push.spheres).all(axis=1)
    return found & record.parted[:, :, inside].all(axis=2) if inside.any() else found


_Touch = TypeVar("_Touch", Spheres, Neighbours)


def at_touch(
    record: Record, row: Index, step: Index, frame: Index, look: Callable[[BodyStates], _Touch]
) -> tuple[BodyStates, _Touch, Array]:
    """Follow frames to a touch: the bodies and what touches there, and the time to it [s].

    Forwards from the step's first frame, backwards from its last; NaN where it stays clear. `look`
    gives what touches of states with shape (touch, body, …).
    """
    bodies = record.bodies[row, frame]
    force, torque = record.batch.force[row, step], record.torque[row, step]
    sense = np.where(frame > step, -1.0, 1.0)
    time, limit = np.zeros(len(row)), 1.5 * record.frame
    there, here, bend = bodies, look(bodies), np.full(len(row), -record.pull)
    for _ in range(_REFINEMENTS + 1):
        # A parabola's root, which Newton's steps to a glance would only halve the way to.
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
    """Look at one sphere of each state."""
    spheres, each = spheres_of(record.mechanism, bodies), np.arange(len(sphere))
    return Spheres(*(values[each, sphere] for values in vars(spheres).values()))


def followed(
    record: Record, bodies: BodyStates, force: Array, torque: Array, time: Array
) -> BodyStates:
    """Follow states without contact by Runge and Kutta's method, each over its own time [s]."""
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

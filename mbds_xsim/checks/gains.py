"""Impulse, moment and spin of wheels that the ground gives a group of bodies in each step.

All vectors are in axes that turn about the vertical with the group's heaviest body, at the mean
rate of the step. Coulomb's cone is the same in these axes. Under a body that turns on the spot,
such as a car, contacts stay in place in them and slips keep their direction. Joints drop out: their
impulses act between bodies of one group, so they change neither its total momentum nor the spin of
a body of revolution about its axle.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.ground import Push, impacts_of
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mass import of_revolution
from mbds_xsim.scene.mechanism import Mechanism

_EVEN = 1e-9  # relative tolerance of moments of inertia; also of lengths [m]
# Multiple of the lag times the gyroscopic moment's change; tumbling cars need up to 4.
_REEL = 6.0
_UP: Array = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Axle:
    """Hinge along the axis of a body of revolution, its only joint, that collides with no body."""

    name: str
    body: int
    hinge: int
    """Index among the hinges."""
    sign: float
    """Sign of the hinge's torque on the body: −1 if the body is the parent."""
    moment: float
    """Moment of inertia about the axle [kg·m²]."""
    axis: Array
    """Direction in the body's native frame, shape (3,)."""
    sphere: int | None
    """Index of the body's contact sphere within the group; None if it has none."""
    radius: float
    """Radius of the sphere [m], 0 without one."""


@dataclass(frozen=True, eq=False)
class Gains:
    """Momentum that the ground gives a group in each step; axes are (trajectory, step, …)."""

    linear: Array
    """Impulse [N·s], (…, 3)."""
    angular: Array
    """Moment of the impulse about the centre of mass [N·m·s], (…, 3)."""
    arm: Array
    """Vectors from the centre of mass to the spheres' lowest points [m], (…, sphere, 3)."""
    vague: Array
    """Uncertainty of the moment per unit impulse, from motion within the step [m], (…)."""
    blur: Array
    """Uncertainty of the moment from the lag of velocities [N·m·s], (…)."""
    spin: Array
    """Spin gained by bodies on axles, less the impulses of hinges [N·m·s], (…, axle)."""
    lever: Array
    """Moment about the axle of an impulse of 1 N·s at the body's sphere [m], (…, axle, 3)."""
    slips: tuple[Array, Array]
    """Velocities of the spheres' lowest points at the step's two ends [m/s], (…, sphere, 3)."""
    touches: Mask
    """Spheres that may touch in the step, (…, sphere)."""


@functools.lru_cache(maxsize=4)
def gains_of(record: Record, push: Push) -> Gains:
    """Compute the gains of a group from its momenta, inputs and gravity."""
    mechanism, states = record.mechanism, record.bodies
    heaviest = max(push.bodies, key=lambda body: float(mechanism.mass[body]))
    native = states.native[:, :, heaviest]
    hits = impacts_of(record, push)
    turn = _turned(native[:, :-1], native[:, 1:])
    # A single impact happens at one instant, so its axes do not turn.
    turn[hits.row, hits.step] = 0.0
    turn[~push.reach.any(axis=2)] = 0.0
    # Nor do those of a ball, whose contact stays below its centre while it spins.
    if len(push.bodies) == 1 and np.abs(mechanism.sphere_offset[push.spheres]).max() <= _EVEN:
        turn[:] = 0.0
    half = turn / 2
    begin, end = _both(half, _arms(mechanism, states, push))
    arm = (begin + end) / 2
    spin, lever, veer = _spins(record, push, half)
    rates = _both(half, _rates(mechanism, states, push))
    # Largest distance of an arm from its mean: at the ends, and where its path bends in between.
    strays = rotation.norm(end - begin) / 2 + record.frame / 4 * rotation.norm(rates[1] - rates[0])
    vague = np.where(push.reach, strays, 0.0).max(axis=2) + veer
    touches = push.reach.copy()
    single = push.spheres == hits.sphere[:, None]
    before, after = (_arms(mechanism, part, push) for part in (hits.before, hits.after))
    touches[hits.row, hits.step] = single
    arm[hits.row, hits.step] = (before + after) / 2
    # A soft contact pushes most in the middle of its duration.
    moved = np.where(single, rotation.norm(after - before), 0.0).max(axis=1)
    vague[hits.row, hits.step] = moved / 4
    # If velocities lag, impulses of one step act at places of the step before.
    speed = np.maximum(
        *(np.where(push.reach, rotation.norm(part), 0.0).max(axis=2) for part in rates)
    )
    vague += 2.0 * abs(record.lag) * speed
    rate = states.angular_velocity[:, :-1, heaviest]
    reel = rotation.norm(rate) * np.hypot(rate[..., 0], rate[..., 1])
    angular, size = _angular(record, push, half)
    return Gains(
        linear=_linear(record, push, half),
        angular=angular,
        arm=arm,
        vague=vague,
        blur=_REEL * abs(record.lag) * record.frame * reel * size,
        spin=spin,
        lever=lever,
        slips=_both(half, np.pad(push.over.slip, (*((0, 0),) * 3, (0, 1)))),
        touches=touches,
    )


def axles_of(mechanism: Mechanism, push: Push) -> list[Axle]:
    """Find the group's bodies of revolution on axles."""
    axles = (_axle_of(mechanism, push, body) for body in push.bodies)
    return [axle for axle in axles if axle is not None]


def _axle_of(mechanism: Mechanism, push: Push, body: int) -> Axle | None:
    joints = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    tied = any(body in pair.bodies for pair in (*mechanism.distances, *mechanism.springs))
    tied = tied or any(joint.is_loaded for joint in joints)
    tied = tied or body in mechanism.sphere_body[mechanism.sphere_pairs]
    spheres = np.flatnonzero(mechanism.sphere_body[push.spheres] == body)
    if tied or len(joints) != 1 or joints[0].kind != "hinge" or len(spheres) > 1:
        return None
    joint, inertia = joints[0], mechanism.inertia[body]
    anchor = joint.in_child if joint.child == body else joint.in_parent
    moment, _, uneven = of_revolution(inertia, joint.axis)
    centres = [anchor, *mechanism.sphere_offset[push.spheres[spheres]]]
    off = max(float(np.linalg.norm(np.cross(joint.axis, point))) for point in centres)
    if off > _EVEN or uneven > _EVEN * moment:
        return None
    return Axle(
        name=joint.name,
        body=body,
        hinge=mechanism.hinges.index(joint),
        sign=1.0 if joint.child == body else -1.0,
        moment=moment,
        axis=joint.axis,
        sphere=int(spheres[0]) if len(spheres) else None,
        radius=float(mechanism.sphere_radius[push.spheres[spheres[0]]]) if len(spheres) else 0.0,
    )


def spin_gain(record: Record, axle: Axle) -> Array:
    """Compute spin gained about an axle, less the hinge's impulse, (trajectory, step)."""
    axis = rotation.rotate(record.bodies.native[:, :, axle.body], axle.axis)
    own = axle.moment * rotation.dot(axis, record.bodies.angular_velocity[:, :, axle.body])
    drive = axle.sign * record.batch.torque[:, : record.steps, axle.hinge] * record.frame
    return np.asarray(np.diff(own, axis=1) - drive)


def _spins(record: Record, push: Push, half: Array) -> tuple[Array, Array, Array]:
    """Return spins gained by axles, levers of their spheres, and how far the levers veer.

    I Δω about the axle is exact: only the hinge and the ground have a moment about it.
    """
    axles = axles_of(record.mechanism, push)
    spin, lever = np.zeros((*half.shape, len(axles))), np.zeros((*half.shape, len(axles), 3))
    veer = np.zeros(half.shape)
    for k, axle in enumerate(axles):
        spin[..., k] = spin_gain(record, axle)
        axis = rotation.rotate(record.bodies.native[:, :, axle.body], axle.axis)
        begin, end = _both(half, axis)
        # axis · (−R ẑ × P)
        lever[..., k, :] = axle.radius * rotation.cross(_UP, (begin + end) / 2)
        veer = np.maximum(veer, axle.radius * rotation.norm(end - begin) / 2)
    return spin, lever, veer


def _linear(record: Record, push: Push, half: Array) -> Array:
    group = list(push.bodies)
    place, speed = push.middle(record.bodies.position), push.middle(record.bodies.velocity)
    frame, rate = record.frame, (2.0 * half / record.frame)[..., None]
    middle = (place[:, 1:] + place[:, :-1]) / 2
    x = _about(half, place[:, :-1] - middle), _about(-half, place[:, 1:] - middle)
    v = _both(half, speed)
    moving = [b - rate * rotation.cross(_UP, a) for a, b in zip(x, v, strict=True)]
    mean = frame / 2 * (x[0] + x[1]) + frame**2 / 12 * (moving[0] - moving[1])
    travel = x[1] - x[0] + rate * rotation.cross(_UP, mean)
    load = record.batch.force[:, : record.steps, group].sum(axis=2)
    impulse = frame * _mean_load(load + push.mass * np.array(record.scene.gravity), half)
    return np.asarray(push.mass * (v[1] - v[0] + rate * rotation.cross(_UP, travel)) - impulse)


def _angular(record: Record, push: Push, half: Array) -> tuple[Array, Array]:
    """Return each step's angular impulse about the centre of mass [N·m·s], (trajectory, step, 3).

    The second result is the size of the angular momentum when the step begins.
    """
    group, states = list(push.bodies), record.bodies
    mass = record.mechanism.mass[group]
    place, speed = (
        values[:, :, group] - push.middle(values)[:, :, None]
        for values in (states.position, states.velocity)
    )
    own = rotation.rotate(states.native[:, :, group], record.turning[:, :, group])
    whole = (own + rotation.cross(place, mass[:, None] * speed)).sum(axis=2)
    begin, end = _both(half, whole)
    arm = np.add(*_both(half, place))
    load = _mean_load(record.batch.force[:, : record.steps, group], half[..., None])
    impulse = record.frame / 2 * rotation.cross(arm, load).sum(axis=2)
    gain = end - begin + half[..., None] * rotation.cross(_UP, begin + end) - impulse
    return gain, rotation.norm(begin)


def _arms(mechanism: Mechanism, states: BodyStates, push: Push) -> Array:
    """Return vectors from the centre of mass to the spheres' lowest points, (…, sphere, 3)."""
    own = push.spheres
    centre = states.points(mechanism.sphere_body[own], mechanism.sphere_offset[own])
    low = mechanism.sphere_radius[own, None] * _UP
    return np.asarray(centre - push.middle(states.position)[..., None, :] - low)


def _rates(mechanism: Mechanism, states: BodyStates, push: Push) -> Array:
    """Return the rates of the arms [m/s]."""
    own = push.spheres
    speed = states.speeds(mechanism.sphere_body[own], mechanism.sphere_offset[own])
    return np.asarray(speed - push.middle(states.velocity)[..., None, :])


def _turned(begin: Array, end: Array) -> Array:
    """Return the angle about the vertical between two rotations, by swing-twist decomposition."""
    change = rotation.multiply(end, rotation.conjugate(begin))
    return (
        np.asarray(2.0 * np.arctan2(change[..., 3], change[..., 0]) + np.pi) % (2 * np.pi) - np.pi
    )


def _about(angle: Array, vectors: Array) -> Array:
    """Turn vectors about the vertical."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, vectors[..., 2]], axis=-1)


def _both(half: Array, vectors: Array) -> tuple[Array, Array]:
    """Return vectors (trajectory, frame, …, 3) at both ends of each step, in its turning axes."""
    angle = half.reshape(*half.shape, *(1,) * (vectors.ndim - 3))
    return _about(angle, vectors[:, :-1]), _about(-angle, vectors[:, 1:])


def _mean_load(load: Array, half: Array) -> Array:
    """Return the mean over a step, in the turning axes, of loads held in W."""
    level = np.sinc(half / np.pi)[..., None]
    return np.asarray(load * np.concatenate([level, level, np.ones_like(level)], axis=-1))

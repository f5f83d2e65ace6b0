"""Is every frame valid: finite numbers, unit quaternions, the drawn start, closed joints?"""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.coordinates import coupling_errors
from mbds_xsim.checks.finding import Figures, check, side_by_side
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates, select_bodies
from mbds_xsim.scene.mechanism import PlacedJoint, PointPair
from mbds_xsim.scene.state import STATES
from mbds_xsim.simulate import rounding

_UNIT = 1e-9
_SAME_START = 1e-12
_FAR = 16 * 2.0**-53 / _SAME_START
"""Share of the distance from the origin that counts as an arm of rates: engines that compute
velocities there round them by 16 units of rate times distance."""
_SINGLE = (1 << 29) - 1
"""Bits of a float64's significand that are 0 if a float32 has the same value."""
_ROUND = (1 << 37) - 1
"""Bits that are 0 if 16 significant bits suffice, as in numbers such as 0.5."""
_FEW = 12
"""Least count of changing numbers; fewer may all be float32 by chance in some set."""
_RESIDUE = 1e-6
"""Share of the largest number: below 2⁻²⁸ of it, differences have no more bits than a float32."""
_MOST_SINGLE = 0.5


@check("finite", _UNIT, of_positions=True)
def finite(record: Record) -> Figures:
    """Find numbers that are not finite (figure ∞) and quaternions of other than unit length."""
    length = rotation.norm(record.bodies.native)
    off = np.where(record.finite[:, :, None], np.abs(length - 1.0), np.inf)
    reasons = [failure.reason for failure in record.trajectory.failures if failure is not None]
    return Figures(off, _body_names(record), "; ".join(reasons[:3]))


@check("precision", _MOST_SINGLE, of_positions=True)
def precision(record: Record) -> Figures | None:
    """Find states that were rounded to single precision: 24 significant bits instead of 53.

    None if the method declares single precision.

    The figure is the share of float32 values among the numbers of a state array that change from
    frame to frame and are not short by nature. If the frame interval itself is a float32 number,
    such as 1/64 s, motion may be exact in few bits. Then only orientations count, and numbers that
    start with more bits.
    """
    if record.method is not None and record.method.single:
        return None
    motion, batch = record.trajectory, record.batch
    exact = not _bits(np.array([record.frame]), _SINGLE).any()
    parts = np.zeros((len(batch), len(motion.time), len(STATES)))
    for k, name in enumerate(STATES):
        values = getattr(motion, name)
        single = ~_bits(values, _SINGLE)
        single[:, 0] = False
        if not single.any():
            continue
        single &= _bits(values, _ROUND)
        moving = np.zeros(values.shape, dtype=bool)
        moving[:, 1:] = (values[:, 1:] != values[:, :-1]) & _bits(values[:, 1:], _ROUND)
        floor = 1.0 if name in ("orientation", "angular_velocity") else record.scene.length
        large = np.nan_to_num(np.abs(values)).max(axis=(1, 2, 3), keepdims=True)
        moving &= np.abs(values) > _RESIDUE * np.maximum(large, floor)
        if exact and name != "orientation":
            moving &= _bits(getattr(batch, name), _SINGLE)[:, None]
        single &= moving
        count, short = moving.sum(axis=(1, 2, 3)), single.sum(axis=(1, 2, 3))
        first = single.any(axis=(2, 3)).argmax(axis=1)
        share = np.where(count >= _FEW, short / np.maximum(count, 1), 0.0)
        parts[np.arange(len(batch)), first, k] = share
    names = (f"{name.replace('_', ' ')} rounded to 24 significant bits" for name in STATES)
    return Figures(parts, names)


@check(
    "start",
    lambda record: max(_SAME_START, rounding.state_error(record.mechanism, record.method)),
    of_positions=True,
)
def start(record: Record) -> Figures:
    """Compare frame 0 with the drawn start, relative to the largest value of each kind.

    The scale of velocities includes the angular velocity at an arm of the scene's length, or of
    1.8e-3 of the largest position if that is longer.
    """
    batch, motion = record.batch, record.trajectory
    arm = np.maximum(record.scene.length, _FAR * np.abs(batch.position).max(axis=(1, 2)))
    spin = np.abs(batch.angular_velocity).max(axis=(1, 2)) * arm
    alignment = np.sum(motion.orientation[:, 0] * batch.orientation, axis=-1, keepdims=True)
    near = np.where(alignment < 0, -batch.orientation, batch.orientation)
    pairs = (
        (motion.position[:, 0], batch.position, record.scene.length),
        (motion.orientation[:, 0], near, 1.0),
        (motion.velocity[:, 0], batch.velocity, np.maximum(1.0, spin)),
        (motion.angular_velocity[:, 0], batch.angular_velocity, 1.0),
    )
    off = np.stack([_relative(recorded, drawn, floor) for recorded, drawn, floor in pairs])
    parts = np.full((len(batch), len(motion.time), batch.position.shape[1]), np.nan)
    parts[:, 0] = off.max(axis=0)
    return Figures(parts, _body_names(record))


@check("planarity", "planarity", of_positions=True)
def planarity(record: Record) -> Figures | None:
    """Measure how far bodies leave the scene's dimensions, over its length; None in 3D.

    In 2D particles and centres of mass must stay in their planes. In 1D centres of mass must also
    keep their height, unless the scene has contacts.
    """
    scene, mechanism, bodies = record.scene, record.mechanism, record.bodies
    if scene.dimension == 3:
        return None
    orientation = mechanism.body_orientation(bodies.native)
    particles = mechanism.particle_positions(bodies.position, orientation)[..., 1]
    aside = np.concatenate([bodies.position[..., 1], particles], axis=-1)
    owners = [*range(mechanism.body_count), *mechanism.particle_body]
    if scene.dimension == 1 and not scene.contacts:
        aside = np.concatenate([aside, bodies.position[..., 2]], axis=-1)
        owners += range(mechanism.body_count)
    off = np.abs(aside - aside[:, :1]) / scene.length
    names = _body_names(record)
    return Figures(off, [names[body] for body in owners])


def _bits(values: Array, mask: int) -> Mask:
    """Find numbers with any bit of a mask set; those that are not finite have none."""
    return np.asarray((np.ascontiguousarray(values).view(np.int64) & mask) != 0)


def _relative(recorded: Array, drawn: Array, floor: float | Array) -> Array:
    scale = np.maximum(floor, np.abs(drawn).max(axis=(1, 2)))
    return np.abs(recorded - drawn).max(axis=2) / scale[:, None]


def _body_names(record: Record) -> tuple[str, ...]:
    return tuple(body.name for body in record.scene.bodies)


@check("gap", "gap", "m", of_positions=True)
def gap(record: Record) -> Figures:
    """Measure the distance between the anchor points of each joint [m]; None without joints.

    For a slider it is the distance of the child's anchor from the parent's axis, for a distance
    link the change of its length, and for a coupling how far the slider is off its place.
    """
    world, links = record.world, record.mechanism.distances
    offset = _apart(world, _anchors(_parted(record)[1]))
    parts = [
        _anchor_gaps(record)[0],
        rotation.norm(rotation.cross(_axes(record), offset)),
        np.abs(pair_distance(world, links) - [link.length for link in links]),
        np.abs(coupling_errors(record, "slider")[0]),
    ]
    return Figures(side_by_side(parts), _names(record))


@check("gap rate", lambda record: record.scene.budget.gap / record.frame, "m/s")
def gap_rate(record: Record) -> Figures:
    """Measure the speed at which the gap of each joint opens [m/s]; None without joints.

    The budget is the gap's over a frame. Velocities with a declared lag fit the joints of an
    earlier instant; the part that rotation in between explains is subtracted.
    """
    world, ends = record.world, _anchors(_parted(record)[1])
    spin = select_bodies(world.angular_velocity, ends[0][0])
    sliding = _parting(world, ends) - rotation.cross(spin, _apart(world, ends))
    parts = [
        _anchor_gaps(record)[1],
        rotation.norm(rotation.cross(_axes(record), sliding)),
        np.abs(pair_rate(world, record.mechanism.distances)),
        np.abs(coupling_errors(record, "slider")[1]),
    ]
    opening = _less_late(record, side_by_side(parts), record.bodies.velocity)
    return Figures(opening, _names(record))


@check("angle gap rate", lambda record: record.scene.budget.angle_gap / record.frame, "rad/s")
def angle_gap_rate(record: Record) -> Figures:
    """Measure the rates at which hinges tilt, and sliders and fixed joints turn [rad/s].

    As `gap_rate`, but for angles. None without such joints.
    """
    (parent, child), free = _facing(record)
    states = record.world
    turning = states.angular_velocity[..., child, :] - states.angular_velocity[..., parent, :]
    free = states.arms(parent, free)
    across = turning - rotation.dot(turning, free)[..., None] * free
    slip = np.abs(coupling_errors(record, "hinge")[1])
    rate = np.concatenate([rotation.norm(across), slip], axis=-1)
    rate = _less_late(record, rate, record.bodies.angular_velocity)
    return Figures(rate, _angle_names(record))


@check("angle gap", "angle_gap", "rad", of_positions=True)
def angle_gap(record: Record) -> Figures:
    """Measure tilts of hinges, and turns of sliders and fixed joints [rad]; None without these."""
    (parent, child), free = _facing(record)
    native = record.world.native
    back = rotation.conjugate(native[..., parent, :])
    turn = rotation.multiply(back, native[..., child, :])
    # Without a hinge's free turn, the rest is a swing whose half angle has the sine |across|.
    along = np.sum(turn[..., 1:] * free, axis=-1)
    across = np.linalg.norm(turn[..., 1:] - along[..., None] * free, axis=-1)
    angle = 2.0 * np.arctan2(across, np.hypot(turn[..., 0], along))
    off = np.abs(coupling_errors(record, "hinge")[0])
    return Figures(np.concatenate([angle, off], axis=-1), _angle_names(record))


def pair_distance(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Compute distances of attachment points [m], shape (…, pair), from states with the world."""
    return np.asarray(rotation.norm(_apart(states, _attached(pairs))))


def pair_rate(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Compute rates of attachment distances [m/s], (…, pair), from states with the world."""
    ends = _attached(pairs)
    offset = _apart(states, ends)
    way = offset / rotation.norm(offset)[..., None]
    return np.asarray(rotation.dot(_parting(states, ends), way))


def _less_late(record: Record, rates: Array, velocity: Array) -> Array:
    """Subtract what rotation changes in lagging velocities, shape (…, frame, part).

    Methods that keep joints closed at the beginning of a step declare a lag of half a step, so the
    bound takes twice the lag, at the fastest rotation of the mechanism.
    """
    if not record.lag:
        return rates
    spin, speed = (
        rotation.norm(each).max(axis=-1, keepdims=True)
        for each in (record.bodies.angular_velocity, velocity)
    )
    return np.maximum(rates - 2.0 * abs(record.lag) * spin * speed, 0.0)


def _parted(record: Record) -> tuple[list[PlacedJoint], list[PlacedJoint]]:
    """Return joints whose bodies share an anchor, and sliders."""
    joints = record.mechanism.joints
    return [j for j in joints if j.kind != "slider"], [j for j in joints if j.kind == "slider"]


@functools.lru_cache(maxsize=1)
def _anchor_gaps(record: Record) -> tuple[Array, Array]:
    """Return distances [m] and relative speeds [m/s] of shared anchors, shape (…, joint)."""
    ends = _anchors(_parted(record)[0])
    if not record.many:
        apart, parting = _apart(record.world, ends), _parting(record.world, ends)
        return rotation.norm(apart), rotation.norm(parting)
    from mbds_xsim.checks.balance_kernel import Ends, part_joints  # imports a compiler

    bodies, points = (np.array(each) for each in zip(*ends, strict=True))
    shape, joined = (2, points.shape[1], record.motion.frames), Ends(bodies.astype(int), points)
    gap, rate = np.moveaxis(record.by_kernel(part_joints, shape, joined), -1, 0)
    return gap, rate


def _names(record: Record) -> list[str]:
    """Return the names of the parts of gaps and gap rates."""
    joints, sliders = _parted(record)
    links = (f"distance link {link.name}" for link in record.mechanism.distances)
    joint_names = (f"joint {j.name}" for j in [*joints, *sliders])
    return [*joint_names, *links, *_followers(record, "slider")]


def _angle_names(record: Record) -> list[str]:
    names = (f"joint {j.name}" for j in record.mechanism.joints if j.kind != "ball")
    return [*names, *_followers(record, "hinge")]


def _followers(record: Record, kind: str) -> list[str]:
    return [c.name for c in record.mechanism.couplings if c.follower.kind == kind]


def _facing(record: Record) -> tuple[tuple[list[int], list[int]], Array]:
    """Return parents and children of joints that resist turns, and axes of free turns, or zero."""
    joints = [j for j in record.mechanism.joints if j.kind != "ball"]
    free = _vectors([j.axis if j.kind == "hinge" else np.zeros(3) for j in joints])
    return ([j.parent for j in joints], [j.child for j in joints]), free


_Ends = list[tuple[list[int], Array]]
"""Bodies and points in them, of the first and of the second ends of pairs."""


def _attached(pairs: tuple[PointPair, ...]) -> _Ends:
    """Return the ends of distance links or springs."""
    return [
        ([pair.bodies[k] for pair in pairs], _vectors([pair.in_body[k] for pair in pairs]))
        for k in (0, 1)
    ]


def _anchors(joints: list[PlacedJoint]) -> _Ends:
    """Return the anchors of joints in parents and children."""
    return [
        ([j.parent for j in joints], _vectors([j.in_parent for j in joints])),
        ([j.child for j in joints], _vectors([j.in_child for j in joints])),
    ]


def _apart(world: BodyStates, ends: _Ends) -> Array:
    """Return second ends relative to first ones, in W [m], shape (…, pair, 3)."""
    near, far = (world.points(*end) for end in ends)
    return far - near


def _parting(world: BodyStates, ends: _Ends) -> Array:
    """Return velocities of second ends past first ones, in W [m/s], shape (…, pair, 3)."""
    near, far = (world.speeds(*end) for end in ends)
    return far - near


def _axes(record: Record) -> Array:
    """Return the axes of sliders in W; they are fixed in the parents."""
    sliders = _parted(record)[1]
    return record.world.arms([j.parent for j in sliders], _vectors([j.axis for j in sliders]))


def _vectors(values: list[Array]) -> Array:
    return np.array(values).reshape(-1, 3)

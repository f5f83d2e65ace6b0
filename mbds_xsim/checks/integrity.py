"""Is every frame one of the mechanism: finite, unit quaternions, as drawn, joints closed?"""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.coordinates import coupling_errors
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates, taken
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint, PointPair
from mbds_xsim.simulate import rounding

_UNIT = 1e-9
_SAME_START = 1e-12
_SINGLE = (1 << 29) - 1
"""Bits of a float64's significand that are 0 where a float32 has the same value."""
_ROUND = (1 << 37) - 1
"""The same of 16 significant bits: numbers such as 0.5 that are exact by nature."""
_FEW = 12
"""Numbers that may be float32 by chance, however many sets are made."""
_RESIDUE = 1e-6
"""Of the largest number: below 2⁻²⁸ a difference of large ones has no more bits than a float32."""
_MOST_SINGLE = 0.5
_STATE = ("position", "orientation", "velocity", "angular_velocity")


@check("finite", _UNIT)
def finite(record: Record) -> Figures:
    """Find numbers that are not finite (figure ∞) and quaternions that are not unit."""
    length = rotation.norm(record.bodies.native)
    off = np.where(record.finite[:, :, None], np.abs(length - 1.0), np.inf)
    reasons = [failure.reason for failure in record.trajectory.failures if failure is not None]
    return Figures(off, _body_names(record), "; ".join(reasons[:3]))


@check("precision", _MOST_SINGLE)
def precision(record: Record) -> Figures | None:
    """Find states that were rounded to single precision: of 24 significant bits, not of 53.

    None where the method says that they are.

    The figure is the share of float32 values among the numbers of a state array that move from
    frame to frame and are not short by nature. Counted are those that no sound computation leaves
    short: where the frame interval itself is a float32 number, as 1/64 s is, motion may be exact,
    so that orientations alone are looked at, and what starts with more bits.
    """
    if record.method is not None and record.method.single:
        return None
    found, batch = record.trajectory, record.batch
    exact = not _bits(np.array([record.frame]), _SINGLE).any()
    parts = np.zeros((len(batch), len(found.time), len(_STATE)))
    for k, name in enumerate(_STATE):
        values = getattr(found, name)
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
    names = (f"{name.replace('_', ' ')} rounded to 24 significant bits" for name in _STATE)
    return Figures(parts, names)


@check("start", lambda record: max(_SAME_START, rounding.held(record.mechanism, record.method)))
def start(record: Record) -> Figures:
    """Compare frame 0 with the drawn start, relative to the largest value of each kind.

    Velocities are also put together from rates at arms of up to the scene's length.
    """
    batch, motion = record.batch, record.trajectory
    spin = np.abs(batch.angular_velocity).max(axis=(1, 2)) * record.scene.length
    facing = np.sum(motion.orientation[:, 0] * batch.orientation, axis=-1, keepdims=True)
    near = np.where(facing < 0, -batch.orientation, batch.orientation)
    pairs = (
        (motion.position[:, 0], batch.position, record.scene.length),
        (motion.orientation[:, 0], near, 1.0),
        (motion.velocity[:, 0], batch.velocity, np.maximum(1.0, spin)),
        (motion.angular_velocity[:, 0], batch.angular_velocity, 1.0),
    )
    off = np.stack([_relative(got, drawn, floor) for got, drawn, floor in pairs])
    parts = np.full((len(batch), len(motion.time), batch.position.shape[1]), np.nan)
    parts[:, 0] = off.max(axis=0)
    return Figures(parts, _body_names(record))


@check("planarity", "planarity")
def planarity(record: Record) -> Figures | None:
    """Measure the excursion out of the scene's dimensions over its length; None in 3D.

    In 2D no particle or centre of mass leaves its plane. In 1D the centres of mass keep their
    height too, unless a contact carries them.
    """
    scene, mechanism, bodies = record.scene, record.mechanism, record.bodies
    if scene.dimension == 3:
        return None
    turned = mechanism.body_orientation(bodies.native)
    particles = mechanism.particle_positions(bodies.position, turned)[..., 1]
    aside = np.concatenate([bodies.position[..., 1], particles], axis=-1)
    owners = [*range(mechanism.body_count), *mechanism.particle_body]
    if scene.dimension == 1 and not scene.contacts:
        aside = np.concatenate([aside, bodies.position[..., 2]], axis=-1)
        owners += range(mechanism.body_count)
    off = np.abs(aside - aside[:, :1]) / scene.length
    names = _body_names(record)
    return Figures(off, [names[body] for body in owners])


def _bits(values: Array, mask: int) -> Mask:
    """Tell which numbers have any of some bits set; those that are not finite have none."""
    return np.asarray((np.ascontiguousarray(values).view(np.int64) & mask) != 0)


def _relative(got: Array, drawn: Array, floor: float | Array) -> Array:
    scale = np.maximum(floor, np.abs(drawn).max(axis=(1, 2)))
    return np.abs(got - drawn).max(axis=2) / scale[:, None]


def _body_names(record: Record) -> tuple[str, ...]:
    return tuple(body.name for body in record.scene.bodies)


@check("gap", "gap", "m")
def gap(record: Record) -> Figures:
    """Measure the distance between the anchor points of each joint [m]; None without joints.

    Of a slider it is the distance of the child's anchor from the parent's axis, of a distance
    link the change of its length, of a coupling how far a slider is from where it should follow.
    """
    slid = _apart(record, slides=True)
    links = record.mechanism.distances
    parts = [
        _opened(record)[0],
        rotation.norm(rotation.cross(_axes(record), slid)),
        np.abs(pair_distance(record.world, links) - [link.length for link in links]),
        np.abs(coupling_errors(record, "slider")[0]),
    ]
    return Figures(record.by_frame(_columns(parts)), _names(record))


@check("gap rate", lambda record: record.scene.budget.gap / record.frame, "m/s")
def gap_rate(record: Record) -> Figures:
    """Measure the speed at which the gap of each joint opens [m/s]; None without joints.

    It may open the gap's budget in a frame. Velocities that lag as the method declares keep to
    joints as they were a step before; what places that turn make of that is left out.
    """
    carried = taken(record.world.angular_velocity, _ends(_parted(record.mechanism)[1])[0])
    sliding = _parting(record, slides=True)
    sliding = sliding - rotation.cross(carried, _apart(record, slides=True))
    parts = [
        _opened(record)[1],
        rotation.norm(rotation.cross(_axes(record), sliding)),
        np.abs(pair_rate(record.world, record.mechanism.distances)),
        np.abs(coupling_errors(record, "slider")[1]),
    ]
    opening = record.by_frame(_columns(parts))
    if record.lag:
        late = _turned(record, rotation.norm(record.bodies.velocity))
        opening = np.maximum(opening - late, 0.0)
    return Figures(opening, _names(record))


@check("angle gap rate", lambda record: record.scene.budget.angle_gap / record.frame, "rad/s")
def angle_gap_rate(record: Record) -> Figures | None:
    """Measure the rate at which hinges tilt, and sliders and fixed joints turn [rad/s]; else None.

    As `gap_rate`, of angles.
    """
    joints = [j for j in record.mechanism.joints if j.kind != "ball"]
    if not joints:
        return None
    states = record.world
    parent, child = _ends(joints)
    turning = states.angular_velocity[..., child, :] - states.angular_velocity[..., parent, :]
    free = states.arms(parent, _free(joints))
    across = turning - rotation.dot(turning, free)[..., None] * free
    slip = np.abs(coupling_errors(record, "hinge")[1])
    rate = np.concatenate([rotation.norm(across), slip], axis=-1)
    if record.lag:
        late = _turned(record, rotation.norm(record.bodies.angular_velocity))
        rate = np.maximum(rate - late, 0.0)
    return Figures(rate, [*(f"joint {j.name}" for j in joints), *_followers(record, "hinge")])


@check("angle gap", "angle_gap", "rad")
def angle_gap(record: Record) -> Figures | None:
    """Measure hinges' angle between axes, sliders' and fixed joints' turn [rad]; else None."""
    joints = [j for j in record.mechanism.joints if j.kind != "ball"]
    if not joints:
        return None
    states = record.world
    parent, child = _ends(joints)
    back = rotation.conjugate(states.native[..., parent, :])
    turn = rotation.multiply(back, states.native[..., child, :])
    # A hinge's free turn is taken out: the rest is a swing of sine |across| of its half angle.
    free = _free(joints)
    along = np.sum(turn[..., 1:] * free, axis=-1)
    across = np.linalg.norm(turn[..., 1:] - along[..., None] * free, axis=-1)
    angle = 2.0 * np.arctan2(across, np.hypot(turn[..., 0], along))
    off = np.abs(coupling_errors(record, "hinge")[0])
    names = [*(f"joint {j.name}" for j in joints), *_followers(record, "hinge")]
    return Figures(np.concatenate([angle, off], axis=-1), names)


def pair_distance(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Distances of attachment points [m], shape (…, pair), of states with the world."""
    begin, end = (states.points(*points) for points in _attached(pairs))
    return np.asarray(rotation.norm(end - begin))


def pair_rate(states: BodyStates, pairs: tuple[PointPair, ...]) -> Array:
    """Rates of the distances of attachment points [m/s], (…, pair), of states with the world."""
    ends = _attached(pairs)
    apart, parting = (
        b - a
        for a, b in (
            [states.points(*points) for points in ends],
            [states.speeds(*points) for points in ends],
        )
    )
    return np.asarray(rotation.dot(parting, apart / rotation.norm(apart)[..., None]))


def _turned(record: Record, speeds: Array) -> Array:
    """By how much a turn during the step by which velocities lag may change them, (…, frame, 1).

    Methods lag by half a step where they keep joints closed at its beginning, so it is twice the
    lag, at the fastest rate of the mechanism.
    """
    fastest = rotation.norm(record.bodies.angular_velocity).max(axis=-1, keepdims=True)
    return np.asarray(2.0 * abs(record.lag) * fastest * speeds.max(axis=-1, keepdims=True))


def _parted(mechanism: Mechanism) -> tuple[list[PlacedJoint], list[PlacedJoint]]:
    """Joints with an anchor that both bodies share, and sliders."""
    joints = mechanism.joints
    return [j for j in joints if j.kind != "slider"], [j for j in joints if j.kind == "slider"]


def _opened(record: Record) -> tuple[Array, Array]:
    """Distances [m] and speeds [m/s] of anchors that both bodies share, (…, joint)."""
    if record.many:
        return _opened_of_many(record)
    kinds = _apart(record, slides=False), _parting(record, slides=False)
    return rotation.norm(kinds[0]), rotation.norm(kinds[1])


@functools.lru_cache(maxsize=1)
def _opened_of_many(record: Record) -> tuple[Array, Array]:
    from mbds_xsim.checks.balance_kernel import Ends, part_joints  # imports a compiler

    joints, motion = _parted(record.mechanism)[0], record.motion
    points = [_vectors([getattr(j, key) for j in joints]) for key in ("in_parent", "in_child")]
    ends = Ends(np.array(_ends(joints), dtype=np.int64).reshape(2, -1), np.array(points))
    found = np.empty((2, len(joints), motion.frames, motion.rows))
    part_joints(motion, ends, found.reshape(-1))
    gap, rate = (np.asarray(values.T)[: len(record.batch)] for values in found)
    return gap, rate


def _columns(parts: list[Array]) -> list[Array]:
    return [part[..., k] for part in parts for k in range(part.shape[-1])]


def _names(record: Record) -> tuple[str, ...]:
    """Of the parts of gaps and their rates."""
    joints, sliders = _parted(record.mechanism)
    links = (f"distance link {link.name}" for link in record.mechanism.distances)
    held = (f"joint {j.name}" for j in [*joints, *sliders])
    return (*held, *links, *_followers(record, "slider"))


def _followers(record: Record, kind: str) -> list[str]:
    return [c.name for c in record.mechanism.couplings if c.follower.kind == kind]


def _free(joints: list[PlacedJoint]) -> Array:
    """Axes about which joints turn freely, zero where there is none."""
    return np.array([j.axis if j.kind == "hinge" else np.zeros(3) for j in joints])


def _attached(pairs: tuple[PointPair, ...]) -> list[tuple[list[int], Array]]:
    """Bodies and points of the two ends of distance links or springs."""
    return [
        ([pair.bodies[k] for pair in pairs], _vectors([pair.in_body[k] for pair in pairs]))
        for k in (0, 1)
    ]


@functools.lru_cache(maxsize=2)
def _arms(record: Record, slides: bool) -> list[tuple[list[int], Array]]:
    """Bodies of the two ends of sliders, or of other joints, and arms of their anchors [m]."""
    joints = _parted(record.mechanism)[slides]
    points = ([joint.in_parent for joint in joints], [joint.in_child for joint in joints])
    return [
        (bodies, record.world.arms(bodies, _vectors(end)))
        for bodies, end in zip(_ends(joints), points, strict=True)
    ]


def _apart(record: Record, *, slides: bool) -> Array:
    """Place of the child's anchor from the parent's, in W [m], shape (…, joint, 3)."""
    places = record.world.position
    near, far = (taken(places, bodies) + arm for bodies, arm in _arms(record, slides))
    return far - near


def _parting(record: Record, *, slides: bool) -> Array:
    """Velocity of the child's anchor from the parent's, in W [m/s], shape (…, joint, 3)."""
    speeds, spins = record.world.velocity, record.world.angular_velocity
    near, far = (
        taken(speeds, bodies) + rotation.cross(taken(spins, bodies), arm)
        for bodies, arm in _arms(record, slides)
    )
    return far - near


def _axes(record: Record) -> Array:
    """Axes of the sliders in W, which are fixed in the parents."""
    sliders = _parted(record.mechanism)[1]
    return record.world.arms(_ends(sliders)[0], _vectors([j.axis for j in sliders]))


def _ends(joints: list[PlacedJoint]) -> tuple[list[int], list[int]]:
    return [j.parent for j in joints], [j.child for j in joints]


def _vectors(values: list[Array]) -> Array:
    return np.array(values).reshape(-1, 3)

"""Mismatch between displacements and velocities within frames.

Over every second step, which covers each frame, or over fewer steps, the displacement of points on
the bodies is compared with the integral of their velocities: that of the quintic that matches the
velocity, and the acceleration and jerk that the scene gives, at both ends of the step. Its error is
H⁷/100800 of the velocity's sixth derivative (Davis & Rabinowitz 1984, Methods of Numerical
Integration, 2.9).
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask, Picked
from mbds_xsim.checks.flights import usual
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, to_bodies, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism

MOMENT = 5e-4  # share of the frame interval; jerks are differences of accelerations over it
_FACTOR = 8.0  # largest error of the quintic over its estimate (measured: 7.3)
_LEAST_ARM = 1e-3  # share of a body's reach; points nearer to its centre drown in rounding
_ARMS = np.concatenate([np.zeros((1, 3)), np.eye(3)])


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Four points per body, whose motion combines displacement and rotation in one vector.

    They are its centre of mass, and one at the radius of gyration along each axis of its native
    frame.
    """

    mechanism: Mechanism

    def rms(self, vectors: Array) -> Array:
        """Return the RMS over mass and points, shape (trajectory, step)."""
        return np.sqrt(self.inner(vectors, vectors))

    def each(self, vectors: Array) -> Array:
        """Return the RMS over each body's points, moved out to the body's ends, shape (…, body).

        Vectors relative to the centre grow in proportion to the distance from it. The ends are at
        least at the radius of gyration. A slender rod that twists hardly moves its mass, but does
        move a joint on its side.
        """
        center, radii = vectors[..., :1, :], _gyrations(self.mechanism)
        stretch = np.maximum(radii, _reaches(self.mechanism)) / radii
        ends = center + stretch[:, None, None] * (vectors - center)
        return np.sqrt(np.einsum("...bpi,...bpi->...b", ends, ends) / len(_ARMS))

    def inner(self, one: Array, other: Array) -> Array:
        """Return the scalar product averaged over mass and points, shape (trajectory, step)."""
        share = self.mechanism.mass / (4.0 * self.mechanism.mass.sum())
        weighed = share[:, None, None] * one  # einsum of three takes several times as long
        return np.asarray(np.einsum("...bpi,...bpi->...", weighed, other))

    def as_bodies(self, points: Array, native: Array) -> tuple[Array, Array]:
        """Compute velocities [m/s], [rad/s] of bodies from those of points, (…, body, 3)."""
        axes = rotation.rotate(native[..., None, :], _ARMS[1:])
        turns = rotation.cross(axes, points[..., 1:, :] - points[..., :1, :]).sum(axis=-2)
        return points[..., 0, :], turns / (2.0 * _gyrations(self.mechanism)[:, None])

    def as_points(self, velocity: Array, spin: Array, native: Array) -> Array:
        """Compute velocities of points from those of bodies [m/s], shape (…, body, point, 3)."""
        return velocity[..., None, :] + rotation.cross(spin[..., None, :], self._arms(native))

    def moving(self, states: BodyStates, pull: Array, push: Array) -> tuple[Array, Array, Array]:
        """Compute positions, velocities and accelerations of the points."""
        spin, arm = states.angular_velocity[..., None, :], self._arms(states.native)
        swing = rotation.cross(spin, arm)
        return (
            states.position[..., None, :] + arm,
            states.velocity[..., None, :] + swing,
            pull[..., None, :]
            + rotation.cross(push[..., None, :], arm)
            + rotation.cross(spin, swing),
        )

    def _arms(self, native: Array) -> Array:
        radii = _gyrations(self.mechanism)[:, None, None]
        return rotation.rotate(native[..., None, :], radii * _ARMS)


@dataclass(frozen=True, eq=False)
class Mismatch:
    """Mean velocity over a step by positions, less that by velocities.

    Shapes (trajectory, step, body, point, 3); NaN where frames are lost or something may touch.
    """

    points: CarriedPoints
    frame: Index
    """Frame at which each step ends, shape (step,)."""
    residual: Array
    """Difference of the two mean velocities [m/s]."""
    velocity: Array
    """Velocities at the beginnings of steps, then at their ends [m/s], (trajectory, 2 step, …)."""
    acceleration: Array
    """Mean acceleration over the step [m/s²]."""
    rate_acceleration: Array
    """Part of the acceleration from changes of the velocity coordinates [m/s²]."""
    unclear: Array
    """Error of `rate_acceleration` as a finite difference [m/s²], (trajectory, step)."""
    jerk: Array
    """Larger RMS jerk of the two ends [m/s³], shape (trajectory, step)."""
    blur: Array
    """RMS error of the integral itself [m/s], shape (trajectory, step)."""
    jerk_each: Array
    """Jerk of each body with points at its ends [m/s³], shape (trajectory, step, body)."""
    blur_each: Array
    """Error of the integral of each body with such points [m/s], (trajectory, step, body)."""


@functools.lru_cache(maxsize=1)
def mismatch_of(record: Record) -> Mismatch:
    """Compare positions and velocities over the record's `steps_compared`, outside contact."""
    start, stride = record.steps_compared
    first, frame = np.arange(start, record.steps, stride), record.frame
    flow = Flow(record.mechanism, MOMENT * frame, record.many)
    begin, end = _ends(record, flow, first)
    # Hermite's formulas with no, one and two derivatives at each end.
    trapezoid = (begin.velocity + end.velocity) / 2
    bend = (begin.acceleration - end.acceleration) * frame
    cubic = trapezoid + bend / 12
    quintic = trapezoid + bend / 10 + frame**2 / 120 * (begin.jerk + end.jerk)
    points = CarriedPoints(record.mechanism)
    gaps = trapezoid - cubic, cubic - quintic
    jerk = np.maximum(points.rms(begin.jerk), points.rms(end.jerk))
    return Mismatch(
        points=points,
        frame=first + 1,
        residual=(end.position - begin.position) / frame - quintic,
        velocity=np.concatenate([begin.velocity, end.velocity], axis=1),
        acceleration=(begin.acceleration + end.acceleration) / 2,
        rate_acceleration=(begin.rate_acceleration + end.rate_acceleration) / 2,
        unclear=flow.moment * jerk,
        jerk=jerk,
        blur=_blur(*map(points.rms, gaps)),
        jerk_each=np.maximum(points.each(begin.jerk), points.each(end.jerk)),
        blur_each=_blur(*map(points.each, gaps)),
    )


@dataclass(frozen=True, eq=False)
class _Points(Picked):
    """Positions of points and their first three derivatives, shapes (…, body, point, 3)."""

    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    rate_acceleration: Array


def _ends(record: Record, flow: Flow, first: Index) -> tuple[_Points, _Points]:
    """Return the points at the beginnings and ends of steps."""
    # Both at once, since calls cost as much as arithmetic here.
    both, count = np.concatenate([first, first + 1]), len(first)
    inputs = (record.flying() & record.steady, record.batch.force, record.torque)
    free, force, torque = (np.concatenate([each[:, first]] * 2, axis=1) for each in inputs)
    if flow.mechanism.compliant or flow.mechanism.drives:
        torque = torque + winding_torque(flow.mechanism, record.bodies)[:, both]
    states = record.bodies[:, both]
    points = _points_at(flow, states, known_states(states) & free, force, torque, record.lag)
    return points[:, :count], points[:, count:]


def winding_torque(mechanism: Mechanism, bodies: BodyStates) -> Array:
    """Compute spring torques for whole turns, which states do not show [N·m], (…, frame, input)."""
    springs = [(joint, joint.stiffness) for joint in mechanism.hinges]
    springs += [(drive.joint, drive.servo.stiffness) for drive in mechanism.drives]
    torque = np.zeros((*bodies.position.shape[:2], len(springs)))
    for k, (joint, stiffness) in enumerate(springs):
        if joint.kind == "hinge":
            angle = joint_coordinate(joint, bodies.position, bodies.native)
            torque[..., k] = stiffness * (angle - np.unwrap(angle, axis=1))
    return torque


def _blur(coarse: Array, fine: Array) -> Array:
    """Estimate the quintic's error from the differences trapezoid to cubic, and cubic to quintic.

    The latter may be small by chance in a step, so each step has at least the usual error of its
    trajectory.
    """
    return np.maximum(_extrapolate(coarse, fine), _extrapolate(usual(coarse), usual(fine)))


def _extrapolate(coarse: Array, fine: Array) -> Array:
    """Extrapolate two differences as a geometric series; if they do not fall, nothing is resolved.

    The slowest fall among several bodies counts for all.
    """
    gain = np.minimum(1.0, fine / np.maximum(coarse, np.finfo(float).tiny))
    if gain.ndim > 2:
        gain = gain.max(axis=-1, keepdims=True)
    return np.asarray(_FACTOR * gain**2 * np.maximum(coarse, fine))


def _points_at(
    flow: Flow, states: BodyStates, known: Mask, force: Array, torque: Array, lag: float
) -> _Points:
    points, force, torque = CarriedPoints(flow.mechanism), force[known], torque[known]
    subset = states[known].each(np.asfortranarray)  # components apart, as in `Record`
    near = flow.closed(subset)
    if lag:
        gain = flow.of_rates(near, *flow.accelerations(near, force, torque))
        subset = _faster(subset, *gain, -lag)
        near = flow.closed(_faster(near, *gain, -lag))
    rates = flow.accelerations(near, force, torque)
    later = flow.closed(flow.later(near, *rates))
    then = flow.accelerations(later, force, torque)
    position, velocity, acceleration = points.moving(subset, *rates)
    change = points.moving(later, *then)[2] - points.moving(near, *rates)[2]
    by_rates = points.as_points(*flow.of_rates(near, *rates), subset.native)
    parts = position, velocity, acceleration, change / flow.moment, by_rates
    return _Points(*(_placed(known, values) for values in parts))


def _placed(known: Mask, values: Array) -> Array:
    """Put values of known states in their places, NaN elsewhere."""
    shape = *known.shape, *values.shape[1:]
    if known.all():
        return values.reshape(shape)
    whole = np.full(shape, np.nan)
    whole[known] = values
    return whole


def _faster(states: BodyStates, pull: Array, push: Array, time: float) -> BodyStates:
    return dataclasses.replace(
        states,
        velocity=states.velocity + time * pull,
        angular_velocity=states.angular_velocity + time * push,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Flow:
    """Flow of a mechanism outside contact."""

    mechanism: Mechanism
    moment: float
    """Interval of finite differences [s]."""
    many: bool = False

    def accelerations(self, states: BodyStates, force: Array, torque: Array) -> tuple[Array, Array]:
        """Compute linear and angular accelerations, shapes (state, body, 3)."""
        # The reference loads the compiled parts of scipy, which most uses do without.
        from mbds_xsim.reference import accelerations

        return accelerations(self.mechanism, states, force, torque, many=self.many)

    def later(self, states: BodyStates, pull: Array, push: Array) -> BodyStates:
        """Return states one `moment` later, by their linear and angular accelerations."""
        moment = self.moment
        turn = moment * (states.angular_velocity + moment / 2 * push)
        return BodyStates(
            states.position + moment * (states.velocity + moment / 2 * pull),
            rotation.multiply(rotation.from_vector(turn), states.native),
            states.velocity + moment * pull,
            states.angular_velocity + moment * push,
        )

    def of_rates(self, states: BodyStates, pull: Array, push: Array) -> tuple[Array, Array]:
        """Return the part of accelerations that comes from changes of the velocity coordinates.

        These are joint rates, and velocities of free bodies. The rest comes from places that
        change while the velocity coordinates stay constant. Shapes (state, body, 3).
        """
        here = to_links(self.mechanism, states)
        then = to_links(self.mechanism, self.later(states, pull, push))
        changes = dataclasses.replace(
            here,
            angular_velocity=(then.angular_velocity - here.angular_velocity) / self.moment,
            rate=(then.rate - here.rate) / self.moment,
            velocity=(then.velocity - here.velocity) / self.moment,
        )
        bodies = to_bodies(self.mechanism, changes)
        return bodies.velocity, bodies.angular_velocity

    def closed(self, states: BodyStates) -> BodyStates:
        """Close the joints of mechanisms whose loops may have redundant constraints.

        With these, gaps as small as engines leave make constraints contradict each other, and
        accelerations jump. The tree's joints are closed first, so that a flat loop is flat. Ball
        joints alone are redundant at single configurations only.
        """
        mechanism = self.mechanism
        if not mechanism.loops or all(joint.kind == "ball" for joint in mechanism.joints):
            return states
        known = known_states(states)
        if not known.any():
            return states
        tree = to_bodies(mechanism, to_links(mechanism, states[known]))
        closed = projected(mechanism, tree)
        filled = states.each(lambda values: np.full_like(values, np.nan))
        for name, values in vars(filled).items():
            values[known] = getattr(closed, name)
        return filled


def projected(mechanism: Mechanism, states: BodyStates) -> BodyStates:
    """Return states that a mechanism's joints allow, by the least change in the mass metric."""
    # The reference loads the compiled parts of scipy, which most uses do without.
    from mbds_xsim.reference.equations import dynamics_of

    dynamics = dynamics_of(mechanism)
    return dynamics.unpack(dynamics.project(dynamics.pack(states)))


def known_states(states: BodyStates) -> Mask:
    """Return which states have finite positions, with the shape of the leading axes."""
    return np.asarray(np.isfinite(states.position).all(axis=(-1, -2)))


@functools.lru_cache(maxsize=64)
def _gyrations(mechanism: Mechanism) -> Array:
    """Return mean radii of gyration [m], shape (body,), at least a thousandth of bodies' reaches.

    A link without moments of inertia turns, too, so its points must not coincide.
    """
    radii = np.sqrt(np.trace(mechanism.inertia, axis1=1, axis2=2) / (2 * mechanism.mass))
    return np.maximum(radii, _LEAST_ARM * _reaches(mechanism))


@functools.lru_cache(maxsize=64)
def _reaches(mechanism: Mechanism) -> Array:
    """Return how far joints, particles, spheres and attachments reach from centres of mass [m]."""
    reaches = np.zeros(len(mechanism.mass))
    joints = [((one.parent, one.child), (one.in_parent, one.in_child)) for one in mechanism.joints]
    pairs = [(pair.bodies, pair.in_body) for pair in (*mechanism.distances, *mechanism.springs)]
    for bodies, points in (*joints, *pairs):
        for body, point in zip(bodies, points, strict=True):
            if body != WORLD_INDEX:
                reaches[body] = max(reaches[body], float(np.linalg.norm(point)))
    particles = np.linalg.norm(mechanism.particle_offset, axis=1)
    spheres = np.linalg.norm(mechanism.sphere_offset, axis=1) + mechanism.sphere_radius
    np.maximum.at(reaches, mechanism.particle_body, particles)
    np.maximum.at(reaches, mechanism.sphere_body, spheres)
    return reaches

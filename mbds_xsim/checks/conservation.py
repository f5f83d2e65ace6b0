"""Do energy and momentum change only by what acts on the bodies?"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.balances import Balance, balances_of
from mbds_xsim.checks.coordinates import coordinate_of, hinge_turns
from mbds_xsim.checks.finding import Figures, check, side_by_side
from mbds_xsim.checks.flights import summed
from mbds_xsim.checks.integrity import pair_distance
from mbds_xsim.checks.joint_work import losses
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import joint_rate
from mbds_xsim.scene.mechanism import WORLD_INDEX

_FLOOR = 1e-3  # share of Σ m·g·length, and of Σ m·√(g·length)


class Energy:
    """Kinetic and potential energy (gravity and springs) [J], each (trajectory, frame)."""

    def __init__(self, by_body: Array, rotors: Array, springs: Array, floor: float) -> None:
        self.by_body = by_body
        """Kinetic, then gravitational energies of the bodies, (trajectory, frame, 2 · body)."""
        self.others = np.stack([rotors, springs], axis=-1)
        """Energies of rotors and of springs, (trajectory, frame, 2)."""
        moving, weight = (part.sum(axis=-1) for part in np.split(by_body, 2, axis=-1))
        self.kinetic, self.potential = moving + rotors, weight + springs
        self.total = self.kinetic + self.potential
        self._floor = floor

    @property
    def scale(self) -> Array:
        """Scale of energy errors [J], shape (trajectory,).

        It is the largest kinetic energy plus the range of the potential one, and at least 1e-3 of
        Σ m·g·length.
        """
        known = np.isfinite(self.total)
        top = np.where(known, self.potential, -np.inf).max(axis=1)
        bottom = np.where(known, self.potential, np.inf).min(axis=1)
        fastest = np.where(known, self.kinetic, -np.inf).max(axis=1)
        return np.maximum(self._floor, fastest + np.maximum(top - bottom, 0.0))


@check("energy", lambda record: record.energy_budget)
def energy_balance(record: Record) -> Figures | None:
    """Measure |E − E(0) − W| over the energy scale; with impacts, in each flight by itself.

    The work of held inputs is exact; that of dampers is a quadrature, whose error in the checked
    steps is the finding's uncertainty. None if nothing flies.
    """
    flights = record.flying()
    if record.mechanism.has_impacts and not flights.any():
        return None
    energy = energy_of(record)
    loss, step_error = losses(record)
    error = np.where(flights, step_error, 0.0).sum(axis=1)
    balance = energy.total - energy.total[:, :1] - input_work(record) + loss
    if record.mechanism.has_impacts:
        balance[:, 1:] = summed(np.diff(balance, axis=1)[..., None], flights)[..., 0]
    note = ""
    if np.nanmax(error, initial=0.0) > 0:
        note = f"damper work known to {np.nanmax(error / energy.scale):.1g} of the scale"
    parts = (np.abs(balance) / energy.scale[:, None])[..., None]
    return Figures(parts, note=note, uncertainty=error / energy.scale)


@functools.lru_cache(maxsize=1)
def energy_of(record: Record) -> Energy:
    """Compute kinetic and potential energy at every frame."""
    mechanism = record.mechanism
    stored = np.zeros(record.finite.shape)
    if mechanism.springs:
        stretch = pair_distance(record.world, mechanism.springs)
        stretch = stretch - [spring.length for spring in mechanism.springs]
        stored = 0.5 * stretch**2 @ np.array([spring.stiffness for spring in mechanism.springs])
    for joint in mechanism.compliant:
        stored += 0.5 * joint.stiffness * (coordinate_of(record, joint) - joint.rest) ** 2
    floor = _FLOOR * float(mechanism.mass.sum()) * record.usual_pull * record.scene.length
    rotors = np.zeros(record.finite.shape)
    for joint in mechanism.rotors:
        rotors += 0.5 * joint.armature * joint_rate(joint, record.world) ** 2
    return Energy(_of_bodies(record), rotors, stored, floor)


def _of_bodies(record: Record) -> Array:
    """Compute kinetic, then gravitational energies [J], shape (trajectory, frame, 2 · body)."""
    if record.many:
        from mbds_xsim.checks.balance_kernel import find_energies  # imports a compiler

        shape = 2 * record.motion.bodies, record.motion.frames
        return record.by_kernel(find_energies, shape, record.masses)
    mechanism, bodies = record.mechanism, record.bodies
    moving = np.einsum("tfbi,tfbi->tfb", bodies.velocity, bodies.velocity)
    turning = np.einsum("tfbi,tfbi->tfb", record.spin, record.turning)
    kinetic = 0.5 * (mechanism.mass * moving + turning)
    weight = -mechanism.mass * rotation.dot(bodies.position, np.array(record.scene.gravity))
    return side_by_side([kinetic, weight])


@functools.lru_cache(maxsize=1)
def input_work(record: Record) -> Array:
    """Compute the work of forces and torques from frame 0 on [J], shape (trajectory, frame).

    Inputs are constant over a step, so a step's work is exactly F·Δx + τ·Δθ.
    """
    work = work_of_forces(record)[1].copy()
    if record.mechanism.hinges:
        work += np.sum(record.batch.torque[:, : record.steps] * hinge_turns(record), axis=2)
    return np.concatenate([np.zeros((len(work), 1)), np.cumsum(work, axis=1)], axis=1)


@functools.lru_cache(maxsize=1)
def work_of_forces(record: Record) -> tuple[Array, Array, Array]:
    """Compute the work in each step of the forces of the step before, its own and the next [J].

    Shapes (trajectory, step); at the ends the forces of the step itself count.
    """
    if record.many:
        from mbds_xsim.checks.balance_kernel import find_work  # imports a compiler

        before, here, after = np.moveaxis(record.by_kernel(find_work, (3, record.steps)), -1, 0)
        return before, here, after
    before, here, after = (
        np.einsum("tsbi,tsbi->ts", np.asfortranarray(record.force[:, steps]), record.moved)
        for steps in (np.clip(np.arange(record.steps) + k, 0, record.steps - 1) for k in (-1, 0, 1))
    )
    return before, here, after


@check("momentum", lambda record: record.energy_budget)
def momentum(record: Record) -> Figures | None:
    """Measure the change of momentum less impulses over its scale; None if supports affect all.

    Forces are held over each step, so linear impulses are exact. Those of moments are integrals of
    places, by the cubic that matches places and velocities at both ends of the step; their error is
    the finding's uncertainty. With contact, each flight is checked by itself.
    """
    balances = flights_of(record)
    if not balances:
        return None
    parts, errors = zip(*(_unbalanced(record, *pair) for pair in balances), strict=True)
    uncertainty = np.max(errors, axis=0)
    names = [balance.name for balance, _ in balances]
    note = f"impulses known to {uncertainty.max():.1g} of the scale"
    return Figures(record.by_frame(parts), names, note, uncertainty)


def flights_of(record: Record) -> list[tuple[Balance, Mask]]:
    """Return the balances that hold in some steps, each with its mask, (trajectory, step)."""
    pairs = [(balance, record.flying(balance.bodies)) for balance in balances_of(record.mechanism)]
    return [pair for pair in pairs if pair[1].any()]


@dataclass(frozen=True, eq=False)
class Gain:
    """Gain of momentum in each step; axes are (trajectory, step, component)."""

    residual: Array
    """Gain that impulses do not explain."""
    inputs: Array
    """Impulses of the inputs."""
    blur: Array
    """Error of the impulses, shape (trajectory, step)."""
    scale: Array
    """Scale of the momentum, shape (trajectory,)."""


@functools.lru_cache(maxsize=4)
def gain_of(record: Record, balance: Balance) -> Gain:
    """Compute the gain of a group from its momenta, inputs and gravity."""
    if balance.angular and record.many:
        return _turned(record, balance)
    each, inputs, weight, blur = (_angular if balance.angular else _linear)(record, balance)
    residual = np.diff(_total(each), axis=1) - inputs - weight
    across, sizes = balance.directions.T, rotation.norm(each).sum(axis=2)
    return Gain(residual @ across, inputs @ across, blur, _scale(record, balance, sizes))


def _turned(record: Record, balance: Balance) -> Gain:
    """Compute the gain of angular momentum by compiled kernels."""
    from mbds_xsim.checks import balance_kernel as kernel  # imports a compiler
    from mbds_xsim.reference.compiled import lines

    frames, bodies = record.motion.frames, np.array(balance.bodies)
    about = np.zeros(3) if balance.about is None else balance.about
    group = kernel.Spinning(bodies, about, balance.about is not None, record.frame, record.lag)
    given = record.masses, group, lines(kernel.FRAME * frames)
    sums = record.by_kernel(kernel.find_momenta, (kernel.SUMS, frames), *given).T
    state, inputs, weight = (
        (balance.directions @ sums[k : k + 3].reshape(3, -1)).reshape(-1, *sums.shape[1:]).T
        for k in (kernel.MOMENTUM, kernel.INPUT, kernel.WEIGHT)
    )
    inputs = inputs[:, 1:] + record.frame * _driving(record, balance) @ balance.directions.T
    residual = np.diff(state, axis=1) - inputs - weight[:, 1:]
    size, blur = (sums[k].T for k in (kernel.SIZE, kernel.BLUR))
    return Gain(residual, inputs, blur[:, 1:], _scale(record, balance, size))


def _unbalanced(record: Record, balance: Balance, flights: Mask) -> tuple[Array, Array]:
    """Return change less impulses over scale, (trajectory, frame), and its error, (trajectory,)."""
    gain = gain_of(record, balance)
    imbalance = record.by_step([rotation.norm(summed(gain.residual, flights))])[..., 0]
    error = np.where(np.isfinite(gain.blur) & flights, gain.blur, 0.0).sum(axis=1)
    imbalance[~record.finite] = np.nan
    return imbalance / gain.scale[:, None], error / gain.scale


def _linear(record: Record, balance: Balance) -> tuple[Array, Array, Array, Array]:
    """Return the same as `_angular`, for linear momenta and impulses, whose error is 0."""
    bodies, frame = _rows(balance), record.frame
    force, mass = record.force[:, :, bodies], record.mechanism.mass[bodies]
    each = mass[:, None] * record.bodies.velocity[:, :, bodies]
    weight = frame * float(mass.sum()) * np.array(record.scene.gravity)
    return each, _total(force) * frame, weight, np.zeros(force.shape[:2])


def _angular(record: Record, balance: Balance) -> tuple[Array, Array, Array, Array]:
    """Return momenta of the bodies, angular impulses of inputs and gravity, and their error.

    Momenta, shape (trajectory, frame, body, 3), are about the balance's point. Impulses have shape
    (trajectory, step, 3). Momenta from lagging velocities lag, too, which the moments at both ends
    correct.
    """
    bodies, states, frame = _rows(balance), record.bodies, record.frame
    force, mass = record.force[:, :, bodies], record.mechanism.mass[bodies]
    arm, speed = states.position[:, :, bodies], states.velocity[:, :, bodies]
    if balance.about is None:
        arm, speed = arm - _mean(mass, arm), speed - _mean(mass, speed)
    else:
        arm = arm - balance.about
    own = rotation.rotate(states.native[:, :, bodies], record.turning[:, :, bodies])
    orbital = rotation.cross(arm, mass[:, None] * speed)
    each = own + orbital
    gravity = np.array(record.scene.gravity)
    swept = frame / 2 * (arm[:, 1:] + arm[:, :-1]) + frame**2 / 12 * (speed[:, :-1] - speed[:, 1:])
    swept = swept + record.lag * (arm[:, 1:] - arm[:, :-1])
    impulse = _total(rotation.cross(swept, force)) + frame * _driving(record, balance)
    weight = rotation.cross(np.einsum("b,tfbi->tfi", mass, swept), gravity)
    # A step's displacement less that of a parabola shows the third derivative of the place; the
    # integral is off by H⁵/720 of the fourth.
    bend = np.diff(arm, axis=1) - frame / 2 * (speed[:, 1:] + speed[:, :-1])
    change = np.diff(bend, axis=1, prepend=bend[:, 1:2] if bend.shape[1] > 1 else 0.0)
    load = force + mass[:, None] * gravity
    error = frame / 60 * rotation.norm(change) * rotation.norm(load)
    return each, impulse, weight, error.sum(axis=2)


def _scale(record: Record, balance: Balance, sizes: Array) -> Array:
    """Return the largest sum of the bodies' own momenta, shape (trajectory,).

    It is at least 1e-3 of what the group has at the speed of a fall through the scene's length.
    """
    length = record.scene.length
    speed, arm = np.sqrt(record.usual_pull * length), length if balance.angular else 1.0
    floor = _FLOOR * float(record.mechanism.mass[_rows(balance)].sum()) * speed * arm
    return np.maximum(np.nanmax(sizes, axis=1, initial=0.0), floor)


def _driving(record: Record, balance: Balance) -> Array:
    """Compute moments of hinges between group and world [N·m], shape (trajectory, step, 3)."""
    moment = np.zeros((len(record.batch), record.steps, 3))
    for k, joint in enumerate(record.mechanism.hinges):
        torque = record.batch.torque[:, : record.steps, k, None] * joint.axis
        if joint.parent == WORLD_INDEX and joint.child in balance.bodies:
            moment += torque
        if joint.child == WORLD_INDEX and joint.parent in balance.bodies:
            moment -= torque
    return moment


def _rows(balance: Balance) -> slice | list[int]:
    """Return the group's indices, as a slice, which copies nothing, if they are consecutive."""
    first, last = balance.bodies[0], balance.bodies[-1]
    if balance.bodies == tuple(range(first, last + 1)):
        return slice(first, last + 1)
    return list(balance.bodies)


def _total(each: Array) -> Array:
    """Sum over the bodies, shape (trajectory, frame, 3), in a fifth of the time of numpy's sum."""
    return np.asarray(np.einsum("tfbi->tfi", each))


def _mean(mass: Array, values: Array) -> Array:
    return np.einsum("b,tfbi->tfi", mass / mass.sum(), values)[:, :, None]

"""Energy of a motion, the work of its inputs, and the balance of the two."""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.finding import Figures, Record, check, summed
from mbds_xsim.checks.joints import pair_distance, pair_rate
from mbds_xsim.scene.joint_space import joint_coordinate

_FLOOR = 1e-3  # of Σ m·g·length


class Energy:
    """Kinetic and potential energy (gravity and springs) [J], each (trajectory, frame)."""

    def __init__(self, by_body: Array, springs: Array, floor: float) -> None:
        self.by_body = by_body
        """Kinetic, then gravitational energies of the bodies, (trajectory, frame, 2 · body)."""
        self.kinetic, weight = (part.sum(axis=-1) for part in np.split(by_body, 2, axis=-1))
        self.potential = weight + springs
        self.total = self.kinetic + self.potential
        self._floor = floor

    @property
    def scale(self) -> Array:
        """What energy errors are measured in [J], shape (trajectory,).

        The largest kinetic energy plus the range of the potential one, and at least 1e-3 of
        Σ m·g·length.
        """
        known = np.isfinite(self.total)
        top = np.where(known, self.potential, -np.inf).max(axis=1)
        bottom = np.where(known, self.potential, np.inf).min(axis=1)
        fastest = np.where(known, self.kinetic, -np.inf).max(axis=1)
        return np.maximum(self._floor, fastest + np.maximum(top - bottom, 0.0))


@check("energy", lambda record: record.energy_budget)
def energy_balance(record: Record) -> Figures | None:
    """Measure |E − E(0) − W| over the energy scale; with contact, over each period of flight.

    The work of held inputs is exact; that of dampers is a quadrature, whose error is the
    finding's uncertainty. None where nothing flies.
    """
    flights = record.flying()
    if record.scene.contacts and not flights.any():
        return None
    energy = energy_of(record)
    loss, error = damper_loss(record)
    balance = energy.total - energy.total[:, :1] - input_work(record) + loss
    if record.scene.contacts:
        balance[:, 1:] = summed(np.diff(balance, axis=1)[..., None], flights)[..., 0]
    note = ""
    if record.mechanism.springs and np.nanmax(error, initial=0.0) > 0:
        note = f"damper work known to {np.nanmax(error / energy.scale):.1g} of the scale"
    parts = (np.abs(balance) / energy.scale[:, None])[..., None]
    return Figures(parts, note=note, uncertainty=error / energy.scale)


@functools.lru_cache(maxsize=1)
def energy_of(record: Record) -> Energy:
    """Compute kinetic and potential energy at every frame."""
    mechanism, bodies = record.mechanism, record.bodies
    gravity = np.array(record.scene.gravity)
    moving = np.einsum("tfbi,tfbi->tfb", bodies.velocity, bodies.velocity)
    turning = np.einsum("tfbi,tfbi->tfb", record.spin, record.turning)
    kinetic = 0.5 * (mechanism.mass * moving + turning)
    weight = -mechanism.mass * (bodies.position @ gravity)
    stored = np.zeros(record.finite.shape)
    if mechanism.springs:
        stretch = pair_distance(bodies.with_world(), mechanism.springs)
        stretch = stretch - [spring.length for spring in mechanism.springs]
        stored = 0.5 * stretch**2 @ np.array([spring.stiffness for spring in mechanism.springs])
    floor = _FLOOR * float(mechanism.mass.sum()) * record.usual_pull * record.scene.length
    return Energy(np.concatenate([kinetic, weight], axis=-1), stored, floor)


@functools.lru_cache(maxsize=1)
def input_work(record: Record) -> Array:
    """Work of forces and torques from frame 0 on [J], shape (trajectory, frame).

    Inputs are constant over a step, so a step's work is exactly F·Δx + τ·Δθ.
    """
    moved = np.diff(record.bodies.position, axis=1)
    steps = moved.shape[1]
    work = np.einsum("tsbi,tsbi->ts", record.batch.force[:, :steps], moved)
    if record.mechanism.hinges:
        work += np.sum(record.batch.torque[:, :steps] * hinge_turns(record), axis=2)
    return np.concatenate([np.zeros((len(work), 1)), np.cumsum(work, axis=1)], axis=1)


@functools.lru_cache(maxsize=1)
def hinge_turns(record: Record) -> Array:
    """Angles by which the hinges turn over each step [rad], shape (trajectory, step, hinge).

    A frame gives a hinge's angle up to full turns; the mean of the hinge rates at the two ends
    of the step chooses among them.
    """
    bodies, rates = record.bodies, hinge_rates(record)
    turns = []
    for k, joint in enumerate(record.mechanism.hinges):
        turn = np.diff(joint_coordinate(joint, bodies.position, bodies.native), axis=1)
        expected = 0.5 * (rates[:, 1:, k] + rates[:, :-1, k]) * record.frame
        turns.append(turn + 2 * np.pi * np.round((expected - turn) / (2 * np.pi)))
    return np.stack(turns, axis=-1)


@functools.lru_cache(maxsize=1)
def hinge_rates(record: Record) -> Array:
    """Angular velocities across the hinges [rad/s], shape (trajectory, frame, hinge)."""
    world, rates = record.bodies.with_world(), []
    for joint in record.mechanism.hinges:
        axis = rotation.rotate(world.native[..., joint.parent, :], joint.axis)
        spin = world.angular_velocity
        rates.append(np.sum((spin[..., joint.child, :] - spin[..., joint.parent, :]) * axis, -1))
    return np.stack(rates, axis=-1)


@functools.lru_cache(maxsize=1)
def damper_loss(record: Record) -> tuple[Array, Array]:
    """Energy taken by dampers [J], shape (trajectory, frame), and its error, (trajectory,).

    Simpson's rule on the frames; the error is its change when every other frame is left out.
    """
    damping = np.array([spring.damping for spring in record.mechanism.springs])
    if not damping.any():
        return np.zeros(record.finite.shape), np.zeros(len(record.finite))
    from scipy.integrate import cumulative_simpson  # takes long to import

    power = pair_rate(record.bodies.with_world(), record.mechanism.springs) ** 2 @ damping
    loss = cumulative_simpson(power, dx=record.frame, axis=1, initial=0.0)
    if record.steps < 4:
        return loss, np.nanmax(np.abs(loss), axis=1, initial=0.0)
    coarse = cumulative_simpson(power[:, ::2], dx=2 * record.frame, axis=1, initial=0.0)
    return loss, np.nanmax(np.abs(coarse - loss[:, ::2]), axis=1, initial=0.0)

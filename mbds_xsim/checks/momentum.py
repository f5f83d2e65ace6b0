"""Does momentum change by the impulses of forces, gravity and torques, and by nothing else?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.flight import flying, summed
from mbds_xsim.checks.supports import Balance, balances_of
from mbds_xsim.mechanism import WORLD_INDEX

__all__ = ["momentum"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FLOOR = 1e-3
_EARTH = 9.81  # sets the floor of scenes without gravity [m/s²]


def momentum(record: Record) -> Finding | None:
    """Measure the change of momentum less impulses over its scale; None if supports touch all.

    Forces are held over each step, so linear impulses are exact. Those of moments are integrals of
    places, by the cubic that meets the places and velocities at both ends of the step; their error
    is the finding's uncertainty. With contact, periods of flight are looked at.
    """
    balances = balances_of(record.mechanism)
    flights = [
        flying(record.mechanism, record.bodies, record.frame, balance.bodies)
        for balance in balances
    ]
    seen = [pair for pair in zip(balances, flights, strict=True) if pair[1].any()]
    if not seen:
        return None
    parts, errors = zip(*(_unbalanced(record, *pair) for pair in seen), strict=True)
    uncertainty = np.max(errors, axis=0)
    return Finding.of(
        "momentum",
        "1",
        np.stack(parts, axis=-1),
        budget=record.energy_budget,
        names=tuple(balance.name for balance, _ in seen),
        uncertainty=uncertainty,
        note=f"impulses known to {uncertainty.max():.1g} of the scale",
    )


def _unbalanced(record: Record, balance: Balance, flights: Mask) -> tuple[Array, Array]:
    """Change less impulses over the scale, (trajectory, frame), and its error, (trajectory,)."""
    bodies = _rows(balance)
    state, scale = (_angular if balance.angular else _linear)(record, balance)
    load = record.batch.force[:, : record.steps, bodies]
    load = load + record.mechanism.mass[bodies, None] * np.array(record.scene.gravity)
    impulse, blur = _total(load) * record.frame, np.zeros(load.shape[:2])
    if balance.angular:
        impulse, blur = _moments(record, balance, load)
    left = (np.diff(state, axis=1) - impulse) @ balance.directions.T
    drift = rotation.norm(summed(left, flights))
    error = np.where(np.isfinite(blur) & flights, blur, 0.0).sum(axis=1)
    found = np.concatenate([np.zeros((len(drift), 1)), drift], axis=1)
    found[~record.finite] = np.nan
    return found / scale[:, None], error / scale


def _linear(record: Record, balance: Balance) -> tuple[Array, Array]:
    bodies, mass = _rows(balance), record.mechanism.mass[_rows(balance)]
    each = mass[:, None] * record.bodies.velocity[:, :, bodies]
    return _total(each), _scale(record, balance, each, 1.0)


def _angular(record: Record, balance: Balance) -> tuple[Array, Array]:
    """Angular momentum about the balance's point, (trajectory, frame, 3), and its scale."""
    mechanism, states, bodies = record.mechanism, record.bodies, _rows(balance)
    mass, velocity = mechanism.mass[bodies], states.velocity[:, :, bodies]
    drift = 0.0 if balance.about is not None else _mean(mass, velocity)
    carried = rotation.cross(_arms(record, balance), mass[:, None] * (velocity - drift))
    own = rotation.rotate(states.native[:, :, bodies], record.turning[:, :, bodies])
    each = own + carried
    return _total(each), _scale(record, balance, each, record.scene.length)


def _scale(record: Record, balance: Balance, each: Array, arm: float) -> Array:
    """Largest sum of the bodies' own momenta, shape (trajectory,).

    At least 1e-3 of what the group has at the speed of a fall through the scene's length.
    """
    sizes = rotation.norm(each).sum(axis=2)
    pull = float(np.linalg.norm(record.scene.gravity)) or _EARTH
    speed = np.sqrt(pull * record.scene.length)
    floor = _FLOOR * float(record.mechanism.mass[_rows(balance)].sum()) * speed * arm
    return np.maximum(np.nanmax(sizes, axis=1, initial=0.0), floor)


def _moments(record: Record, balance: Balance, load: Array) -> tuple[Array, Array]:
    """Impulses of moments over each step, (trajectory, step, 3), and errors, (trajectory, step).

    Momenta of lagging velocities lag too, by the moments at the two ends.
    """
    arm = _arms(record, balance)
    speed = record.bodies.velocity[:, :, _rows(balance)]
    if balance.about is None:
        speed = speed - _mean(record.mechanism.mass[_rows(balance)], speed)
    frame = record.frame
    held = frame / 2 * (arm[:, 1:] + arm[:, :-1]) + frame**2 / 12 * (speed[:, :-1] - speed[:, 1:])
    held = held + record.lag * (arm[:, 1:] - arm[:, :-1])
    impulse = _total(rotation.cross(held, load)) + frame * _driving(record, balance)
    # What a parabola leaves of the step's displacement shows the third derivative of the place;
    # the integral is off by H⁵/720 of the fourth.
    bend = np.diff(arm, axis=1) - frame / 2 * (speed[:, 1:] + speed[:, :-1])
    change = np.diff(bend, axis=1, prepend=bend[:, 1:2] if bend.shape[1] > 1 else 0.0)
    error = frame / 60 * rotation.norm(change) * rotation.norm(load)
    return impulse, error.sum(axis=2)


def _driving(record: Record, balance: Balance) -> Array:
    """Moments of driven hinges between the group and the world [N·m], (trajectory, step, 3)."""
    moment = np.zeros((len(record.batch), record.steps, 3))
    for k, joint in enumerate(record.mechanism.hinges):
        torque = record.batch.torque[:, : record.steps, k, None] * joint.axis
        if joint.parent == WORLD_INDEX and joint.child in balance.bodies:
            moment += torque
        if joint.child == WORLD_INDEX and joint.parent in balance.bodies:
            moment -= torque
    return moment


def _arms(record: Record, balance: Balance) -> Array:
    """Centres of mass from the balance's point [m], shape (trajectory, frame, body, 3)."""
    places = record.bodies.position[:, :, _rows(balance)]
    if balance.about is not None:
        return places - balance.about
    return places - _mean(record.mechanism.mass[_rows(balance)], places)


def _rows(balance: Balance) -> slice | list[int]:
    """Where the group's bodies are; a slice, which copies nothing, where they follow each other."""
    first, last = balance.bodies[0], balance.bodies[-1]
    if balance.bodies == tuple(range(first, last + 1)):
        return slice(first, last + 1)
    return list(balance.bodies)


def _total(each: Array) -> Array:
    """Sum over the bodies, shape (trajectory, frame, 3): as numpy's sum, in a fifth of its time."""
    return np.asarray(np.einsum("tfbi->tfi", each))


def _mean(mass: Array, values: Array) -> Array:
    return np.einsum("b,tfbi->tfi", mass / mass.sum(), values)[:, :, None]

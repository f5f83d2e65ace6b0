"""Effective inertia of the spanning tree's joints at a pose, with loops open; vectorised.

Joints that follow others do not count as free or held, except in `mass_matrix`.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import constraint_rows, dense_jacobian
from mbds_xsim.scene.coupling import trains
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint

_POSES = 32
_INDEPENDENT = 1e-9


def moved_inertias(
    mechanism: Mechanism, joints: Sequence[PlacedJoint], bodies: BodyStates
) -> tuple[Array, Array]:
    """Return the effective inertia of hinges and sliders of the tree [kg·m² or kg].

    Returns:
        Inertia against a torque or force on the coordinate, with all other coordinates free, and
        with all others held, which is larger; shapes (…, joint).
    """
    mass, _ = mass_matrix(mechanism, bodies)
    rates = _independent(mechanism)
    mass, own = rates.T @ mass @ rates, rates[_numbers(mechanism, joints)]
    alone = np.diagonal(mass, axis1=-2, axis2=-1)
    yields = np.einsum("ji,...ik,jk->...j", own, np.linalg.inv(mass), own)
    return 1.0 / yields, 1.0 / (1.0 / alone @ (own**2).T)


def closed_inertias(mechanism: Mechanism, joints: Sequence[PlacedJoint]) -> Array:
    """Return the effective inertia at the scene's start, with loops closed, shape (joint,)."""
    start, rates = assemble(mechanism), _independent(mechanism)
    mass, moving = mass_matrix(mechanism, start)
    twists = np.concatenate([moving.velocity, moving.angular_velocity], axis=-1)
    jacobian = dense_jacobian(constraint_rows(mechanism, start), mechanism.body_count)
    _, size, ways = np.linalg.svd(jacobian @ twists.reshape(len(twists), -1).T @ rates)
    rates = rates @ ways[int((size > _INDEPENDENT * size.max(initial=0.0)).sum()) :].T
    own = rates[_numbers(mechanism, joints)]
    yields = np.einsum("ji,ik,jk->j", own, np.linalg.inv(rates.T @ mass @ rates), own)
    return np.asarray(1.0 / np.maximum(yields, np.finfo(float).tiny))


def kicks(
    mechanism: Mechanism, joints: Sequence[PlacedJoint], bodies: BodyStates
) -> tuple[Array, Array]:
    """Return the bodies' velocity changes due to an impulse that changes a joint's rate by 1.

    Returns:
        Changes of velocities and angular velocities in W, [m/s] and [rad/s] per unit of the rate,
        shapes (…, joint, body, 3).
    """
    mass, moving = mass_matrix(mechanism, bodies)
    numbers, rates = _numbers(mechanism, joints), _independent(mechanism)
    inverse = (rates @ np.linalg.inv(rates.T @ mass @ rates) @ rates.T)[..., numbers]
    share = inverse / np.diagonal(inverse[..., numbers, :], axis1=-2, axis2=-1)[..., None, :]
    linear, angular = (
        np.einsum("...dj,...dbi->...jbi", share, values)
        for values in (moving.velocity, moving.angular_velocity)
    )
    return linear, angular


def poses(mechanism: Mechanism) -> BodyStates:
    """Return the scene's start, then random poses of hinges and limited sliders."""
    start = to_links(
        mechanism, assemble(mechanism).each(lambda values: np.stack([values] * _POSES))
    )
    chance = np.random.default_rng(0).random(start.coordinate.shape)
    for k, link in enumerate(mechanism.links):
        joint = link.joint
        if joint is not None and (joint.limits or joint.kind == "hinge"):
            low, high = joint.limits or (-np.pi, np.pi)
            start.coordinate[1:, k] = low + (high - low) * chance[1:, k]
    return to_bodies(mechanism, start)


def mass_matrix(
    mechanism: Mechanism, bodies: BodyStates, moved: Container[int] | None = None
) -> tuple[Array, BodyStates]:
    """Return the mass matrix of the tree's freedoms, and the body motions at their unit rates.

    Shapes are (…, freedom, freedom) and (…, freedom, body, …). Given some bodies, only the freedoms
    between them and their tree parents count.
    """
    freedoms = [
        (field, place)
        for field, place in _freedoms(mechanism)
        if moved is None or mechanism.links[place[0]].body in moved
    ]
    spread = bodies.each(lambda values: np.repeat(values[..., None, :, :], len(freedoms), axis=-3))
    links = to_links(mechanism, spread)
    for values in (links.rate, links.angular_velocity, links.velocity):
        values[...] = 0.0
    for number, (field, place) in enumerate(freedoms):
        getattr(links, field)[(..., number, *place)] = 1.0
    moving = to_bodies(mechanism, links)
    spin = rotation.rotate(rotation.conjugate(moving.native), moving.angular_velocity)
    momenta = (
        mechanism.mass[:, None] * moving.velocity,
        (spin[..., None, :] @ mechanism.inertia)[..., 0, :],
    )
    mass = _products(moving.velocity, momenta[0]) + _products(spin, momenta[1])
    armature = [link.joint.armature if link.joint else 0.0 for link in mechanism.links]
    rotors = [armature[place[0]] if field == "rate" else 0.0 for field, place in freedoms]
    return mass + np.diag(rotors), moving


def _products(rates: Array, momenta: Array) -> Array:
    """Return the sums over bodies of products of all pairs of freedoms, (…, freedom, freedom)."""
    flat = (*rates.shape[:-2], rates.shape[-2] * rates.shape[-1])  # -1 has no meaning without any
    return np.asarray(rates.reshape(flat) @ np.swapaxes(momenta.reshape(flat), -1, -2))


def _freedoms(mechanism: Mechanism) -> list[tuple[str, tuple[int, ...]]]:
    """List the tree's freedoms as fields of `LinkStates` with indices into them."""
    freedoms: list[tuple[str, tuple[int, ...]]] = []
    for k, link in enumerate(mechanism.links):
        kind = link.joint.kind if link.joint else "free"
        if kind in ("hinge", "slider"):
            freedoms.append(("rate", (k,)))
        if kind in ("ball", "free"):
            freedoms += [("angular_velocity", (k, i)) for i in range(3)]
        if kind == "free":
            freedoms += [("velocity", (k, i)) for i in range(3)]
    return freedoms


def _independent(mechanism: Mechanism) -> Array:
    """Return the rates of all freedoms at unit rates of those that follow none, as columns."""
    rates = np.eye(len(_freedoms(mechanism)))
    gears = [each for led in trains(mechanism.couplings).values() for each in led]
    followers = _numbers(mechanism, [each.follower for each in gears])
    leaders = _numbers(mechanism, [each.leader for each in gears])
    rates[followers, leaders] = [each.ratio for each in gears]
    return np.delete(rates, followers, axis=1)


def _numbers(mechanism: Mechanism, joints: Sequence[PlacedJoint]) -> list[int]:
    """Find the freedoms that are the joints' coordinates."""
    link = {link.joint.index: k for k, link in enumerate(mechanism.links) if link.joint}
    freedoms = _freedoms(mechanism)
    return [freedoms.index(("rate", (link[joint.index],))) for joint in joints]

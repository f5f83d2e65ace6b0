"""The reference's equations of motion, against the constraint rows of the core."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import accelerations
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.scene.constraints import constraint_rows, dense_jacobian
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import DistanceLink, Scene
from mbds_xsim.simulate.registry import load_scene
from tests.learn.mechanisms import every_joint

BATCH = 3


def everything() -> Scene:
    """A tree with every joint kind, a distance link, a spring and skew inertias."""
    link = DistanceLink("d", ("b4", "world"), ((4.0, 0.0, 0.0), (4.0, 2.0, 1.0)))
    return msgspec.structs.replace(every_joint(), distance_links=(link,))


SCENES = [everything(), load_scene("2ladder"), load_scene("5pendulum")]


def any_states(mechanism: Mechanism) -> BodyStates:
    """Draw random states, which do not keep joints together."""
    rng, shape = np.random.default_rng(5), (BATCH, mechanism.body_count)
    return BodyStates(
        rng.standard_normal((*shape, 3)),
        turns(rng, shape),
        rng.standard_normal((*shape, 3)),
        rng.standard_normal((*shape, 3)),
    )


def tree_states(mechanism: Mechanism) -> BodyStates:
    """Draw random states that keep the joints of the tree together."""
    rng, shape = np.random.default_rng(6), (BATCH, mechanism.body_count)
    return to_bodies(
        mechanism,
        LinkStates(
            turns(rng, shape),
            rng.standard_normal((*shape, 3)),
            rng.uniform(-1.0, 1.0, shape),
            rng.standard_normal(shape),
            rng.standard_normal((*shape, 3)),
            rng.standard_normal((*shape, 3)),
        ),
    )


def turns(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    native = rng.standard_normal((*shape, 4))
    return np.asarray(native / np.linalg.norm(native, axis=-1, keepdims=True))


def inputs(mechanism: Mechanism) -> tuple[Array, Array]:
    rng = np.random.default_rng(7)
    return (
        rng.standard_normal((BATCH, mechanism.body_count, 3)),
        rng.standard_normal((BATCH, len(mechanism.hinges))),
    )


def applied(mechanism: Mechanism, bodies: BodyStates, force: Array, torque: Array) -> Array:
    """Generalised forces on one state, body by body: force, then moment; shape (6 · body,)."""
    turn = rotation.matrix(bodies.native)
    tensor = turn @ mechanism.inertia @ np.swapaxes(turn, -1, -2)
    load = np.zeros((mechanism.body_count + 1, 6))
    load[:-1, :3] = mechanism.mass[:, None] * np.array(mechanism.scene.gravity) + force
    w = bodies.angular_velocity
    load[:-1, 3:] = -np.cross(w, np.einsum("nij,nj->ni", tensor, w))
    for hinge, value in zip(mechanism.hinges, torque, strict=True):
        axis = hinge.axis
        if hinge.parent >= 0:
            axis = rotation.rotate(bodies.native[hinge.parent], axis)
        load[hinge.child, 3:] += value * axis
        load[hinge.parent, 3:] -= value * axis
    for spring in mechanism.springs:
        a, b = spring.bodies
        arm = [
            rotation.rotate(bodies.native[k], p)
            for k, p in zip((a, b), spring.in_body, strict=True)
        ]
        apart = bodies.position[b] + arm[1] - bodies.position[a] - arm[0]
        rate = bodies.velocity[b] + np.cross(w[b], arm[1]) - bodies.velocity[a]
        rate -= np.cross(w[a], arm[0])
        distance = np.linalg.norm(apart)
        along = apart / distance
        tension = spring.stiffness * (distance - spring.length) + spring.damping * (along @ rate)
        for body, r, sign in ((a, arm[0], 1.0), (b, arm[1], -1.0)):
            load[body] += np.concatenate(
                [sign * tension * along, np.cross(r, sign * tension * along)]
            )
    return load[:-1].reshape(-1)


def one(bodies: BodyStates, k: int) -> BodyStates:
    return BodyStates(*(getattr(bodies, f.name)[k] for f in dataclasses.fields(bodies)))


def rows_at(mechanism: Mechanism, bodies: BodyStates) -> tuple[Array, Array, Array]:
    rows = constraint_rows(mechanism, bodies)
    return rows.residual, dense_jacobian(rows, mechanism.body_count), rows.bias


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_residuals_are_those_of_the_core(scene: Scene) -> None:
    mechanism = Mechanism.of(scene)
    bodies = any_states(mechanism)
    dynamics = dynamics_of(mechanism)
    ours = dynamics.residual(dynamics.pack(bodies))
    np.testing.assert_allclose(ours, rows_at(mechanism, bodies)[0], rtol=0, atol=1e-13)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_accelerations_solve_the_dense_saddle_point_system(scene: Scene) -> None:
    """States are off the constraints, where every term of the bias and the Jacobian counts."""
    mechanism = Mechanism.of(scene)
    bodies, (force, torque) = any_states(mechanism), inputs(mechanism)
    jacobian, bias, ours = _accelerated(mechanism, bodies)
    turn = rotation.matrix(bodies.native)
    tensor = turn @ mechanism.inertia @ np.swapaxes(turn, -1, -2)
    size, rows = 6 * mechanism.body_count, len(bias[0])
    for k in range(BATCH):
        system = np.zeros((size + rows, size + rows))
        for body in range(mechanism.body_count):
            at = 6 * body
            system[at : at + 3, at : at + 3] = mechanism.mass[body] * np.eye(3)
            system[at + 3 : at + 6, at + 3 : at + 6] = tensor[k, body]
        system[size:, :size], system[:size, size:] = jacobian[k], jacobian[k].T
        load = applied(mechanism, one(bodies, k), force[k], torque[k])
        expected = np.linalg.solve(system, np.concatenate([load, -bias[k]]))[:size]
        np.testing.assert_allclose(ours[k], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_accelerations_keep_the_constraints(scene: Scene) -> None:
    mechanism = Mechanism.of(scene)
    jacobian, bias, ours = _accelerated(mechanism, tree_states(mechanism))
    broken = np.einsum("brk,bk->br", jacobian, ours) + bias
    assert np.abs(broken).max() < 1e-11 * np.abs(ours).max()


def _accelerated(mechanism: Mechanism, bodies: BodyStates) -> tuple[Array, Array, Array]:
    """Return the rows' Jacobian and bias, and the accelerations, shape (trajectory, 6 body)."""
    _, jacobian, bias = rows_at(mechanism, bodies)
    rates = accelerations(mechanism, bodies, *inputs(mechanism))
    return jacobian, bias, np.concatenate(rates, axis=-1).reshape(BATCH, -1)


def test_accelerations_keep_leading_axes() -> None:
    mechanism = Mechanism.of(load_scene("5pendulum"))
    bodies, (force, torque) = tree_states(mechanism), inputs(mechanism)
    flat = accelerations(mechanism, bodies, force, torque)
    stacked = BodyStates(
        *(
            np.stack([getattr(bodies, f.name)] * 2).reshape(2, BATCH, 5, -1)
            for f in dataclasses.fields(bodies)
        )
    )
    deep = accelerations(mechanism, stacked, force, torque)
    for a, b in zip(flat, deep, strict=True):
        assert b.shape == (2, BATCH, 5, 3)
        np.testing.assert_allclose(b[1], a, rtol=0, atol=1e-11)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_projection_reaches_the_constraints(scene: Scene) -> None:
    mechanism = Mechanism.of(scene)
    dynamics = dynamics_of(mechanism)
    bodies = tree_states(mechanism)
    state = dynamics.pack(bodies)
    if mechanism.loops or mechanism.distances:
        start = np.zeros_like(bodies.velocity)
        native = np.broadcast_to(rotation.IDENTITY, bodies.native.shape)
        state = dynamics.pack(BodyStates(start + mechanism.com, native, start, start))
    rng = np.random.default_rng(1)
    state[:, :-1] += 1e-6 * rng.standard_normal(state[:, :-1].shape)
    closed = dynamics.unpack(dynamics.project(state))
    residual, jacobian, _ = rows_at(mechanism, closed)
    twist = np.concatenate([closed.velocity, closed.angular_velocity], axis=-1)
    rate = np.einsum("brk,bk->br", jacobian, twist.reshape(BATCH, -1))
    assert np.abs(residual).max() < 1e-10
    assert np.abs(rate).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(closed.native, axis=-1), 1.0, rtol=0, atol=1e-15)


def test_a_state_that_is_none_has_no_accelerations_and_ends_nothing() -> None:
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, [0, 1])
    dynamics = dynamics_of(Mechanism.of(scene))
    facing = Mechanism.of(scene).native_rotation(batch.orientation)
    bodies = BodyStates(batch.position, facing, batch.velocity, batch.angular_velocity)
    state = dynamics.pack(bodies)
    state[0, 1, 3:7] = np.nan
    rate = dynamics.derivative(state, batch.force[:, 0], batch.torque[:, 0])

    assert np.isnan(rate[0]).any()
    assert np.isfinite(rate[1]).all()

"""Rows of constraints against finite differences, for all kinds, at any state."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.sparse import csr_array

from benchmarks.four_bars import four_bars
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene import row_space
from mbds_xsim.scene.constraints import (
    constraint_rows,
    degrees_of_freedom,
    dense_jacobian,
)
from mbds_xsim.scene.joint_space import BodyStates, to_bodies
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from tests.random_scenes import Kind, random_links, random_tree

KINDS: tuple[Kind, ...] = ("fixed", "hinge", "slider", "ball")
ROWS = {"fixed": 6, "hinge": 5, "slider": 5, "ball": 3}


def _random_states(rng: np.random.Generator, count: int) -> BodyStates:
    """Draw states that keep no constraint: derivatives must hold there as well."""
    native = rng.standard_normal((7, count, 4))
    native /= np.linalg.norm(native, axis=-1, keepdims=True)
    x, v, w = rng.standard_normal((3, 7, count, 3))
    return BodyStates(x, native, v, w)


def _moved(states: BodyStates, time: float) -> BodyStates:
    """Move the states on at constant velocities."""
    turn = rotation.from_vector(time * states.angular_velocity)
    return dataclasses.replace(
        states,
        position=states.position + time * states.velocity,
        native=rotation.multiply(turn, states.native),
    )


def _rate(mechanism: Mechanism, states: BodyStates) -> Array:
    jacobian = dense_jacobian(constraint_rows(mechanism, states), mechanism.body_count)
    twist = np.concatenate([states.velocity, states.angular_velocity], axis=-1)
    return np.einsum("...ij,...j->...i", jacobian, twist.reshape(*twist.shape[:-2], -1))


@pytest.fixture(params=[*KINDS, "distance link", "all"])
def mechanism(request: pytest.FixtureRequest) -> Mechanism:
    rng = np.random.default_rng(3)
    if request.param == "all":
        return Mechanism.of(random_tree(rng, KINDS * 2, links=3))
    if request.param == "distance link":
        return Mechanism.of(random_tree(rng, ("free",) * 3, links=3))
    return Mechanism.of(random_tree(rng, (request.param,) * 3))


def test_jacobian_is_the_rate_of_the_residual(mechanism: Mechanism) -> None:
    states, step = _random_states(np.random.default_rng(5), mechanism.body_count), 1e-5

    ahead, behind = (constraint_rows(mechanism, _moved(states, t)).residual for t in (step, -step))

    assert ahead.shape[-1] > 0
    np.testing.assert_allclose(
        _rate(mechanism, states), (ahead - behind) / (2 * step), rtol=1e-7, atol=1e-7
    )


def test_bias_is_the_second_rate_at_constant_velocities(mechanism: Mechanism) -> None:
    states, step = _random_states(np.random.default_rng(6), mechanism.body_count), 1e-5

    ahead, behind = (_rate(mechanism, _moved(states, t)) for t in (step, -step))

    np.testing.assert_allclose(
        constraint_rows(mechanism, states).bias, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_joint_has_as_many_independent_rows_as_it_takes_freedoms(kind: Kind) -> None:
    mechanism = Mechanism.of(random_tree(np.random.default_rng(9), (kind,)))
    states = to_bodies(mechanism, random_links(np.random.default_rng(1), mechanism, (4,)))

    jacobian = dense_jacobian(constraint_rows(mechanism, states), 1)

    assert jacobian.shape == (4, ROWS[kind], 6)
    assert np.linalg.matrix_rank(jacobian).tolist() == [ROWS[kind]] * 4


def test_rows_vanish_on_states_that_joint_coordinates_make() -> None:
    rng = np.random.default_rng(12)
    mechanism = Mechanism.of(random_tree(rng, KINDS * 3))

    states = to_bodies(mechanism, random_links(rng, mechanism, (20,)))

    assert np.abs(constraint_rows(mechanism, states).residual).max() < 1e-12
    assert np.abs(_rate(mechanism, states)).max() < 1e-11


@pytest.mark.parametrize(
    ("kind", "motion"),
    [
        ("hinge", {"turn": [0.0, 0.3, 0.0]}),
        ("hinge", {"shift": [0.0, 0.0, 0.1]}),
        ("slider", {"turn": [0.0, 0.0, 0.3]}),
        ("slider", {"shift": [0.0, 0.1, 0.0]}),
        ("fixed", {"turn": [0.0, 0.0, 0.3]}),
        ("ball", {"shift": [0.1, 0.0, 0.0]}),
    ],
)
def test_what_a_joint_forbids_shows_in_its_residual(
    kind: Kind, motion: dict[str, list[float]]
) -> None:
    axis = (0.0, 0.0, 1.0) if kind in ("hinge", "slider") else None
    body = Body("body", inertia=Inertia(1.0, (1.0, 1.0, 1.0)))
    joint = Joint("joint", kind, "world", "body", (0.0, 0.0, 0.0), axis)  # type: ignore[arg-type]
    mechanism = Mechanism.of(Scene("scene", (body,), 1.0, joints=(joint,)))
    shift = np.array([motion.get("shift", [0.0, 0.0, 0.0])])
    turn = rotation.from_vector(np.array([motion.get("turn", [0.0, 0.0, 0.0])]))
    still = np.zeros((1, 3))

    residual = constraint_rows(mechanism, BodyStates(shift, turn, still, still)).residual

    size = np.linalg.norm(shift) + np.sin(np.linalg.norm(rotation.to_vector(turn)))
    assert np.linalg.norm(residual) == pytest.approx(size)


def test_owners_name_joint_and_link_of_each_row() -> None:
    mechanism = Mechanism.of(random_tree(np.random.default_rng(4), KINDS, links=2))

    rows = constraint_rows(mechanism, BodyStates.at_reference(mechanism))

    counts = [ROWS[joint.kind] for joint in mechanism.joints] + [1, 1]
    assert np.bincount(rows.owner).tolist() == counts
    assert np.abs(rows.residual).max() < 1e-14


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        (("free",), 6),
        (("ball", "hinge", "slider", "fixed"), 3 + 1 + 1),
        (("free", "free", "ball"), 15),
    ],
)
def test_degrees_of_freedom_of_trees(kinds: tuple[Kind, ...], expected: int) -> None:
    mechanism = Mechanism.of(random_tree(np.random.default_rng(8), kinds))

    assert degrees_of_freedom(mechanism) == expected


def test_many_loops_are_counted_by_a_sparse_factorisation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each four-bar has three redundant rows, which a sparse factorisation counts as well."""
    monkeypatch.setattr(row_space, "qr", None)
    monkeypatch.setattr(csr_array, "toarray", None)
    loops = 300
    mechanism = Mechanism.of(four_bars(loops, 1.0))
    rows = 5 * len(mechanism.joints)

    assert degrees_of_freedom(mechanism) == 1
    assert 6 * mechanism.body_count - rows == 1 - 3 * loops

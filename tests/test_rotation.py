"""Quaternion algebra against scipy's, and where formulas are singular."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array

RNG = np.random.default_rng(20)


def _scipy(q: Array) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def _random(count: int) -> Array:
    q = RNG.standard_normal((count, 4))
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def _same_turn(p: Array, q: Array) -> float:
    """Largest difference of two arrays of quaternions whose sign is free."""
    return float(np.minimum(np.abs(p - q).max(-1), np.abs(p + q).max(-1)).max())


def test_product_matrix_and_turned_vectors_agree_with_scipy() -> None:
    p, q, v = _random(200), _random(200), RNG.standard_normal((200, 3))

    np.testing.assert_allclose(rotation.matrix(q), _scipy(q).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation.rotate(q, v), _scipy(q).apply(v), atol=1e-14)
    assert (
        _same_turn(rotation.multiply(p, q), np.roll((_scipy(p) * _scipy(q)).as_quat(), 1, -1))
        < 1e-14
    )


def test_product_means_second_factor_first() -> None:
    quarter_x = rotation.from_vector(np.array([np.pi / 2, 0.0, 0.0]))
    quarter_z = rotation.from_vector(np.array([0.0, 0.0, np.pi / 2]))
    z = np.array([0.0, 0.0, 1.0])

    # z stays under the turn about z; then the turn about x takes it to −y.
    turned = rotation.rotate(rotation.multiply(quarter_x, quarter_z), z)

    np.testing.assert_allclose(turned, [0.0, -1.0, 0.0], atol=1e-15)


def test_conjugate_undoes() -> None:
    q = _random(100)

    np.testing.assert_allclose(
        rotation.multiply(q, rotation.conjugate(q)),
        np.tile(rotation.IDENTITY, (100, 1)),
        atol=1e-15,
    )


def test_matrices_come_back_at_half_turns_too() -> None:
    half_turns = np.concatenate([np.zeros((50, 1)), RNG.standard_normal((50, 3))], axis=-1)
    half_turns /= np.linalg.norm(half_turns, axis=-1, keepdims=True)
    q = np.concatenate([_random(200), half_turns, np.eye(4)])

    back = rotation.from_matrix(rotation.matrix(q))

    assert _same_turn(back, q) < 1e-14


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-6, 0.1, 3.0, np.pi])
def test_rotation_vectors_come_back(size: float) -> None:
    axes = RNG.standard_normal((50, 3))
    v = size * axes / np.linalg.norm(axes, axis=-1, keepdims=True)

    q = rotation.from_vector(v)

    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, atol=1e-15)
    back = rotation.to_vector(q)
    off = np.minimum(
        np.abs(back - v).max(-1), np.abs(back + v).max(-1) if size == np.pi else np.inf
    )
    assert off.max() <= 1e-14 * max(size, 1e-290)


def test_rotation_vectors_are_the_short_way_and_agree_with_scipy() -> None:
    q = _random(200)

    v = rotation.to_vector(q)

    np.testing.assert_allclose(v, _scipy(q).as_rotvec(), atol=1e-13)
    np.testing.assert_array_equal(rotation.to_vector(-q), v)


def test_frames_follow_each_other_whatever_signs_an_engine_gives() -> None:
    rng = np.random.default_rng(4)
    steps = rotation.from_vector(0.1 * rng.normal(size=(2, 30, 3, 3)))
    smooth = np.empty((2, 30, 3, 4))
    smooth[:, 0] = steps[:, 0]
    for k in range(1, 30):
        smooth[:, k] = rotation.multiply(steps[:, k], smooth[:, k - 1])
    smooth[1, 20:] = np.nan
    signs = rng.choice([-1.0, 1.0], size=(2, 30, 3, 1))

    np.testing.assert_array_equal(rotation.continuous(signs * smooth, smooth[:, 0]), smooth)
    assert rotation.continuous(smooth, smooth[:, 0]) is smooth


def test_between_turns_one_direction_into_the_other_the_short_way() -> None:
    a, b = RNG.standard_normal((2, 100, 3))

    q = rotation.between(a, b)

    unit_a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    unit_b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    np.testing.assert_allclose(rotation.rotate(q, unit_a), unit_b, atol=1e-14)
    angle = np.linalg.norm(rotation.to_vector(q), axis=-1)
    np.testing.assert_allclose(np.cos(angle), np.sum(unit_a * unit_b, axis=-1), atol=1e-14)


@pytest.mark.parametrize("angle", [-3.1, -1.0, -1e-9, 0.0, 1e-9, 0.5, 3.1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angle_about_an_axis_has_its_sign(angle: float, sign: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0

    q = sign * rotation.from_vector(angle * axis)

    assert rotation.angle_about(q, axis) == pytest.approx(angle, abs=1e-15)
    assert rotation.angle_about(q, -axis) == pytest.approx(-angle, abs=1e-15)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_half_a_turn_counts_as_plus_pi(sign: float) -> None:
    q = sign * np.array([0.0, 0.0, 0.0, 1.0])

    assert rotation.angle_about(q, np.array([0.0, 0.0, 1.0])) == pytest.approx(np.pi)
    assert rotation.angle_about(q, np.array([0.0, 0.0, -1.0])) == pytest.approx(np.pi)


def test_rounding_does_not_make_minus_pi_of_pi() -> None:
    axes = RNG.standard_normal((1000, 3))
    axes /= rotation.norm(axes)[:, None]
    before = rotation.from_vector(RNG.standard_normal((1000, 3)))
    after = rotation.multiply(before, rotation.from_vector(np.pi * axes))

    angle = rotation.angle_about(rotation.multiply(rotation.conjugate(before), after), axes)
    np.testing.assert_allclose(angle, np.pi, rtol=0, atol=1e-14)
    short = rotation.from_vector((2e-9 - np.pi) * axes)
    assert (rotation.angle_about(short, axes) < 0).all()


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), [1.0, 1.0, 1.0], [1e-9, 0.0, 5.0]])
def test_normals_make_a_right_handed_triad(axis: list[float]) -> None:
    first, second = rotation.normal_to(np.array(axis))

    triad = np.array([first, second, np.array(axis) / np.linalg.norm(axis)])

    np.testing.assert_allclose(triad @ triad.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(triad) == pytest.approx(1.0)


def test_cross_products_are_numpy_s_bit_for_bit() -> None:
    rng = np.random.default_rng(5)
    for a, b in (((3,), (3,)), ((7, 4, 3), (3,)), ((1, 4, 3), (7, 1, 3)), ((0, 3), (3,))):
        one, other = rng.standard_normal(a), rng.standard_normal(b)
        assert np.array_equal(rotation.cross(one, other), np.cross(one, other))

"""The impulses that Coulomb's law allows, and the best of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.balance import Cones, unexplained

_EDGES = 361


def _cones(draw: np.random.Generator, count: int, spheres: int) -> Cones:
    """Draw cones of spheres that may stick or that slip, with arcs of any width."""
    angle = draw.uniform(-np.pi, np.pi, (count, spheres))
    least = np.where(
        draw.random(angle.shape) < 0.5, np.cos(draw.uniform(0.0, 3.0, angle.shape)), -1.0
    )
    return Cones(0.43, np.stack([np.cos(angle), np.sin(angle)], axis=-1), least)


def _edges(cones: Cones) -> Array:
    """Impulses of unit push along each arc, shape (step, sphere, edge, 3)."""
    middle = np.arctan2(cones.ahead[..., 1], cones.ahead[..., 0])
    half = np.arccos(cones.least)
    angle = middle[..., None] + half[..., None] * np.linspace(-1.0, 1.0, _EDGES)
    around = cones.friction * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([around, np.ones((*angle.shape, 1))], axis=-1)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_nearest_impulse_is_the_best_sum_of_impulses_along_the_arc(seed: int) -> None:
    draw = np.random.default_rng(seed)
    cones = _cones(draw, 4, 2)
    impulse = draw.normal(size=(4, 2, 3))
    nearest = cones.nearest(impulse)

    edges, far = _edges(cones).reshape(8, _EDGES, 3), impulse.reshape(8, 3)
    least = [nnls(edges[k].T, far[k])[1] for k in range(8)]
    assert np.linalg.norm(far - nearest.reshape(8, 3), axis=1) == pytest.approx(least, abs=5e-4)
    assert cones.nearest(nearest) == pytest.approx(nearest, abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_is_left_over_is_the_least_that_can_be(seed: int) -> None:
    draw = np.random.default_rng(seed)
    cones = _cones(draw, 5, 3)
    columns, given_ = draw.normal(size=(5, 8, 3, 3)), draw.normal(size=(5, 8))
    residual = unexplained(columns, given_, cones)

    for k in range(5):
        pushes = np.einsum("rsi,sei->rse", columns[k], _edges(cones)[k]).reshape(8, -1)
        _, least = nnls(pushes, given_[k])
        assert np.linalg.norm(residual[k]) == pytest.approx(least, abs=5e-4)


def test_nothing_that_is_allowed_is_left_over() -> None:
    draw = np.random.default_rng(3)
    cones = _cones(draw, 50, 4)
    columns = draw.normal(size=(50, 10, 4, 3))
    impulse = cones.nearest(draw.normal((0.0, 0.0, 1.0), size=(50, 4, 3)))
    gained = np.einsum("crsi,csi->cr", columns, impulse)
    residual = unexplained(columns, gained, cones)

    assert np.linalg.norm(residual, axis=1).max() < 1e-6 * np.linalg.norm(gained, axis=1).max()

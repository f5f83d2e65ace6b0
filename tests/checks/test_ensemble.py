"""Two samples from one distribution, and from two."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mbds_xsim.checks import Record
from mbds_xsim.checks.ensemble import compare, compare_runs, features
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene

Array = NDArray[np.float64]


def _pairs(seed: int, count: int = 40, *, noise: float = 1.0) -> tuple[Array, Array]:
    """Draw pairs with common starts and motions of their own."""
    rng = np.random.default_rng(seed)
    start = rng.normal(size=(count, 3))
    one, other = noise * rng.normal(size=(2, count, 3))
    return start + one, start + other


def _p_value(one: Array, other: Array) -> float:
    found = compare(one, other)
    assert found is not None
    return found.p_value


def test_p_values_of_one_distribution_are_even() -> None:
    """As they must be for a test to keep its level."""
    values = np.sort([_p_value(*_pairs(seed, count=20)) for seed in range(200)])

    even = (np.arange(200) + 0.5) / 200
    # Kolmogorov's bound at a level of 1e-3.
    assert np.abs(values - even).max() < 1.95 / np.sqrt(200)


@pytest.mark.parametrize("change", [(1.0, 0.7), (1.4, 0.0)], ids=["spread", "mean"])
def test_two_distributions_are_told_apart(change: tuple[float, float]) -> None:
    one, other = _pairs(0, count=200)
    found = compare(one, change[0] * other + (change[1], 0.0, 0.0))

    assert found is not None
    assert found.p_value < 0.01
    assert 0.0 < found.distance < 0.5


def test_distances_reach_from_zero_to_one() -> None:
    one, _ = _pairs(0)
    same, far = compare(one, one), compare(one, one + 1e9)

    assert same is not None
    assert far is not None
    assert (same.distance, same.p_value, same.count) == (0.0, 1.0, 40)
    assert far.distance == pytest.approx(1.0, abs=1e-6)
    assert far.p_value == pytest.approx(1 / 2000)


def test_the_distance_is_that_of_its_definition() -> None:
    one, other = _pairs(1)
    pooled = np.concatenate([one, other]).std(axis=0)

    def mean(a: Array, b: Array) -> float:
        return float(np.mean([[np.linalg.norm((x - y) / pooled) for y in b] for x in a]))

    expected = 2 * mean(one, other) - mean(one, one) - mean(other, other)
    found = compare(one, other)
    assert found is not None
    assert found.distance == pytest.approx(expected / (2 * mean(one, other)))


def test_the_same_seed_gives_the_same_p_value() -> None:
    one, other = _pairs(2)
    assert compare(one, other) == compare(one, other)
    assert compare(one, other) != compare(one, other, seed=1)


def test_lost_trajectories_are_left_out() -> None:
    one, other = _pairs(3)
    one[:5], other[3:10] = np.nan, np.nan
    found = compare(one, other)
    assert found is not None
    assert found.count == 30
    assert compare(one[:25], other[:25]) is None


def test_features_of_a_fall() -> None:
    """A disc that only falls keeps its size and its place along x."""
    scene = load_scene("balldrop")
    batch = draw_batch(scene, range(2), noise=False)
    motion = Trajectory.empty(0.02 * np.arange(11.0), 2, 1)
    fallen = 0.5 * 9.81 * motion.time**2
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        getattr(motion, name)[:] = getattr(batch, name)[:, None]
    motion.position[..., 2] -= fallen[:, None]
    motion.velocity[..., 2] -= (9.81 * motion.time)[:, None]
    record = Record(scene, batch, motion)
    begin, end = features(record, 0), features(record, 10)

    assert end[:, 2] - begin[:, 2] == pytest.approx(-fallen[10])
    changed = np.delete(end - begin, 2, axis=1)
    assert np.abs(changed).max() < 1e-12
    # The outer ring of 12 is at 4 and √12 radii, the inner one of 6 at 2.
    radius = 0.0392747
    extent = radius * np.sqrt((6 * 16 + 6 * 12 + 6 * 4) / 19)
    assert begin[:, 3] == pytest.approx(extent, rel=1e-4)


def test_runs_that_agree_to_the_end_are_not_compared() -> None:
    scene = load_scene("balldrop")
    batch = draw_batch(scene, range(20))
    one, other = (_resting(batch) for _ in range(2))
    other.position[:8] += 0.5
    assert compare_runs(scene, batch, [one, other]) == {}

    other.position[8:] += 0.5
    found = compare_runs(scene, batch, [one, other])
    assert list(found) == [(0, 1)]
    assert found[0, 1].count == 20
    assert found[0, 1].p_value < 0.05
    assert compare_runs(scene, batch[:19], [one[:19], other[:19]]) == {}


def _resting(batch: Batch) -> Trajectory:
    motion = Trajectory.empty(0.02 * np.arange(3.0), len(batch), 1)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        getattr(motion, name)[:] = getattr(batch, name)[:, None]
    return motion

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import Record, agreement
from mbds_xsim.checks.agreement import compare, compare_runs, features
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene

NAN = np.nan


def test_the_error_is_the_rms_over_particles(tumbling: Any, pendulum: Any) -> None:
    mechanism = Mechanism.of(pendulum.scene)
    position = pendulum.exact.position.copy()
    position[1, 4, 0] += [3e-3, 0.0, 4e-3]
    moved = dataclasses.replace(pendulum.exact, position=position)
    error = agreement.particle_error(mechanism, moved, pendulum.exact)
    assert error.shape == (3, 41)
    assert error[1, 4] == pytest.approx(5e-3 / np.sqrt(3))
    assert np.count_nonzero(error) == 1
    # Without particles the centres of mass count.
    own = agreement.particle_error(
        Mechanism.of(tumbling.scene),
        dataclasses.replace(tumbling.exact, position=tumbling.exact.position + 0.1),
        tumbling.exact,
    )
    assert np.allclose(own, 0.1 * np.sqrt(3))


def test_a_turned_body_shows_in_its_particles() -> None:
    scene = load_scene("1ladder")
    batch = draw_batch(scene, [0])
    one = Trajectory(
        np.zeros(1),
        batch.position[:, None],
        batch.orientation[:, None],
        batch.velocity[:, None],
        batch.angular_velocity[:, None],
        (None,),
    )
    turn = rotation.from_vector(np.array([1e-3, 0.0, 0.0]))
    rung = [body.name for body in scene.bodies].index("rung1")
    orientation = one.orientation.copy()
    orientation[0, 0, rung] = rotation.multiply(orientation[0, 0, rung], turn)
    other = dataclasses.replace(one, orientation=orientation)
    error = agreement.particle_error(Mechanism.of(scene), other, one)
    # Five of 17 particles, at ±0.2, ±0.1 and 0 m from the rung's centre.
    assert error[0, 0] == pytest.approx(1e-3 * np.sqrt(2 * (0.2**2 + 0.1**2) / 17), rel=1e-6)


@given(st.floats(1e-4, 10.0))
def test_the_frame_that_stands_for_1_s_is_the_nearest_but_not_the_start(frame: float) -> None:
    place = agreement.second(frame)
    times = frame * np.array([max(place - 1, 1), place, place + 1])
    assert place >= 1
    assert abs(times[1] - 1.0) <= np.abs(times - 1.0).min() + 1e-9


@pytest.mark.parametrize(("frame", "place"), [(0.4, 2), (0.08, 12), (0.016, 62), (2 / 7, 3)])
def test_the_frame_that_stands_for_1_s_does_not_depend_on_rounding(
    frame: float, place: int
) -> None:
    """Some studies know the interval as a product or difference."""
    near = (frame, np.nextafter(frame, 0.0), np.nextafter(frame, 1.0))
    assert [agreement.second(each) for each in near] == [place] * 3


def test_the_agreement_time_is_the_first_crossing_of_one_per_cent() -> None:
    time = np.array([0.0, 0.1, 0.2, 0.3])
    error = np.array([[0, 0.01, 0.03, 0.0], [0, 0.01, 0.02, 0.02], [0, NAN, NAN, NAN]])
    times = agreement.agreement_time(error, time, length=2.0)
    assert times.tolist() == [pytest.approx(0.2), np.inf, pytest.approx(0.1)]


def test_growth_excuses_only_what_it_explains() -> None:
    growth = np.array([[1.0, 10.0, 50.0, 1e3, 1e6]])
    explained = 1e-4 * growth
    assert agreement.growth_weighted(explained, growth)[0] == pytest.approx(1e-4)
    # A frozen mechanism is far off early, when nothing has grown yet.
    frozen = np.array([[0.0, 0.4, 0.9, 1.0, 1.0]])
    assert agreement.growth_weighted(frozen, growth)[0] == pytest.approx(0.04)
    assert agreement.growth_weighted(np.full((1, 5), NAN), growth)[0] == np.inf
    lost_in_chaos = np.array([[0.0, 0.0, 0.0, NAN, NAN]])
    assert agreement.growth_weighted(lost_in_chaos, growth)[0] == 0.0


def _distances(errors: list[list[float]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Distances of points in the plane of errors."""
    points = np.array(errors)
    return np.asarray(np.linalg.norm(points[:, None] - points[None], axis=-1))


FAMILIES = ["semi-implicit Euler"] * 3 + ["RK4", "generalised-alpha", "reference"]


def test_three_times_the_same_method_is_one_vote() -> None:
    # Three engines of one method agree with each other and are all off: the family is named.
    matrix = _distances([[1.0, 0.0]] * 3 + [[1e-6, 0.0], [0.0, 1e-5], [0.0, 0.0]])
    assert agreement.odd_one_out(matrix, FAMILIES) == (0, 1, 2)
    assert agreement.odd_one_out(matrix, FAMILIES, tolerance=2.0) == ()


def test_the_wrong_model_is_named_beside_a_coarse_family() -> None:
    coarse = [1e-3, 0.0]
    matrix = _distances([coarse, [0.5, 0.5], coarse, [1e-6, 0.0], [0.0, 1e-5], [0.0, 0.0]])
    assert agreement.odd_one_out(matrix, FAMILIES) == (1,)
    matrix = _distances([coarse, coarse, coarse, [0.5, 0.5], [0.0, 1e-5], [0.0, 0.0]])
    assert agreement.odd_one_out(matrix, FAMILIES, tolerance=1e-2) == (3,)


def test_a_wrong_reference_is_named_too() -> None:
    coarse = [1e-3, 0.0]
    matrix = _distances([coarse, coarse, coarse, [0.0, 0.0], [0.0, 1e-5], [0.3, 0.0]])
    assert agreement.odd_one_out(matrix, FAMILIES) == (5,)


def test_nobody_is_named_where_two_stand_against_one_another() -> None:
    matrix = _distances([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    assert agreement.odd_one_out(matrix, ["RK4", "RK4", "reference"]) == ()
    # Two against two: each half has a second family to confirm it.
    matrix = _distances([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    assert (
        agreement.odd_one_out(matrix, ["RK4", "trapezoidal", "implicit Euler", "reference"]) == ()
    )


def test_a_lost_run_is_no_vote(pendulum: Any) -> None:
    lost = dataclasses.replace(pendulum.exact, position=np.full_like(pendulum.exact.position, NAN))
    near = dataclasses.replace(pendulum.exact, position=pendulum.exact.position + 1e-6)
    runs = [pendulum.exact, lost, near]
    matrix = agreement.pairwise(Mechanism.of(pendulum.scene), runs, 25)
    assert np.isnan(matrix[0, 1])
    assert matrix[0, 2] == pytest.approx(1e-6 * np.sqrt(3), rel=1e-3)
    assert agreement.odd_one_out(matrix, ["RK4", "trapezoidal", "reference"]) == ()


def _pairs(seed: int, count: int = 40, *, noise: float = 1.0) -> tuple[Array, Array]:
    """Draw pairs with common starts and motions of their own."""
    rng = np.random.default_rng(seed)
    start = rng.normal(size=(count, 3))
    one, other = noise * rng.normal(size=(2, count, 3))
    return start + one, start + other


def _p_value(one: Array, other: Array) -> float:
    comparison = compare(one, other)
    assert comparison is not None
    return comparison.p_value


def test_p_values_of_one_distribution_are_even() -> None:
    """P-values must be evenly distributed for a test to keep its level."""
    values = np.sort([_p_value(*_pairs(seed, count=20)) for seed in range(200)])

    even = (np.arange(200) + 0.5) / 200
    # Kolmogorov's bound at a level of 1e-3.
    assert np.abs(values - even).max() < 1.95 / np.sqrt(200)


@pytest.mark.parametrize("change", [(1.0, 0.7), (1.4, 0.0)], ids=["spread", "mean"])
def test_two_distributions_are_told_apart(change: tuple[float, float]) -> None:
    one, other = _pairs(0, count=200)
    comparison = compare(one, change[0] * other + (change[1], 0.0, 0.0))

    assert comparison is not None
    assert comparison.p_value < 0.01
    assert 0.0 < comparison.distance < 0.5


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
    comparison = compare(one, other)
    assert comparison is not None
    assert comparison.distance == pytest.approx(expected / (2 * mean(one, other)))


def test_the_same_seed_gives_the_same_p_value() -> None:
    one, other = _pairs(2)
    assert compare(one, other) == compare(one, other)
    assert compare(one, other) != compare(one, other, seed=1)


def test_lost_trajectories_are_left_out() -> None:
    one, other = _pairs(3)
    one[:5], other[3:10] = np.nan, np.nan
    comparison = compare(one, other)
    assert comparison is not None
    assert comparison.count == 30
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
    comparisons = compare_runs(scene, batch, [one, other])
    assert list(comparisons) == [(0, 1)]
    assert comparisons[0, 1].count == 20
    assert comparisons[0, 1].p_value < 0.05
    assert compare_runs(scene, batch[:19], [one[:19], other[:19]]) == {}


def _resting(batch: Batch) -> Trajectory:
    motion = Trajectory.empty(0.02 * np.arange(3.0), len(batch), 1)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        getattr(motion, name)[:] = getattr(batch, name)[:, None]
    return motion

"""Balls that collide: laws of the impacts, conservation, and where no motion is unique."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import FirstImpact, solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import GRAVITY, Ground, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.testing.collision_cases import RADIUS, TWO, Flying, balls, collided, cradle


def _solved(scene: Scene) -> Trajectory:
    return solve(scene, draw_batch(scene, [0]), cache=False)


def _momenta(motion: Trajectory, start: list[Flying]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear and angular momentum, (frame, 3), and kinetic energy, (frame,)."""
    mass, moment = (np.array([getattr(one, key) for one in start]) for key in ("mass", "moment"))
    place, speed, spin = motion.position[0], motion.velocity[0], motion.angular_velocity[0]
    linear = np.einsum("b,fbi->fi", mass, speed)
    turning = np.einsum("b,fbi->fi", moment, spin)
    angular = turning + np.einsum("b,fbi->fi", mass, np.cross(place, speed))
    energy = (mass * np.sum(speed**2, -1) + moment * np.sum(spin**2, -1)).sum(axis=1) / 2
    return linear, angular, energy


@pytest.mark.parametrize("restitution", [0.0, 0.8, 1.0])
@pytest.mark.parametrize("name", TWO)
def test_two_balls_follow_the_formula(name: str, restitution: float) -> None:
    scene = balls(TWO[name], restitution=restitution)
    motion, (exact, _) = _solved(scene), collided(scene, TWO[name])
    assert motion.failures == (None,)
    for key in ("position", "velocity", "angular_velocity"):
        np.testing.assert_allclose(getattr(motion, key), getattr(exact, key), atol=1e-12)


_SPEEDS = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(velocities=st.tuples(*[_SPEEDS] * 4), spins=st.tuples(*[_SPEEDS] * 4))
@settings(max_examples=20, deadline=None)
def test_momentum_stays_and_energy_never_grows(
    velocities: list[tuple[float, float, float]], spins: list[tuple[float, float, float]]
) -> None:
    """Four balls fly at each other from the corners of a square, at any speeds."""
    corners = ((-0.2, -0.2, 0.0), (0.2, -0.2, 0.0), (-0.2, 0.2, 0.0), (0.2, 0.2, 0.0))
    given = [
        Flying(at, (u - 5.0 * at[0], v - 5.0 * at[1], w), spin, 1.0 + k)
        for k, (at, (u, v, w), spin) in enumerate(zip(corners, velocities, spins, strict=True))
    ]
    motion = _solved(balls(given))
    known = np.isfinite(motion.position[0]).all(axis=(1, 2))
    linear, angular, energy = (part[known] for part in _momenta(motion, given))
    assert np.abs(linear - linear[0]).max() < 1e-11
    assert np.abs(angular - angular[0]).max() < 1e-11
    assert np.diff(energy).max(initial=0.0) < 1e-11
    gaps = [
        np.linalg.norm(motion.position[0, known, a] - motion.position[0, known, b], axis=-1)
        for a in range(4)
        for b in range(a)
    ]
    assert min(gap.min() for gap in gaps) > 2.0 * RADIUS - 1e-9


@given(speed=st.floats(0.5, 2.0), apart=st.sampled_from([0.0, 1e-17, 1e-15, 1e-12, 1e-9]))
@settings(deadline=None)
def test_balls_that_graze_go_on_as_they_were(speed: float, apart: float) -> None:
    """Rounding makes the time of a grazing touch a double root, or no root."""
    passing = Flying((-0.3, 2.0 * RADIUS + apart, 0.0), (speed, 0.0, 0.0))
    motion = _solved(balls([passing, Flying((0.0, 0.0, 0.0))]))
    np.testing.assert_allclose(motion.velocity[0, -1], motion.velocity[0, 0], atol=1e-6)


def test_smooth_elastic_balls_keep_their_energy_and_spin() -> None:
    start = list(TWO["slides"])
    motion = _solved(balls(start, friction=0.0, restitution=1.0))
    energy = _momenta(motion, start)[2]
    assert np.ptp(energy) < 1e-12
    assert np.ptp(motion.angular_velocity[0], axis=0).max() < 1e-12
    assert np.ptp(motion.velocity[0, :, 0], axis=0).max() > 1.0


def test_forces_bend_the_paths_to_an_impact() -> None:
    """A force drives a ball from rest onto another: it hits at √(2 s / a), with √(2 s a)."""
    still, driven = Flying((0.5, 0.0, 0.0), mass=2.0), Flying((0.0, 0.0, 0.0))
    scene = balls([driven, still], friction=0.0, restitution=1.0, steps=60)
    batch = draw_batch(scene, [0])
    force = np.zeros_like(batch.force)
    force[0, :, 0, 0] = 2.0
    motion = solve(scene, dataclasses.replace(batch, force=force), cache=False)
    touch = np.sqrt(2.0 * 0.4 / 2.0)
    speed = 2.0 * touch
    after = (motion.time > touch)[:, None]
    np.testing.assert_allclose(
        motion.velocity[0, :, 1, :1], np.where(after, 2.0 / 3.0 * speed, 0.0), atol=1e-12
    )
    np.testing.assert_allclose(
        motion.velocity[0, :, 0, :1],
        2.0 * motion.time[:, None] - np.where(after, 4.0 / 3.0 * speed, 0.0),
        atol=1e-12,
    )


def test_three_balls_at_once_have_no_unique_motion() -> None:
    """A ball hits two others, which touch each other, at once."""
    pair = (Flying((0.5, RADIUS, 0.0)), Flying((0.5, -RADIUS, 0.0)))
    motion = _solved(balls([Flying((0.0, 0.0, 0.0), (2.0, 0.0, 0.0)), *pair]))
    (end,) = motion.failures
    assert isinstance(end, FirstImpact)
    assert end.time == pytest.approx((0.5 - np.sqrt(3.0) * RADIUS) / 2.0, abs=1e-12)


def test_balls_that_press_on_each_other_say_so() -> None:
    scene = balls([Flying((0.0, 0.0, 0.0)), Flying((0.2, 0.0, 0.0))], restitution=0.0, steps=50)
    batch = draw_batch(scene, [0])
    force = np.zeros_like(batch.force)
    force[0, :, 0, 0] = 2.0
    force[0, :, 1, 0] = -2.0
    (end,) = solve(scene, dataclasses.replace(batch, force=force), cache=False).failures
    assert isinstance(end, FirstImpact)  # engines are judged up to there
    assert "pressed together" in end.reason


def test_other_bodies_end_at_their_first_touch() -> None:
    """The reference ends at the first touch of two pendulums, or of balls above a ground."""
    (end,) = _solved(cradle(0.5)).failures
    assert isinstance(end, FirstImpact)
    assert 0.3 < end.time < 0.4  # a quarter of a period of 1.3 s
    low = (Flying((0.0, 0.0, 0.3)), Flying((0.0, 0.0, 0.6), (0.0, 0.0, -2.0)))
    fall = balls(low, ground=Ground(0.3, 0.5), gravity=GRAVITY)
    (end,) = _solved(fall).failures
    assert isinstance(end, FirstImpact)
    assert end.time == pytest.approx((0.3 - 2.0 * RADIUS) / 2.0, abs=1e-12)


def test_a_fast_pass_within_a_frame_is_no_touch_and_a_hit_is_one() -> None:
    """A ball moves 1.6 m a frame, above a ground, so that the general method follows it."""

    def end(aside: float) -> object:
        pair = (Flying((0.0, aside, 3.0), (80.0, 0.0, 0.0)), Flying((1.0, 0.0, 3.0)))
        return _solved(balls(pair, ground=Ground(0.1, 0.5), steps=2)).failures[0]

    assert end(2.02 * RADIUS) is None
    hit = end(1.9 * RADIUS)
    assert isinstance(hit, FirstImpact)
    way = 1.0 - np.sqrt(4.0 * RADIUS**2 - (1.9 * RADIUS) ** 2)
    assert hit.time == pytest.approx(way / 80.0, abs=1e-9)


def test_a_start_in_each_other_is_refused() -> None:
    scene = balls([Flying((0.0, 0.0, 0.0)), Flying((0.08, 0.0, 0.0))])
    with pytest.raises(
        InputError, match=r"contacts\[0\] on 'ball 0' and contacts\[1\] on 'ball 1'"
    ):
        _solved(scene)

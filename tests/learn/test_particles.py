"""Figures of a prediction against those computed by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import ConstantVelocity
from mbds_xsim.learn.particles import (
    LOST,
    ParticleMotion,
    RigidPairs,
    figures_on,
    measure,
    one_step_error,
    unexplained_energy,
)
from mbds_xsim.learn.shift.evaluation import valid_time
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Ground, Particle
from mbds_xsim.simulate.registry import load_scene
from tests.over_ground import over_ground

FRAMES = 5
Analytic = Callable[..., Motions]


@pytest.fixture
def fall(analytic: Analytic) -> Motions:
    """Balls that fall: z = −½ g t², with t in seconds."""
    frame = Graph.of(load_scene("balldrop")).frame_s

    def course(time: torch.Tensor) -> torch.Tensor:
        drop = -0.5 * 9.81 * (time * frame) ** 2
        return torch.cat([0.0 * drop, 0.0 * drop, drop], dim=-1)

    return analytic("balldrop", course)


def test_position_error_is_the_mean_squared_distance(fall: Motions) -> None:
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    predicted[1] += torch.tensor([0.3, 0.0, 0.4])
    predicted[2, 3:] = torch.nan
    error = measure(fall, predicted).error
    assert error.shape == (4, FRAMES)
    np.testing.assert_allclose(error[0], 0.0, atol=1e-30)
    np.testing.assert_allclose(error[1], 0.25)
    assert np.isinf(error[2, 3:]).all()
    assert (error[2, :3] == 0.0).all()


def test_unknown_truth_is_not_a_lost_prediction(fall: Motions) -> None:
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    fall.position[0, HISTORY + 2 :] = torch.nan
    figures = measure(fall, predicted)
    assert np.isnan(figures.error[0, 2:]).all()
    assert np.isfinite(figures.error[0, :2]).all()
    assert np.isnan(figures.energy[0, 2:]).all()


def test_figures_without_any_known_window_are_unknown(fall: Motions) -> None:
    fall.position[:, 2] = torch.nan
    nothing: object = None
    model = ConstantVelocity(fall.graph, nothing, None)  # type: ignore[arg-type]
    figures = figures_on(model, fall, horizon=FRAMES, stride=2)
    assert figures.error.shape == (4, FRAMES)
    assert all(np.isnan(values).all() for values in vars(figures).values())


def test_energy_error_of_a_lifted_ball(fall: Motions) -> None:
    """Lifted by 1 cm from the second predicted frame on, it has m·g·1 cm too much later."""
    predicted = fall.position[:, HISTORY : HISTORY + FRAMES].clone()
    same = measure(fall, predicted).energy
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    predicted[..., 2] += 0.01
    truth = fall.position[:, HISTORY - 1 : HISTORY + FRAMES, :, 2]
    height = truth.mean(-1).numpy()
    rate = np.gradient(height, fall.graph.frame_s, axis=1)
    weight = 9.81 * float(fall.graph.mass.sum())
    kinetic = 0.5 * weight / 9.81 * rate**2
    scale = kinetic.max(axis=1) + weight * np.ptp(height, axis=1)
    scale = np.maximum(scale, 1e-3 * weight * fall.graph.length)
    energy = measure(fall, predicted).energy[:, 2:]
    np.testing.assert_allclose(energy, np.broadcast_to((weight * 0.01 / scale)[:, None], (4, 3)))


def test_rigid_pairs_of_a_pendulum_are_its_rods() -> None:
    graph = Graph.of(load_scene("3pendulum"))
    pairs = RigidPairs.of(graph)
    assert _pairs(pairs.first, pairs.second) == _pairs(graph.senders, graph.receivers)
    nodes = graph.reference.clone()
    assert float(pairs.gap(nodes)) < 1e-12
    stretched = nodes + 0.1 * (nodes - nodes[-1])
    longest = float(pairs.distance.max())
    assert float(pairs.gap(stretched)) == pytest.approx(0.1 * longest)


def _pairs(first: torch.Tensor, second: torch.Tensor) -> set[frozenset[int]]:
    return {frozenset(pair) for pair in torch.stack([first, second], 1).tolist()}


def test_rigid_pairs_of_a_ladder_keep_their_distance_in_true_motion() -> None:
    scene = load_scene("3ladder")
    graph = Graph.of(scene)
    batch = draw_batch(scene, range(6))
    from mbds_xsim.dataset.points import Points
    from mbds_xsim.scene.state import Trajectory

    states = {
        name: getattr(batch, name)[:, None]
        for name in ("position", "orientation", "velocity", "angular_velocity")
    }
    start = Trajectory(np.zeros(1), **states, failures=(None,) * 6)
    position, _ = Points.of(scene).motion(start)
    nodes = graph.with_anchors(graph.embed(torch.from_numpy(position)))
    pairs = RigidPairs.of(graph)
    assert len(pairs) > graph.particle_count
    assert float(pairs.gap(nodes).max()) < 1e-9


def test_a_body_of_one_particle_has_no_constraint_gap(fall: Motions, analytic: Analytic) -> None:
    figures = measure(fall, fall.position[:, HISTORY : HISTORY + FRAMES])
    assert (figures.gap < 1e-9).all()
    single = analytic("ballscroll", lambda time: torch.zeros(*time.shape[:-1], 3))
    figures = measure(single, single.position[:, HISTORY : HISTORY + FRAMES])
    assert np.isnan(figures.gap).all()


def test_one_step_error_of_constant_velocity_is_the_second_difference(fall: Motions) -> None:
    nothing: object = None
    model = ConstantVelocity(fall.graph, nothing, None)  # type: ignore[arg-type]
    error = one_step_error(model, fall, frames=8, stride=2)
    size = torch.linspace(0.5, 1.0, 4, dtype=torch.float64).numpy()
    step = size * 9.81 * fall.graph.frame_s**2
    np.testing.assert_allclose(error, step**2, rtol=1e-6)


def test_valid_time_is_that_of_the_last_frame_before_the_error_is_too_large() -> None:
    length, frame = 2.0, 0.02
    limit = (LOST * length) ** 2
    error = np.array(
        [
            [0.0, 0.5 * limit, 2.0 * limit, 0.0],
            [0.0, 0.0, 0.0, 0.0],
            [0.0, np.inf, np.inf, np.inf],
            [0.0, 0.0, np.nan, np.nan],
        ]
    )
    time, never = valid_time(error, length, frame)
    np.testing.assert_allclose(time, [2 * frame, 4 * frame, frame, 2 * frame])
    assert never.tolist() == [False, True, False, True]


def test_spin_that_friction_turns_into_speed_is_no_gain_of_energy() -> None:
    """A ball with topspin speeds up until it rolls, at 2/7 of r ω."""
    radius, spin, friction = 0.1, 50.0, 0.3
    centre = (0.0, 0.0, radius)
    particle = Particle(centre, 1.0, 0.4 * radius**2)
    body = Body("ball", (particle,), angular_velocity=(0.0, spin, 0.0))
    scene = over_ground(body, centre, radius, Ground(friction, 0.0))
    time = 0.02 * np.arange(101)
    pull, rolling = friction * 9.81, 2.0 / 7.0 * radius * spin
    until = np.minimum(time, rolling / pull)
    place = 0.5 * pull * until**2 + rolling * (time - until)
    path = np.stack([place, np.zeros(101), np.full(101, radius)], axis=-1)[:, None]
    ball = ParticleMotion(Graph.of(scene), draw_batch(scene, range(1)), path)
    assert np.nanmax(unexplained_energy(ball, ball)) < 1e-9
    faster = ParticleMotion(ball.graph, ball.start, path * (2.0, 1.0, 1.0))
    assert np.nanmax(unexplained_energy(faster, ball)) > 1.0

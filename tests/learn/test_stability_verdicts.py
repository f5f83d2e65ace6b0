"""Verdicts on motions of particles alone: what holds, what breaks first, and who reports it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from mbds_xsim.learn.particles import ParticleMotion, unexplained_energy
from mbds_xsim.learn.simulator import signs_of
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.studies.stability.studies import STUDIES
from mbds_xsim.studies.stability.verdict import judge
from tests.learn.motions import particles_of, solved

Array = np.ndarray
pytestmark = pytest.mark.usefixtures("apart")


def _spoilt(motion: ParticleMotion, change: Callable[[Array], Array]) -> ParticleMotion:
    return dataclasses.replace(motion, position=change(motion.position.copy()))


def judge_particles(motion: ParticleMotion, truth: ParticleMotion) -> SimpleNamespace:
    return SimpleNamespace(**judge(signs_of(motion, truth)))


@pytest.fixture(scope="module")
def swing() -> ParticleMotion:
    """The reference of a double pendulum."""
    return particles_of(*solved(STUDIES["swing"], 2.0))


def test_the_true_motion_is_stable_and_nobody_says_anything(swing: ParticleMotion) -> None:
    verdict = judge_particles(swing, swing)

    assert (verdict.outcome, verdict.told, verdict.broke_s) == ("stable", "nobody", None)
    assert verdict.error == 0.0
    assert verdict.gap is not None
    assert verdict.gap < 1e-8
    assert verdict.energy == 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("swing", 20.0), ("pace", 1.0), ("throw", 5.0), ("loops", 1.0), ("restitution", 0.9)],
)
def test_an_engine_that_holds_holds_by_its_particles_too(name: str, value: float) -> None:
    study = STUDIES[name]
    scene, batch, truth = solved(study, value)
    adapter = registry.load_adapter("mujoco")
    settings = dataclasses.replace(adapter.settings(scene, "matched"), method="RK4", step=0.001)
    run = simulate(scene, batch, "mujoco", settings).trajectory

    verdict = judge_particles(particles_of(scene, batch, run), particles_of(scene, batch, truth))

    assert verdict.outcome == "stable", verdict


def test_a_drag_that_nobody_asked_for_loses_energy(swing: ParticleMotion) -> None:
    slow = np.linspace(0, 1, len(swing.position)) ** 2  # time lags ever more
    frames = np.arange(len(swing.position)) - 20.0 * slow

    def lag(position: Array) -> Array:
        flat = position.reshape(len(position), -1)
        known = np.arange(len(position))
        lagged = [np.interp(frames, known, column) for column in flat.T]
        return np.stack(lagged, axis=1).reshape(position.shape)

    # Interpolated positions cut corners by less than joints may open.
    energy = unexplained_energy(_spoilt(swing, lag), swing)

    assert np.isnan(energy[:HISTORY]).all()
    assert np.nanmin(energy) < -0.1


def test_a_rod_that_grows_comes_apart_when_it_has_grown(swing: ParticleMotion) -> None:
    def grow(position: Array) -> Array:
        position[30:, 0] *= 1.05
        return position

    verdict = judge_particles(_spoilt(swing, grow), swing)

    assert verdict.outcome == "comes apart"
    assert verdict.broke_s == pytest.approx(0.6)


def test_what_stands_still_is_stuck() -> None:
    ball = particles_of(*solved(STUDIES["throw"], 0.0))

    def stay(position: Array) -> Array:
        position[:] = position[0]
        return position

    assert judge_particles(_spoilt(ball, stay), ball).outcome == "stuck"


def test_what_is_no_number_has_blown_up(swing: ParticleMotion) -> None:
    def lose(position: Array) -> Array:
        position[40:] = np.nan
        return position

    lost = judge_particles(_spoilt(swing, lose), swing)

    assert (lost.outcome, lost.broke_s, lost.told) == ("blows up", 0.8, "nobody")
    assert lost.ended_s == pytest.approx(0.78)


@pytest.mark.parametrize(
    ("name", "value"), [("throw", 15.0), ("throw", 150.0), ("restitution", 0.9)]
)
def test_a_bounce_is_no_rise_of_energy_and_a_faster_ball_is(name: str, value: float) -> None:
    ball = particles_of(*solved(STUDIES[name], value))

    def lift(position: Array) -> Array:
        position[30:] += np.linspace(0.0, 3.0, len(position) - 30)[:, None, None] ** 2 * value
        return position

    energy = unexplained_energy(ball, ball)

    assert np.nanmax(energy) < 1e-9
    assert judge_particles(ball, ball).outcome == "stable"
    assert judge_particles(_spoilt(ball, lift), ball).outcome == "gains energy"


def test_a_ball_in_the_ground_is_seen() -> None:
    ball = particles_of(*solved(STUDIES["throw"], 0.0))

    def sink(position: Array) -> Array:
        position[45:, :, 2] = -0.5
        return position

    assert judge_particles(ball, ball).outcome == "stable"
    verdict = judge_particles(_spoilt(ball, sink), ball)
    assert (verdict.outcome, verdict.broke_s) == ("sinks in", 0.9)

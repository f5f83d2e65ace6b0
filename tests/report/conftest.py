"""Small validations made up from closed forms, through the real types.

A chain of rods swings as one stiff pendulum; an "engine" has its frequency slightly wrong, so that
its errors, and their growth, are what the page should show.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.measure.result import (
    SCHEMA,
    EngineResult,
    Evidence,
    FindingResult,
    ReferenceResult,
    Validation,
)
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Failure, Trajectory
from mbds_xsim.simulate import registry

TRAJECTORIES = 3


@dataclass(frozen=True)
class Case:
    """Input of the report writers."""

    validation: Validation
    evidence: Evidence


@dataclass(frozen=True)
class Fake:
    """Made-up engine: its error, or its crash."""

    engine: str
    profile: str = "matched"
    method: str = "RK4"
    order: int = 4
    wrong: float = 1e-6
    """Relative error of the frequency."""
    gap: float = 1e-9
    crashed: bool = False
    blown_from: int | None = None
    """First NaN frame of the last trajectory."""


FOUR = (
    Fake("dart", "native", "semi-implicit Euler", 1, 2e-3, 4e-7),
    Fake("dart", wrong=3e-6),
    Fake("exudyn", "native", "generalised-alpha", 2, 4e-5, 1e-10),
    Fake("exudyn", wrong=5e-7),
    Fake("mujoco", "native", "semi-implicit Euler", 1, 1e-3, 1e-15),
    Fake("mujoco", wrong=1e-7),
    Fake("pybullet", "native", "semi-implicit Euler", 1, 3e-2, 2e-3, blown_from=60),
    Fake("pybullet", "matched", "semi-implicit Euler", 1, 5e-5, 3e-6),
)


def make_case(scene: Scene, fakes: tuple[Fake, ...] = FOUR, frames: int = 101) -> Case:
    """Make a validation of `fakes` on a scene that hangs from the origin."""
    time = np.linspace(0.0, 4.0, frames)
    reference = _swing(scene, time, 0.0)
    motions = tuple(None if fake.crashed else _motion(scene, time, fake) for fake in fakes)
    errors = tuple(None if m is None else _error(scene, m, reference) for m in motions)
    growth = np.exp(np.outer(np.linspace(0.2, 1.6, TRAJECTORIES), time))
    series = tuple(
        {} if m is None else _series(f, time) for f, m in zip(fakes, motions, strict=True)
    )
    results = tuple(
        _result(scene, fake, error, values, motion)
        for fake, error, values, motion in zip(fakes, errors, series, motions, strict=True)
    )
    batch = draw_batch(scene, range(TRAJECTORIES), noise=False)
    evidence = Evidence(scene, batch, motions, reference, growth, errors, series)
    return Case(_validation(scene, results, (*motions, reference)), evidence)


def _swing(scene: Scene, time: Array, wrong: float) -> Trajectory:
    """Turn the whole scene about y through the origin, as one rigid pendulum."""
    mechanism = Mechanism.of(scene)
    rate = np.sqrt(9.81 / scene.length) * (1.0 + wrong)
    start = np.linspace(0.2, 1.2, TRAJECTORIES)[:, None]
    angle = start * np.cos(rate * time)
    half = angle / 2
    turn = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)[:, :, None, :]
    count = mechanism.body_count
    native = np.broadcast_to(turn, (*angle.shape, count, 4)).copy()
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    x, y, z = mechanism.com.T
    position = np.stack([cos * x + sin * z, 0 * cos + y, cos * z - sin * x], axis=-1)
    return Trajectory(
        time,
        position,
        mechanism.body_orientation(native),
        np.gradient(position, time, axis=1),
        np.zeros_like(position),
        (None,) * TRAJECTORIES,
    )


def _motion(scene: Scene, time: Array, fake: Fake) -> Trajectory:
    motion = _swing(scene, time, fake.wrong)
    if fake.blown_from is None:
        return motion
    for values in (motion.position, motion.orientation, motion.velocity, motion.angular_velocity):
        values[-1, fake.blown_from :] = np.nan
    failure = Failure(fake.blown_from, "a coordinate is not finite")
    return dataclasses.replace(motion, failures=(*motion.failures[:-1], failure))


def _points(scene: Scene, motion: Trajectory) -> Array:
    mechanism = Mechanism.of(scene)
    if not scene.particle_count:
        return motion.position
    return mechanism.particle_positions(motion.position, motion.orientation)


def _error(scene: Scene, motion: Trajectory, other: Trajectory) -> Array:
    gap = _points(scene, motion) - _points(scene, other)
    return np.asarray(np.sqrt(np.mean(np.sum(gap**2, axis=-1), axis=-1)))


def _series(fake: Fake, time: Array) -> dict[str, Array]:
    shape = np.abs(np.sin(3 * time)) + 0.1 * time
    each = np.outer(np.linspace(0.3, 1.0, TRAJECTORIES), shape)
    return {
        "gap": fake.gap * each,
        "energy": 20 * fake.wrong * each,
        "momentum": 1e-12 * each,
    }


def _finding(check: str, unit: str, values: Array, budget: float | None) -> FindingResult:
    figures = np.max(values, axis=1)
    trajectory = int(np.argmax(figures))
    return FindingResult(
        check,
        unit,
        float(figures.max()),
        budget,
        budget is None or bool(figures.max() <= budget),
        trajectory,
        int(np.argmax(values[trajectory])),
        "joint1",
        tuple(figures.tolist()),
        "told besides",
    )


def _findings(scene: Scene, fake: Fake, series: dict[str, Array]) -> tuple[FindingResult, ...]:
    ratio = np.linspace(0.2, 1.0, TRAJECTORIES)[:, None] * (1 + 1e3 * fake.gap)
    return (
        _finding("gap", "m", series["gap"], scene.budget.gap),
        _finding("energy", "", series["energy"], scene.budget.energy),
        _finding("momentum", "kg·m/s", series["momentum"], None),
        _finding("consistency of positions", "", ratio, 3.0),
        _finding("consistency of energy", "", 2 * ratio, 3.0),
    )


def _worst(values: Array) -> float:
    return float(np.nanmax(values))


def _result(
    scene: Scene,
    fake: Fake,
    error: Array | None,
    series: dict[str, Array],
    motion: Trajectory | None,
) -> EngineResult:
    findings = () if error is None else _findings(scene, fake, series)
    reasons = tuple(
        f"{f.check} {f.figure:.3g} over the budget {f.budget:.3g} (trajectory {f.trajectory})"
        for f in findings
        if f.budget is not None and not f.passed
    )
    failures = tuple(
        f"trajectory {k} ended at frame {f.frame}: {f.reason}"
        for k, f in enumerate(() if motion is None else motion.failures)
        if f is not None
    )
    if error is None:
        failures = reasons = ("the engine ended with signal 11",)
    return EngineResult(
        engine=fake.engine,
        version="1.2.3",
        profile=fake.profile,
        method=fake.method,
        family=fake.method,
        order=fake.order,
        step_s=0.002 if fake.profile == "native" else 0.00025,
        options={"iterations": 50, "solver": "newton", "warm_start": True},
        verdict="fail" if reasons or failures else "pass",
        reasons=(*failures, *reasons) if error is not None else reasons,
        error_1s_m=None if error is None else _worst(error[:2, error.shape[1] // 4]),
        error_max_m=None if error is None else _worst(error),
        error_weighted_m=None if error is None else _worst(error) / 2,
        constraint_gap_m=None if error is None else findings[0].figure,
        energy_balance=None if error is None else findings[1].figure,
        agreement_time_s=1.24 if error is not None and _worst(error) > scene.length / 100 else None,
        wall_per_simulated_s=None if error is None else 0.0034 / fake.order,
        setup_s=None if error is None else 0.01,
        coordinates=None if error is None else 6,
        constraints=None if error is None else 0,
        findings=findings,
        failures=failures,
    )


def _matrix(scene: Scene, motions: tuple[Trajectory | None, ...]) -> tuple[tuple[float, ...], ...]:
    frame = len(next(m for m in motions if m is not None).time) // 4
    return tuple(
        tuple(
            float("nan") if a is None or b is None else _worst(_error(scene, a, b)[:2, frame])
            for b in motions
        )
        for a in motions
    )


def _validation(
    scene: Scene, results: tuple[EngineResult, ...], motions: tuple[Trajectory | None, ...]
) -> Validation:
    failed = [result for result in results if result.verdict == "fail"]
    return Validation(
        schema=SCHEMA,
        scene=scene.name,
        description=scene.description,
        verdict="fail" if failed else "pass",
        wall_s=34.2,
        command=f"mbds-xsim validate {scene.name} --json out.json",
        seed=0,
        trajectories=tuple(range(TRAJECTORIES)),
        length_m=scene.length,
        budget=msgspec.structs.asdict(scene.budget),
        engines=results,
        left_out={},
        reference=ReferenceResult(1e-10, 3e-10, 2e-11, 2, 4.1),
        names=(*(f"{result.engine} {result.profile}" for result in results), "reference"),
        matrix_m=_matrix(scene, motions),
        odd_one_out=f"{failed[-1].engine} {failed[-1].profile}" if failed else None,
        versions={"mbds-xsim": "0.1.0", "numpy": "2.3"},
        machine="x86_64, 2 cores",
    )


@pytest.fixture(scope="session")
def scene() -> Scene:
    return registry.load_scene("2pendulum")


@pytest.fixture(scope="session")
def case(scene: Scene) -> Case:
    """Four engines at two profiles; one blows up."""
    return make_case(scene)


@pytest.fixture(scope="session")
def one_engine(scene: Scene) -> Case:
    return make_case(scene, (Fake("mujoco", wrong=1e-7),), frames=41)


@pytest.fixture(scope="session")
def with_crash(scene: Scene) -> Case:
    return make_case(scene, (Fake("mujoco", wrong=1e-7), Fake("pybullet", crashed=True)), frames=41)

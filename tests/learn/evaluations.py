"""Made-up evaluations: errors of models of three engines, at home and on other engines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.learn.particles import RolloutFigures
from mbds_xsim.learn.shift.domains import Paired, Recorded
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.shift.gaps import Draws, gaps_of
from mbds_xsim.learn.shift.result import Gap
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import load_scene

FRAMES = 5
COUNT = 12


def paired(engines: tuple[str, ...]) -> Paired:
    scene = load_scene("1pendulum")
    batch = draw_batch(scene, range(COUNT))
    domains = tuple(
        Recorded(name, "native", Path(name), tuple(range(COUNT)), name) for name in engines
    )
    return Paired(scene, batch.index, domains, batch, True, batch.force, seed=0, left_out={})


def figures_of(error: Array) -> RolloutFigures:
    nothing = np.full_like(error, np.nan)
    return RolloutFigures(error, nothing, nothing, error[:, 0])


def entry_of(training: str, seed: int, engines: tuple[str, ...]) -> TrainedModel:
    name = f"{training}-native"
    return TrainedModel("gns", name, engines, "native", seed, Path(f"{training}{seed}"), name, "")


def evaluation(error: Callable[[str, str, int], Array], floor: float, seeds: int = 3) -> Evaluation:
    engines = ("a", "b", "c")
    test = paired(engines)
    figures = {
        (entry_of(training, seed, (training,)), f"{engine}-native"): figures_of(
            error(training, engine, seed)
        )
        for training in engines
        for seed in range(seeds)
        for engine in engines
    }
    oracles = {
        (f"{i}-native", f"{j}-native"): figures_of(np.full((COUNT, FRAMES), floor))
        for i in engines
        for j in engines
        if i != j
    }
    return Evaluation(test, (1, FRAMES), figures, oracles)


def measured_gaps(evaluated: Evaluation) -> list[Gap]:
    return list(gaps_of(Draws(evaluated)))


def shifted(training: str, engine: str, seed: int) -> Array:
    rng = np.random.default_rng(ord(engine))
    hard = np.exp(rng.standard_normal((COUNT, 1)))  # some starts are harder, for all models
    away = 0.0 if training == engine else 3.0
    return np.tile((1.0 + away) * hard * (1.0 + 0.01 * seed), (1, FRAMES))

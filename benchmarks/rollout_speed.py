"""How much faster models predict many trajectories at once than one by one.

python -m benchmarks.rollout_speed [SCENE…] > reports/rollout-speed.md

All four models in their `lite` size and untrained, as time does not depend on weights, go on for
some frames from true motions of the scene: one trajectory a call, and many. They take turns.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from statistics import median, quantiles

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.learn_speed import spent
from mbds_xsim.learn.channels import CHANNELS
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model, build
from mbds_xsim.learn.statistics import Moments, Statistics
from mbds_xsim.learn.trained import Known, carry_on, known_start
from mbds_xsim.matched import settings_for
from mbds_xsim.registry import load_adapter, load_scene
from mbds_xsim.sampling import draw_batch
from mbds_xsim.simulate import simulate
from mbds_xsim.study.identity import machine

SCENES = ("6pendulum", "3ladder")
MODELS = ("gns", "sgnn", "hgnn", "lgnn")
BATCHES = (1, 64, 512)
FRAMES, STARTS, ROUNDS = 5, 30, (3, 9)
PATIENCE = 180.0  # seconds a scene may take, if the rounds are enough
AIM = 20
SQUARE, REPEATS = 512, 20
_HEAD = f"""\
# Rollouts of models, one by one and many at once

<!-- Written by: python -m benchmarks.rollout_speed > reports/rollout-speed.md -->

Milliseconds of the processor a trajectory and frame, one thread, untrained models in their `lite`
size; medians of {ROUNDS[0]} to {ROUNDS[1]} rounds in which models and batches take turns.
*Ratio*: batch {BATCHES[0]} over batch {BATCHES[-1]}, with its quartiles; the aim is {AIM}.
*At most*: of a core that does nothing but the products of matrices, as fast as it multiplies two of
{SQUARE} × {SQUARE}. Where that is below {AIM}, one trajectory alone keeps the core too busy."""


def starts(name: str, models: list[Model]) -> list[Known]:
    """What each model is given of the same slow motions."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(0, 3 * STARTS, 3), noise=False)
    settings = settings_for(scene, load_adapter("mujoco"), "matched")
    motion = simulate(scene, batch, "mujoco", settings).trajectory
    return [known_start(model, motion, batch).truncated(FRAMES) for model in models]


def still() -> Statistics:
    """Changes are small, so that untrained models stay near the motions."""
    one, small = (
        Moments(torch.zeros(3).double(), torch.full((3,), size).double()) for size in (1.0, 1e-4)
    )
    return Statistics(one, small, small, torch.ones(len(CHANNELS)).double())


def least(model: Model, given: Known) -> float:
    """Seconds a trajectory and frame that the products of matrices take at the core's best rate."""
    with FlopCounterMode(display=False) as counter:
        carry_on(model, given.repeated(1))
    square = torch.ones(SQUARE, SQUARE, dtype=model.dtype)
    best = min(spent(lambda: square @ square) for _ in range(REPEATS))
    return counter.get_total_flops() / FRAMES * best / (2.0 * SQUARE**3)


def measured(name: str) -> dict[str, tuple[float, list[list[float]]]]:
    """Least seconds a trajectory and frame, and rounds of all batches, model by model."""
    graph = Graph.of(load_scene(name))
    models = [build(kind, graph, still(), track="lite") for kind in MODELS]
    known = starts(name, models)

    def work(model: Model, given: Known) -> Callable[[], object]:
        return lambda: carry_on(model, given)

    def turn() -> list[list[float]]:
        return [
            [spent(work(model, given.repeated(n))) / (n * FRAMES) for n in BATCHES]
            for model, given in zip(models, known, strict=True)
        ]

    began = time.perf_counter()
    turn()  # warms up
    low, high = ROUNDS
    rounds = min(high, max(low, int(PATIENCE / (time.perf_counter() - began))))
    turns = [turn() for _ in range(rounds)]
    bounds = [least(*pair) for pair in zip(models, known, strict=True)]
    return {kind: (bounds[i], [each[i] for each in turns]) for i, kind in enumerate(MODELS)}


def rows(name: str) -> Iterator[str]:
    for kind, (bound, rounds) in measured(name).items():
        times = [f"{1e3 * median(column):.3g}" for column in zip(*rounds, strict=True)]
        ratios = [each[0] / each[-1] for each in rounds]
        low, middle, high = quantiles(ratios, n=4)
        told = f"{middle:.3g} ({low:.3g} … {high:.3g})"
        most = median(each[0] for each in rounds) / bound
        yield f"| {name} | {kind} | {' | '.join(times)} | {told} | {most:.3g} |"


def main() -> None:
    torch.set_num_threads(1)
    print(f"{_HEAD}\n")
    heads = " | ".join(f"batch {n}" for n in BATCHES)
    print(f"| scene | model | {heads} | ratio | at most |")
    print(f"| :-- | :-- |{' --: |' * (len(BATCHES) + 2)}")
    for name in sys.argv[1:] or SCENES:
        for row in rows(name):
            print(row, flush=True)
    print(f"\nMade on {machine()}, torch {torch.__version__}.")


if __name__ == "__main__":
    main()

"""How much faster models predict many trajectories at once than one by one.

python -m benchmarks.rollout_speed [SCENE…] [--device cuda] > reports/rollout-speed.md

All four models in their `lite` size and untrained, as time does not depend on weights, go on for
some frames from true motions of the scene: one trajectory a call, and many. They take turns.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator
from statistics import quantiles

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.harness import (
    device_asked,
    machine_of,
    print_head,
    print_made,
    print_table,
    spent_on,
    take_turns,
)
from mbds_xsim.learn.device import put
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, build
from mbds_xsim.learn.statistics import CHANNELS, Moments, Statistics
from mbds_xsim.learn.trained import Known, carry_on, known_start
from mbds_xsim.learn.window import KnownInputs, Start
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate

Array = NDArray[np.float64]

SCENES = ("6pendulum", "3ladder")
_COMMAND = "python -m benchmarks.rollout_speed > reports/rollout-speed.md"
MODELS = ("gns", "sgnn", "hgnn", "lgnn")
BATCHES = (1, 64, 512)
FRAMES, STARTS, ROUNDS = 5, 30, (3, 31)
PATIENCE = 180.0  # seconds a scene may take, if the rounds are enough
AIM = 20
SQUARE, REPEATS = {"cpu": 512, "cuda": 8192}, 20
UNIT = {"cpu": "of the processor, one thread,", "cuda": "of a GPU"}


def starts(name: str, models: list[LearnedModel]) -> list[Known]:
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


def moved(known: Known, device: str) -> Known:
    start, inputs = known.start, known.inputs
    body = None if start.body is None else start.body.to(device)
    return Known(
        Start(start.history.to(device), start.velocity.to(device), body),
        KnownInputs(inputs.force.to(device), inputs.torque.to(device)),
    )


def least(model: LearnedModel, given: Known, device: str) -> float:
    """Seconds a trajectory and frame that the products of matrices take at the best rate."""
    with FlopCounterMode(display=False) as counter:
        carry_on(model, given.repeated(1))
    size = SQUARE[device]
    square = torch.ones(size, size, dtype=model.dtype, device=device)
    spent = spent_on(device)
    best = min(spent(lambda: square @ square) for _ in range(REPEATS))
    return counter.get_total_flops() / FRAMES * best / (2.0 * size**3)


def measured(name: str, device: str) -> dict[str, tuple[float, Array]]:
    """Least seconds a trajectory and frame, and rounds of all batches, model by model."""
    graph = Graph.of(load_scene(name))
    models = [build(kind, graph, still(), track="lite") for kind in MODELS]
    known = [moved(each, device) for each in starts(name, models)]
    for model in models:
        put(model, device)

    works = [
        functools.partial(carry_on, model, given.repeated(count))
        for model, given in zip(models, known, strict=True)
        for count in BATCHES
    ]
    turns = take_turns(works, ROUNDS, PATIENCE, spent_on(device))
    each = turns.reshape(len(turns), len(MODELS), len(BATCHES)) / (np.array(BATCHES) * FRAMES)
    bounds = [least(*pair, device) for pair in zip(models, known, strict=True)]
    return {kind: (bounds[k], each[:, k]) for k, kind in enumerate(MODELS)}


def rows(name: str, device: str) -> Iterator[list[str]]:
    for kind, (bound, rounds) in measured(name, device).items():
        times = [f"{1e3 * seconds:.3g}" for seconds in np.median(rounds, axis=0)]
        low, middle, high = quantiles(rounds[:, 0] / rounds[:, -1], n=4)
        most = np.median(rounds[:, 0]) / bound
        yield [name, kind, *times, f"{middle:.3g} ({low:.3g} … {high:.3g})", f"{most:.3g}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    arguments, device = device_asked(parser)
    torch.set_num_threads(1)
    size = SQUARE[device]
    text = (
        f"Milliseconds {UNIT[device]} a trajectory and frame; untrained models in their `lite` "
        f"size; medians of {ROUNDS[0]} to {ROUNDS[1]} rounds in which models and batches take "
        f"turns. *Ratio*: batch {BATCHES[0]} over batch {BATCHES[-1]}, with its quartiles; the aim "
        f"is {AIM}. *At most*: the ratio if a batch took no more than its products of matrices at "
        f"the rate of one of {size} × {size}; where that is below {AIM}, one trajectory alone is "
        f"work enough. The {FRAMES} frames are of slow motions; [whole rollouts](models/"
        "6pendulum.md) take longer."
    )
    print_head("Rollouts of models, one by one and many at once", _COMMAND, text)
    heads = "|>".join(f"batch {count}" for count in BATCHES)
    found = (row for name in arguments.scenes for row in rows(name, device))
    print_table(f"scene|model|>{heads}|>ratio|>at most", found)
    print_made(f"torch {torch.__version__}", on=machine_of(device))


if __name__ == "__main__":
    main()

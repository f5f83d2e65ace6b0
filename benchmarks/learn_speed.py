"""Speed of learned models: training, and predicting trajectories one by one or many at once.

python -m benchmarks.learn_speed [SCENE…] > reports/learn-speed.md
python -m benchmarks.learn_speed 3ladder --device cuda --tracks paper > reports/learn-speed-gpu.md

The models are untrained, because time does not depend on weights. On a GPU, training is measured in
single precision, in mixed precision (`train --bf16`), compiled to CUDA graphs (`--compile`), and
with both.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import sys
import time
from collections.abc import Iterator
from statistics import quantiles

import numpy as np
import torch

from benchmarks.harness import Work, print_head, print_made, print_table, processor_s, take_turns
from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, build, load_model
from mbds_xsim.learn.recipe import Recipe, check_device, compile_networks, precision, put
from mbds_xsim.learn.statistics import CHANNELS, Moments, Statistics
from mbds_xsim.learn.train import optimiser
from mbds_xsim.learn.trained import Known, carry_on, known_start
from mbds_xsim.learn.window import HISTORY, KnownInputs, Sample, Start
from mbds_xsim.measure.runner import machine
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate

SCENES = ("6pendulum", "3ladder")
TRAINED, TRACKS, BATCH = ("gns", "sgnn"), ("lite", "native", "paper"), 64
MODELS, BATCHES, AIM = ("gns", "sgnn", "hgnn", "lgnn"), (1, 64, 512), 20
FRAMES, STARTS = 5, 30
ROUNDS = {"train": (7, 25), "roll": (3, 31)}
PATIENCE = {"cpu": {"train": 10.0, "roll": 180.0}, "cuda": {"train": 2.0, "roll": 20.0}}
"""Time to fill with rounds [s], within the least and greatest number in `ROUNDS`."""
UNIT = {"cpu": "one thread, by the processor's time", "cuda": "on a GPU, until it is done"}
WAYS = {"cpu": {"": (False, False)}, "cuda": {
    "float32": (False, False), "bf16": (True, False),
    "compiled": (False, True), "bf16, compiled": (True, True),
}}  # fmt: skip
"""Ways of training: whether in mixed precision, and whether compiled."""


def on_gpu(work: Work) -> float:
    """Measure the wall-clock time until the GPU has done all [s]."""
    torch.cuda.synchronize()
    begin = time.perf_counter()
    work()
    torch.cuda.synchronize()
    return time.perf_counter() - begin


SPENT = {"cpu": processor_s, "cuda": on_gpu}


def still() -> Statistics:
    """Return statistics with small changes, so that untrained models stay near the motions."""
    unit, small = (
        Moments(torch.zeros(3).double(), torch.full((3,), size).double()) for size in (1.0, 1e-4)
    )
    return Statistics(unit, small, small, torch.ones(len(CHANNELS)).double())


def training(name: str, track: str, device: str) -> Iterator[list[str]]:
    """Yield graphs per second in training; models and ways take turns at a step on one batch."""
    graph = Graph.of(load_scene(name))
    works: dict[tuple[str, bool, bool], Work] = {}
    weights, ways = [], WAYS[device]
    for kind in TRAINED:
        for mixed, compiled in ways.values():
            model = build(kind, graph, still(), track=track)
            if mixed and not model.mixes:
                continue
            put(model, device)
            if compiled:
                compile_networks(model)
            recipe = load_model(kind).tracks[track].recipe
            works[kind, mixed, compiled] = step(model, graph, recipe, device, mixed=mixed)
        weights.append(f"{sum(w.numel() for w in model.parameters()):,}")
    patience = PATIENCE[device]["train"]
    seconds = take_turns([*works.values()], ROUNDS["train"], patience, SPENT[device])
    rates = dict(zip(works, BATCH / np.median(seconds, axis=0), strict=True))
    size = f"{graph.node_count}, {len(graph.senders)}"
    for way, how in ways.items():
        cells = [f"{rates[key]:.0f}" if (key := (kind, *how)) in rates else "-" for kind in TRAINED]
        yield [name, size, track, ", ".join(weights), *([way] if way else []), *cells]


def drawn(graph: Graph, horizon: int, device: str) -> Sample:
    """Draw a batch of random windows with `horizon` frames to come."""
    generator = torch.Generator().manual_seed(0)
    shape = (BATCH, HISTORY + horizon, graph.particle_count, 3)
    near = graph.reference[: graph.particle_count].float()
    position = torch.randn(shape, generator=generator) * 0.1 + near
    force = torch.randn((BATCH, horizon, graph.body_count, 3), generator=generator)
    torque = torch.randn((BATCH, horizon, len(graph.mechanism.hinges)), generator=generator)
    start = Start(position[:, :HISTORY], torch.zeros_like(position[:, 0]))
    after = position[:, HISTORY:]
    return Sample(start, KnownInputs(force, torque), after, torch.zeros_like(after)).to(device)


def step(model: LearnedModel, graph: Graph, recipe: Recipe, device: str, *, mixed: bool) -> Work:
    """Return a function that does one training step: loss, gradient, new parameters."""
    adam, sample = optimiser(model, recipe), drawn(graph, recipe.horizon, device)

    def descend() -> None:
        adam.zero_grad()
        with precision(model, mixed=mixed):
            loss = model.loss(sample, torch.Generator().manual_seed(0))
        torch.autograd.backward(loss)
        adam.step()

    return descend


def rolling(name: str, device: str) -> Iterator[list[str]]:
    """Yield milliseconds per trajectory and frame; models and batch sizes take turns."""
    graph = Graph.of(load_scene(name))
    models = [build(kind, graph, still(), track="lite") for kind in MODELS]
    known = starts(name, models, device)
    for model in models:
        put(model, device)
    works = [
        functools.partial(carry_on, model, start.repeated(count))
        for model, start in zip(models, known, strict=True)
        for count in BATCHES
    ]
    turns = take_turns(works, ROUNDS["roll"], PATIENCE[device]["roll"], SPENT[device])
    costs = turns.reshape(len(turns), len(MODELS), len(BATCHES)) / (np.array(BATCHES) * FRAMES)
    for kind, rounds in zip(MODELS, np.moveaxis(costs, 1, 0), strict=True):
        times = [f"{1e3 * seconds:.3g}" for seconds in np.median(rounds, axis=0)]
        low, middle, high = quantiles(rounds[:, 0] / rounds[:, -1], n=4)
        yield [name, kind, *times, f"{middle:.3g} ({low:.3g} … {high:.3g})"]


def starts(name: str, models: list[LearnedModel], device: str) -> list[Known]:
    """Return each model's known start and inputs, all from the same slow motions."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(0, 3 * STARTS, 3), noise=False)
    settings = settings_for(scene, load_adapter("mujoco"), "matched")
    motion = simulate(scene, batch, "mujoco", settings).trajectory
    known = [known_start(model, motion, batch).truncated(FRAMES) for model in models]
    return [start.to(device) for start in known]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--tracks", nargs="*", default=TRACKS, choices=TRACKS, help="in training")
    arguments = parser.parse_args()
    scenes, device = arguments.scenes, arguments.device
    try:
        check_device(device)
    except InputError as error:
        parser.error(str(error))
    torch.set_num_threads(1)
    text = f"""\
Graphs a second in training (loss, gradient, Adam), batch {BATCH}, {UNIT[device]}. All times are
medians of rounds in which models and batches take turns."""
    file = "learn-speed.md" if device == "cpu" else "learn-speed-gpu.md"
    command = " ".join(["python -m benchmarks.learn_speed", *sys.argv[1:], f"> reports/{file}"])
    print_head("Speed of learned models", command, text)
    pairs = itertools.product(scenes, arguments.tracks)
    lines = (row for scene, track in pairs for row in training(scene, track, device))
    way = "|way" if device == "cuda" else ""
    print_table(f"scene|nodes, edges|track|weights GNS, SGNN{way}|>GNS|>SGNN", lines)
    print(f"""
Milliseconds a trajectory and frame in rollouts of models in their `lite` size, {UNIT[device]}.
Ratio: batch {BATCHES[0]} over batch {BATCHES[-1]}, with its quartiles; the aim is {AIM}. The
{FRAMES} frames are of slow motions; [whole rollouts](models/6pendulum.md) take longer.
""")
    heads = "|>".join(f"batch {count}" for count in BATCHES)
    lines = (row for name in scenes for row in rolling(name, device))
    print_table(f"scene|model|>{heads}|>ratio", lines)
    where = machine() if device == "cpu" else f"{torch.cuda.get_device_name()}, {machine()}"
    print_made(f"torch {torch.__version__}", on=where)


if __name__ == "__main__":
    main()

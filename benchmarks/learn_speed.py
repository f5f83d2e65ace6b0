"""Training throughput of the graph networks, beside a GNS written the straightforward way.

python -m benchmarks.learn_speed [SCENE…] [--device cuda] > reports/learn-speed.md

The yardstick is what a tutorial shows: the graphs of a batch joined to one, the ends of an edge
gathered and concatenated, messages added up by a scatter, Adam as torch has it by default. It has
the weights of our GNS and gives the same numbers, which is checked in double precision. On a GPU
our networks are compiled to CUDA graphs, as `train --compile` has it; the yardstick is as it is.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from dataclasses import dataclass
from statistics import quantiles

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.harness import (
    device_asked,
    machine_of,
    print_head,
    print_made,
    print_table,
    spent_on,
    take_turns,
)
from mbds_xsim.learn.device import compile_networks, put
from mbds_xsim.learn.gns import GNS, Interaction
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, load_model
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.statistics import Moments, Statistics
from mbds_xsim.learn.train import optimiser
from mbds_xsim.learn.window import HISTORY, KnownInputs, Sample, Start
from mbds_xsim.simulate.registry import load_scene

SCENES = ("6pendulum", "3ladder")
TRACKS = ("lite", "native", "paper")
BATCH, ROUNDS = 64, (7, 25)
PATIENCE = 10.0  # seconds a line may take, if the rounds are enough
SAME = 1e-9
AIM = {"cpu": 1.1, "cuda": 3.0}
_COMMAND = "python -m benchmarks.learn_speed > reports/learn-speed.md"
UNIT = {"cpu": "one thread, by the processor's time", "cuda": "on a GPU, until it is done"}


class ScatterGNS(GNS):
    """Our GNS's weights in a straightforward forward pass."""

    def forward(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        batch, count = len(history), self.graph.node_count
        shift = count * torch.arange(batch, device=history.device)[:, None]
        senders = (self.senders + shift).flatten()
        receivers = (self.receivers + shift).flatten()
        position = joined(self.graph.with_anchors(history[:, -1]) / self.graph.spacing)
        apart = position[senders] - position[receivers]
        nodes = self.node_encoder(joined(self._node_features(history, inputs).transpose(0, 1)))
        edges = self.edge_encoder(torch.cat([apart, apart.norm(dim=-1, keepdim=True)], dim=-1))
        for layer in self.interactions:
            assert isinstance(layer, Interaction)
            ends = torch.cat([nodes[receivers], nodes[senders], edges], dim=-1)
            message = layer.message(layer.ends(ends))
            received = torch.zeros_like(nodes).index_add(0, receivers, message)
            nodes = nodes + layer.update(torch.cat([received, nodes], dim=-1))
            edges = edges + message
        found: Tensor = self.decoder(nodes)
        return found.reshape(batch, count, -1)[:, : self.graph.particle_count]


def joined(nodes: Tensor) -> Tensor:
    """Nodes of all graphs in one row, from shape (batch, node, …)."""
    return nodes.flatten(0, 1)


KINDS: dict[str, type[LearnedModel]] = {
    "gns": GNS,
    "scatter": ScatterGNS,
    "sgnn": load_model("sgnn"),
}


@dataclass(frozen=True)
class Throughput:
    """A line of the table; processor seconds a step, one column a model of `KINDS`."""

    scene: str
    track: str
    nodes: int
    edges: int
    weights: tuple[int, ...]
    seconds: NDArray[np.float64]


def measure(name: str, track: str, device: str) -> Throughput:
    """Let the models take turns at a step of training on one batch."""
    graph = Graph.of(load_scene(name))
    models = {kind: made(kind, graph, track) for kind in KINDS}
    sample = drawn(graph, KINDS["gns"].tracks[track].recipe.horizon)
    difference = apart(models["gns"], models["scatter"], sample)
    if difference > SAME:
        msg = f"{name}, {track}: the two forms of GNS differ by {difference:.1e}"
        raise SystemExit(msg)
    for kind, model in models.items():
        put(model, device)
        if device != "cpu" and kind != "scatter":
            compile_networks(model)
    there = mapped(sample, lambda part: part.to(device))
    steps = [step(model, adam_of(kind, model, track), there) for kind, model in models.items()]
    seconds = take_turns(steps, ROUNDS, PATIENCE, spent_on(device))
    weights = tuple(sum(w.numel() for w in model.parameters()) for model in models.values())
    return Throughput(name, track, graph.node_count, graph.edge_count, weights, seconds)


def made(kind: str, graph: Graph, track: str) -> LearnedModel:
    torch.manual_seed(0)
    return KINDS[kind](graph, statistics(), KINDS[kind].tracks[track])


def statistics() -> Statistics:
    """Of no consequence for the time."""
    one = Moments(torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    return Statistics(one, one, one, torch.ones(2, dtype=torch.float64))


def drawn(graph: Graph, horizon: int) -> Sample:
    """A batch of random windows with so many frames to come."""
    generator = torch.Generator().manual_seed(0)
    shape = (BATCH, HISTORY + horizon, graph.particle_count, 3)
    position = (
        torch.randn(shape, generator=generator) * 0.1
        + graph.reference[: graph.particle_count].float()
    )
    force = torch.randn((BATCH, horizon, graph.body_count, 3), generator=generator)
    torque = torch.randn((BATCH, horizon, len(graph.mechanism.hinges)), generator=generator)
    start = Start(position[:, :HISTORY], torch.zeros_like(position[:, 0]))
    after = position[:, HISTORY:]
    return Sample(start, KnownInputs(force, torque), after, torch.zeros_like(after))


def adam_of(kind: str, model: LearnedModel, track: str) -> torch.optim.Adam:
    """Our trainer's optimiser; the yardstick has torch's as it comes."""
    if kind == "scatter":
        return torch.optim.Adam(model.parameters())
    recipe: Recipe = KINDS[kind].tracks[track].recipe
    return optimiser(model, recipe)


def step(model: LearnedModel, adam: torch.optim.Adam, sample: Sample) -> Callable[[], None]:
    """A step of training: loss, gradient, new parameters."""

    def descend() -> None:
        adam.zero_grad()
        torch.autograd.backward(model.loss(sample, torch.Generator().manual_seed(0)))
        adam.step()

    return descend


def apart(one: LearnedModel, other: LearnedModel, sample: Sample) -> float:
    """Largest difference of two models' losses and gradients, beside the largest gradient."""
    exact = mapped(sample, Tensor.double)
    found = [gradient(copy.deepcopy(model).double(), exact) for model in (one, other)]
    largest = max(float(grad.abs().max()) for grad in found[0])
    pairs = zip(*found, strict=True)
    return max(float((mine - yours).abs().max()) for mine, yours in pairs) / largest


def gradient(model: LearnedModel, sample: Sample) -> list[Tensor]:
    """Loss and its gradient."""
    loss = model.loss(sample, torch.Generator().manual_seed(0))
    grads = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
    return [loss.detach(), *(grad for grad in grads if grad is not None)]


def mapped(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    """Put other tensors in place of all of a sample's."""
    start, inputs = sample.start, sample.inputs
    return Sample(
        Start(change(start.history), change(start.velocity)),
        KnownInputs(change(inputs.force), change(inputs.torque)),
        change(sample.position),
        change(sample.velocity),
    )


def row(line: Throughput) -> list[str]:
    gns, scatter, sgnn = BATCH / np.median(line.seconds, axis=0)
    low, middle, high = quantiles(line.seconds[:, 1] / line.seconds[:, 0], n=4)
    weights = f"{line.weights[0]:,}, {line.weights[2]:,}"
    ratio = f"{middle:.2f} ({low:.2f} … {high:.2f})"
    rates = (f"{gns:.0f}", f"{scatter:.0f}", ratio, f"{sgnn:.0f}")
    return [line.scene, f"{line.nodes}, {line.edges}", line.track, weights, *rates]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    arguments, device = device_asked(parser)
    torch.set_num_threads(1)
    text = (
        f"Graphs a second in training (loss, gradient, Adam), batch {BATCH}, {UNIT[device]}; "
        "medians of rounds in which the models take turns. *Scatter* is a "
        "straightforward GNS on joined graphs with the same weights, which gives the same loss and "
        f"gradient; *ratio* is GNS over it with its quartiles, aim {AIM[device]}."
    )
    print_head("Training throughput of the graph networks", _COMMAND, text)
    lines = (measure(scene, track, device) for scene in arguments.scenes for track in TRACKS)
    print_table(
        "scene|nodes, edges|track|weights GNS, SGNN|>GNS|>scatter|>ratio|>SGNN", map(row, lines)
    )
    print_made(f"torch {torch.__version__}", on=machine_of(device))


if __name__ == "__main__":
    main()

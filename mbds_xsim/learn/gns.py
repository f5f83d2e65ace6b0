"""The graph network simulator (GNS) of Sanchez-Gonzalez et al., ICML 2020, on a fixed graph.

It maps the last five velocities to an acceleration; absolute positions are not an input. The edges
of the mechanism, which never change, replace the radius graph, and the graph's `spacing` replaces
the radius: it scales edges and heights. Known inputs enter as vectors at the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import keep, mlp
from mbds_xsim.learn.model import Change, PointModel, Symmetry, pushed
from mbds_xsim.learn.recipe import Cosine, Decay, Plateau, Recipe
from mbds_xsim.learn.statistics import CHANNELS, Channels, Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Sample

_KINDS = 2  # of nodes: particle, anchor
_EMBEDDING = 16


class GNSSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of GNS."""

    width: int = 128
    hidden_layers: int = 2
    """Number of hidden layers of every perceptron, before its linear output."""
    steps: int = 10
    """Number of interaction networks, each with its own weights."""
    noise: float = 0.02
    """Noise of the last velocity, relative to the standard deviation of displacements."""
    loss: Literal["mse", "l1"] = "mse"
    """Loss of normalised accelerations, summed over axes. Accelerations of a whipping chain are
    heavy-tailed: in their square, the rare violent frames outweigh all others."""
    recipe: Recipe = Recipe()


class GNS(PointModel):
    """Graph network: encoder, interaction networks with residuals on nodes and edges, decoder."""

    change: ClassVar[Change] = "acceleration"
    mixes: ClassVar[bool] = True
    needs_edges: ClassVar[bool] = True
    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift"})
    tracks: ClassVar[Mapping[str, GNSSettings]] = {
        "paper": GNSSettings(width=200, recipe=Recipe(schedule=Plateau())),
        "native": GNSSettings(recipe=Recipe(schedule=Decay())),
        "lite": GNSSettings(
            width=64,
            steps=5,
            noise=0.0,
            loss="l1",
            recipe=Recipe(rate=1e-3, horizon=4, schedule=Cosine()),
        ),
    }

    def __init__(self, graph: Graph, statistics: Statistics, settings: GNSSettings) -> None:
        super().__init__(graph, statistics, settings)
        self.settings = settings
        self.noise_std = settings.noise * statistics.displacement.spread(graph.moving)
        self._remember(graph, statistics)
        self.channels = Channels(graph)
        self.embedding = nn.Embedding(_KINDS, _EMBEDDING) if graph.static.any() else None
        width, depth = settings.width, settings.hidden_layers
        features = DIMENSION * (HISTORY - 1 + len(CHANNELS)) + self._masses_differ + graph.ground
        features += 0 if self.embedding is None else _EMBEDDING
        self.node_encoder = _perceptron(features, width, depth)
        self.edge_encoder = _perceptron(DIMENSION + 1, width, depth)
        self.interactions = nn.ModuleList(
            InteractionLayer(width, depth) for _ in range(settings.steps)
        )
        self.decoder = mlp(width, DIMENSION, hidden=width, layers=depth + 1, activation=nn.ReLU)

    def _remember(self, graph: Graph, statistics: Statistics) -> None:
        """Store the normalisation with the parameters, and the graph outside them."""
        for name in ("displacement", "acceleration"):
            moments = getattr(statistics, name)
            # Inputs and targets of training are noisy, so deviations include the noise.
            std = torch.sqrt(moments.std**2 + self.noise_std**2)
            self.register_buffer(f"{name}_mean", moments.mean.float())
            self.register_buffer(f"{name}_std", std.float())
        self.register_buffer("channel_size", statistics.channels.float())
        masses = graph.mass[: graph.particle_count]
        # Computed once: reading a tensor in every step would stall a GPU and CUDA graphs.
        self._masses_differ = bool((masses - masses[0]).abs().max() > 1e-9 * masses[0])
        mass = graph.mass / masses.mean()
        keep(self, kind=graph.static.long(), mass=mass.float(), moving=graph.moving.float())
        keep(self, senders=graph.senders, receivers=graph.receivers)

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        return self(history, inputs) * self.acceleration_std + self.acceleration_mean

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        sample = pushed(self, sample)
        history = sample.start.history
        noise = random_walk(history, self.noise_std, generator) * self.moving
        target = self.target(history, noise, sample.position[:, 0])
        error = (self(history + noise, sample.inputs.at(0)) - target) * self.moving
        size = error.abs() if self.settings.loss == "l1" else error**2
        return size.sum(-1).mean()

    def target(self, history: Tensor, noise: Tensor, after: Tensor) -> Tensor:
        """Return the normalised acceleration that leads from a noisy history to the true velocity.

        The next position is shifted by the last noise, so that the model corrects the noise of the
        last velocity, but not that of the last position.
        """
        noisy = history + noise
        noisy_after = after + noise[:, -1]
        acceleration = noisy_after - 2.0 * noisy[:, -1] + noisy[:, -2]
        return (acceleration - self.acceleration_mean) / self.acceleration_std

    def forward(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the normalised acceleration, shape (batch, particle, 3)."""
        # Nodes come first, so that gathers and sums move whole rows of memory.
        nodes = self.node_encoder(self._node_features(history, inputs))
        ends = self.graph.with_anchors(history[:, -1]).transpose(0, 1) / self.graph.spacing
        spans = ends[self.senders] - ends[self.receivers]
        edges = self.edge_encoder(torch.cat([spans, spans.norm(dim=-1, keepdim=True)], dim=-1))
        for interaction in self.interactions:
            nodes, edges = interaction(nodes, edges, self.senders, self.receivers)
        acceleration: Tensor = self.decoder(nodes[: self.graph.particle_count])
        return acceleration.transpose(0, 1)

    def _node_features(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the input features of the nodes, shape (node, batch, feature)."""
        nodes = self.graph.with_anchors(history).permute(2, 0, 1, 3)
        velocity = (nodes.diff(dim=2) - self.displacement_mean) / self.displacement_std
        # An anchor has no velocity, whatever the mean of the particles is.
        velocity = velocity * (self.kind == 0)[:, None, None, None]
        channels = self.channels(history[:, -1], inputs) / self.channel_size[:, None]
        features = [velocity.flatten(2), channels.flatten(2).transpose(0, 1)]
        spread = (*features[0].shape[:2], -1)
        if self.embedding is not None:
            features.append(self.embedding(self.kind)[:, None].expand(spread))
        if self._masses_differ:
            features.append(self.mass[:, None, None].expand(spread))
        if self.graph.ground:
            features.append((nodes[:, :, -1, 2:] / self.graph.spacing).clamp(-1.0, 1.0))
        return torch.cat(features, dim=-1)


class InteractionLayer(nn.Module):
    """One interaction network: messages along edges, their sum at nodes, residuals on both."""

    def __init__(self, width: int, hidden_layers: int) -> None:
        super().__init__()
        self.ends = nn.Linear(3 * width, width)
        self.message = nn.Sequential(nn.ReLU(), *_perceptron(width, width, hidden_layers - 1))
        self.update = _perceptron(2 * width, width, hidden_layers)

    def forward(
        self, nodes: Tensor, edges: Tensor, senders: Tensor, receivers: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Update latents of shape (node, batch, width) and (edge, batch, width)."""
        # The first layer is linear in sender, receiver and edge: the nodes' parts are computed
        # once per node, not once per edge.
        own, other, along = self.ends.weight.chunk(3, dim=1)
        first = nn.functional.linear(edges, along, self.ends.bias)
        first = first + nn.functional.linear(nodes, own).index_select(0, receivers)
        first = first + nn.functional.linear(nodes, other).index_select(0, senders)
        message = self.message(first)
        received = torch.zeros_like(nodes).index_add(0, receivers, message)
        return nodes + self.update(torch.cat([received, nodes], -1)), edges + message


def random_walk(history: Tensor, std: float, generator: torch.Generator) -> Tensor:
    """Draw noise of a history: a random walk of velocities, summed to positions; none at the first.

    `std` is that of the last velocity's noise; the generator draws on its own device.
    """
    shape = (history.shape[0], history.shape[1] - 1, *history.shape[2:])
    steps = torch.randn(shape, generator=generator, device=generator.device)
    walk = steps.to(history).mul(std / math.sqrt(shape[1])).cumsum(1).cumsum(1)
    return torch.cat([torch.zeros_like(history[:, :1]), walk], dim=1)


def _perceptron(inputs: int, width: int, hidden_layers: int) -> nn.Sequential:
    """Build hidden layers, a linear layer, and normalisation over the width."""
    layers = hidden_layers + 1
    return mlp(inputs, width, hidden=width, layers=layers, activation=nn.ReLU, norm=True)

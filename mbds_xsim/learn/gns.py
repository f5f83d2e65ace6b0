"""The graph network simulator (GNS) of Sanchez-Gonzalez et al., ICML 2020, on a fixed graph.

Velocities of five frames in, an acceleration out; absolute positions are no feature. Of the radius
graph there remains its topology, which in a mechanism does not change, and its radius: the scene's
`spacing` scales edges and heights. Known inputs enter as vectors at the nodes.
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
    """Of every perceptron, before its linear output."""
    steps: int = 10
    """Interaction networks, each with weights of its own."""
    noise: float = 0.02
    """Of the last velocity, over the standard deviation of displacements."""
    loss: Literal["mse", "l1"] = "mse"
    """Of normalised accelerations, summed over axes. Those of a chain that whips are heavy-tailed:
    their square asks for little but the rare violent frames."""
    recipe: Recipe = Recipe()


class GNS(PointModel):
    """Encoder, interaction networks with residuals on nodes and edges, decoder."""

    change: ClassVar[Change] = "acceleration"
    mixes: ClassVar[bool] = True
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

    displacement_mean: Tensor
    displacement_std: Tensor
    acceleration_mean: Tensor
    acceleration_std: Tensor
    channel_size: Tensor
    kind: Tensor
    mass: Tensor
    senders: Tensor
    receivers: Tensor
    moving: Tensor

    def __init__(self, graph: Graph, statistics: Statistics, settings: GNSSettings) -> None:
        super().__init__(graph, statistics, settings)
        self.settings = settings
        self.noise_std = settings.noise * statistics.displacement.spread(graph.moving)
        self._remember(graph, statistics)
        self.channels = Channels(graph)
        self.embedding = nn.Embedding(_KINDS, _EMBEDDING) if graph.static.any() else None
        width, depth = settings.width, settings.hidden_layers
        self.node_encoder = _perceptron(self.feature_count, width, depth)
        self.edge_encoder = _perceptron(DIMENSION + 1, width, depth)
        self.interactions = nn.ModuleList(
            InteractionLayer(width, depth) for _ in range(settings.steps)
        )
        self.decoder = mlp(width, DIMENSION, hidden=width, layers=depth + 1, activation=nn.ReLU)

    def _remember(self, graph: Graph, statistics: Statistics) -> None:
        """Keep what normalises with the parameters, and the graph beside them."""
        for name in ("displacement", "acceleration"):
            moments = getattr(statistics, name)
            # What is normalised is noisy, so its deviation is of both.
            std = torch.sqrt(moments.std**2 + self.noise_std**2)
            self.register_buffer(f"{name}_mean", moments.mean.float())
            self.register_buffer(f"{name}_std", std.float())
        self.register_buffer("channel_size", statistics.channels.float())
        own = graph.mass[: graph.particle_count]
        # Found out once: to ask a tensor in every step would hold up a GPU, and CUDA graphs.
        self._masses_differ = bool((own - own[0]).abs().max() > 1e-9 * own[0])
        mass = graph.mass / own.mean()
        keep(self, kind=graph.static.long(), mass=mass.float(), moving=graph.moving.float())
        keep(self, senders=graph.senders, receivers=graph.receivers)

    @property
    def feature_count(self) -> int:
        """Numbers at a node."""
        velocities = DIMENSION * (HISTORY - 1)
        channels = DIMENSION * len(CHANNELS)
        kinds = 0 if self.embedding is None else _EMBEDDING
        return velocities + channels + kinds + int(self._masses_differ) + int(self.graph.ground)

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
        """Give the normalised acceleration that leads from a noisy history to the true velocity.

        The next position is shifted by the last noise, so that the noise of the last velocity is
        corrected, and that of the last position is not.
        """
        noisy = history + noise
        moved = after + noise[:, -1]
        acceleration = moved - 2.0 * noisy[:, -1] + noisy[:, -2]
        return (acceleration - self.acceleration_mean) / self.acceleration_std

    def forward(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Give the normalised acceleration, shape (batch, particle, 3)."""
        # Nodes come first, so that gathering and adding up move whole rows of memory.
        nodes = self.node_encoder(self._node_features(history, inputs))
        ends = self.graph.with_anchors(history[:, -1]).transpose(0, 1) / self.graph.spacing
        apart = ends[self.senders] - ends[self.receivers]
        edges = self.edge_encoder(torch.cat([apart, apart.norm(dim=-1, keepdim=True)], dim=-1))
        for interaction in self.interactions:
            nodes, edges = interaction(nodes, edges, self.senders, self.receivers)
        acceleration: Tensor = self.decoder(nodes[: self.graph.particle_count])
        return acceleration.transpose(0, 1)

    def _node_features(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Shape (node, batch, feature)."""
        nodes = self.graph.with_anchors(history).permute(2, 0, 1, 3)
        velocity = (nodes.diff(dim=2) - self.displacement_mean) / self.displacement_std
        # An anchor has no velocity, whatever the mean of the particles is.
        velocity = velocity * (self.kind == 0)[:, None, None, None]
        acting = self.channels(history[:, -1], inputs) / self.channel_size[:, None]
        features = [velocity.flatten(2), acting.flatten(2).transpose(0, 1)]
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
        # once a node, not once an edge.
        own, other, along = self.ends.weight.chunk(3, dim=1)
        first = nn.functional.linear(edges, along, self.ends.bias)
        first = first + nn.functional.linear(nodes, own).index_select(0, receivers)
        first = first + nn.functional.linear(nodes, other).index_select(0, senders)
        message = self.message(first)
        received = torch.zeros_like(nodes).index_add(0, receivers, message)
        return nodes + self.update(torch.cat([received, nodes], -1)), edges + message


def random_walk(history: Tensor, std: float, generator: torch.Generator) -> Tensor:
    """Noise of a history: a random walk of the velocities, summed to positions; the first has none.

    `std` is that of the last velocity's noise; the generator draws on its own device.
    """
    shape = (history.shape[0], history.shape[1] - 1, *history.shape[2:])
    drawn = torch.randn(shape, generator=generator, device=generator.device)
    walk = drawn.to(history).mul(std / math.sqrt(shape[1])).cumsum(1).cumsum(1)
    return torch.cat([torch.zeros_like(history[:, :1]), walk], dim=1)


def _perceptron(inputs: int, width: int, hidden_layers: int) -> nn.Sequential:
    """Hidden layers, a linear one, and normalisation over the width."""
    layers = hidden_layers + 1
    return mlp(inputs, width, hidden=width, layers=layers, activation=nn.ReLU, norm=True)

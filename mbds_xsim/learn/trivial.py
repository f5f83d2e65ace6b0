"""Models that learn nothing: what every other one must beat."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Change, PointModel
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Sample


class Hold(PointModel):
    """Everything stays where it is. The loss is the mean squared error [m²]."""

    change: ClassVar[Change] = "displacement"

    def __init__(self, graph: Graph, statistics: Statistics, settings: None) -> None:
        super().__init__(graph, statistics, settings)

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        return torch.zeros_like(history[:, -1])

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        del generator
        after = self.positions(self.advance(sample.start.history, sample.inputs.at(0)))
        return ((after - sample.position[:, 0]) ** 2).sum(-1).mean()


class ConstantVelocity(Hold):
    """Every particle goes on as it last did."""

    change: ClassVar[Change] = "acceleration"


class ConstantAcceleration(ConstantVelocity):
    """Every particle goes on accelerating as it last did."""

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        del inputs
        return history[:, -1] - 2.0 * history[:, -2] + history[:, -3]

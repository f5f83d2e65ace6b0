"""Models that learn nothing: what every other one must beat."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Change, PointModel
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Inputs, Sample

__all__ = ["ConstantAcceleration", "ConstantVelocity", "Hold"]


class _Trivial(PointModel):
    """Has no parameters; its loss is its mean squared error [m²]."""

    def __init__(self, graph: Graph, statistics: Statistics, settings: None) -> None:
        super().__init__(graph, statistics, settings)

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        del generator
        after = self.positions(self.advance(sample.start.history, sample.inputs.at(0)))
        return ((after - sample.position[:, 0]) ** 2).sum(-1).mean()


class Hold(_Trivial):
    """Everything stays where it is."""

    change: ClassVar[Change] = "displacement"

    def predict(self, history: Tensor, inputs: Inputs) -> Tensor:
        del inputs
        return torch.zeros_like(history[:, -1])


class ConstantVelocity(_Trivial):
    """Every particle goes on as it last did."""

    change: ClassVar[Change] = "acceleration"

    def predict(self, history: Tensor, inputs: Inputs) -> Tensor:
        del inputs
        return torch.zeros_like(history[:, -1])


class ConstantAcceleration(_Trivial):
    """Every particle goes on accelerating as it last did."""

    change: ClassVar[Change] = "acceleration"

    def predict(self, history: Tensor, inputs: Inputs) -> Tensor:
        del inputs
        return history[:, -1] - 2.0 * history[:, -2] + history[:, -3]

"""What a learned model is, and how its prediction becomes the next frame."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, final

import torch
from torch import Tensor, nn

from mbds_xsim.errors import InputError, UnknownName
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Inputs, Sample, Start

__all__ = ["FlowModel", "Model", "PointModel", "build", "load_model", "model_names"]

Change = Literal["acceleration", "displacement"]


class Model(nn.Module, ABC):
    """A model of one scene. What it carries from frame to frame is a tensor, one row a trajectory.

    A subclass is made by `Model(graph, statistics, settings)`; its parameters are drawn from
    torch's global generator then.
    """

    tracks: ClassVar[Mapping[str, Any]] = {}
    """Hyper-parameters by track: `paper`, `native`, `lite`; none where there is nothing to set."""
    dtype: ClassVar[torch.dtype] = torch.float32
    """Of what it is given, and of its parameters."""
    needs_bodies: ClassVar[bool] = False
    """Whether starts must have the bodies' states."""
    mixes: ClassVar[bool] = False
    """Whether its networks may compute in bfloat16: not where they carry positions."""

    @abstractmethod
    def __init__(self, graph: Graph, statistics: Statistics, settings: Any) -> None:
        super().__init__()
        self.graph = graph

    @abstractmethod
    def begin(self, start: Start) -> Tensor:
        """Give the state at the last known frame, shape (batch, …)."""

    @abstractmethod
    def advance(self, state: Tensor, inputs: Inputs) -> Tensor:
        """Give the state a frame later.

        Args:
            state: Of `begin` or of the frame before.
            inputs: Over the frame to come, shapes (batch, body, 3) and (batch, hinge).
        """

    @abstractmethod
    def positions(self, state: Tensor) -> Tensor:
        """Give the particles' positions in W [m], shape (batch, particle, 3)."""

    @abstractmethod
    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Give what training minimises, a mean over the batch.

        Args:
            sample: Windows of the training part.
            generator: Of the CPU, for noise.
        """


class PointModel(Model):
    """A model that sees the last positions and gives an acceleration or a displacement."""

    change: ClassVar[Change]
    """What `predict` gives: second or first differences of positions [m]."""

    @abstractmethod
    def predict(self, history: Tensor, inputs: Inputs) -> Tensor:
        """Give the change to the next frame [m], shape (batch, particle, 3).

        Args:
            history: Positions, oldest first [m], shape (batch, 6, particle, 3).
            inputs: Over the frame to come.
        """

    @final
    def begin(self, start: Start) -> Tensor:
        return start.history

    @final
    def advance(self, state: Tensor, inputs: Inputs) -> Tensor:
        displacement = _DISPLACEMENT[self.change](state, self.predict(state, inputs))
        # Where the scene does not move, positions are known and the networks are not asked.
        after = state[:, -1] + displacement * self.graph.moving.to(state)
        return torch.cat([state[:, 1:], after[:, None]], dim=1)

    @final
    def positions(self, state: Tensor) -> Tensor:
        return state[:, -1]


class FlowModel(Model):
    """A model that gives the time derivative of coordinates of its own."""

    substeps: int
    """Steps of the classical Runge-Kutta method in a frame."""

    @abstractmethod
    def derivative(self, state: Tensor, inputs: Inputs) -> Tensor:
        """Give the state's time derivative [1/s], of the state's shape."""

    @final
    def advance(self, state: Tensor, inputs: Inputs) -> Tensor:
        step = self.graph.frame_s / self.substeps
        for _ in range(self.substeps):
            first = self.derivative(state, inputs)
            second = self.derivative(state + 0.5 * step * first, inputs)
            third = self.derivative(state + 0.5 * step * second, inputs)
            fourth = self.derivative(state + step * third, inputs)
            state = state + step / 6.0 * (first + 2.0 * (second + third) + fourth)
        return state


def model_names() -> list[str]:
    """Names of all models, the trivial ones last."""
    return list(_PLACES)


def trainable() -> list[str]:
    """Names of the models that have something to learn."""
    return [name for name in model_names() if load_model(name).tracks]


def load_model(name: str) -> type[Model]:
    """Find a model by name.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in _PLACES:
        raise UnknownName.of("model", name, model_names())
    module, kind = _PLACES[name].split(":")
    found: type[Model] = getattr(importlib.import_module(module), kind)
    return found


def build(
    name: str, graph: Graph, statistics: Statistics, *, track: str = "native", seed: int = 0
) -> Model:
    """Make an untrained model: the same seed makes the same parameters.

    Raises:
        UnknownName: There is no such model.
        InputError: It has no such track.
    """
    kind = load_model(name)
    if kind.tracks and track not in kind.tracks:
        msg = f"track: got {track!r}, allowed for {name} is {', '.join(kind.tracks)}"
        raise InputError(msg)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return kind(graph, statistics, kind.tracks.get(track)).to(kind.dtype)


_PLACES = {
    "gns": "mbds_xsim.learn.gns:GNS",
    "sgnn": "mbds_xsim.learn.sgnn:SGNN",
    "hgnn": "mbds_xsim.learn.hgnn:HGNN",
    "lgnn": "mbds_xsim.learn.lgnn:LGNN",
    "hold": "mbds_xsim.learn.trivial:Hold",
    "constant_velocity": "mbds_xsim.learn.trivial:ConstantVelocity",
    "constant_acceleration": "mbds_xsim.learn.trivial:ConstantAcceleration",
}


def _of_acceleration(history: Tensor, acceleration: Tensor) -> Tensor:
    """Semi-implicit Euler in units of frames."""
    return history[:, -1] - history[:, -2] + acceleration


def _of_displacement(history: Tensor, displacement: Tensor) -> Tensor:
    del history
    return displacement


_DISPLACEMENT: dict[Change, Callable[[Tensor, Tensor], Tensor]] = {
    "acceleration": _of_acceleration,
    "displacement": _of_displacement,
}

"""MBD-NODE: a network predicts the accelerations of a mechanism's independent coordinates.

Wang, Wang, Unjhawala, Wu and Negrut, "MBD-NODE: Physics-informed data-driven modeling and
simulation of constrained multibody systems", Nonlinear Dynamics, 2024 (arXiv 2407.08664): one fully
connected network sees the whole state and the inputs, the classical Runge-Kutta method integrates
its accelerations, and constraints hold because it moves only independent coordinates. Here these
are each body's motions on the joint of the tree that carries it (`Links`). Within a frame twists do
not turn with the bodies; at its end the least mass-weighted change puts them on the joints again,
and removes what closed loops forbid. This follows free motion on joints to first order in the
frame, whatever the number of substeps: the network must learn what is left.

The network sees neither masses nor laws, and no contact: it must learn a floor as a stiff force
from the state. It learns from one frame at a time, as all models here do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn import turning
from mbds_xsim.learn.body_model import ADDED, RECIPE, BodyModel
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import mlp, silence
from mbds_xsim.learn.model import runge_kutta
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.rigid import TWIST, Q, V, W, X
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs

_SEEN = 18  # inputs per body: position, frame, velocity and spin


class NodeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of MBD-NODE."""

    width: int = 256
    layers: int = 3
    """Number of linear layers, with tanh between them."""
    substeps: int = 1
    """Number of Runge-Kutta steps per frame."""
    recipe: Recipe = msgspec.structs.replace(RECIPE, rate=1e-3)


class MbdNode(BodyModel):
    """Network that predicts accelerations of bodies on their joints from the whole state."""

    tracks: ClassVar[Mapping[str, NodeSettings]] = {"paper": NodeSettings()}

    def __init__(self, graph: Graph, statistics: Statistics, settings: NodeSettings) -> None:
        super().__init__(graph, statistics, settings)
        self.substeps = settings.substeps
        hinges, bodies = len(graph.mechanism.hinges), graph.body_count
        self.network = mlp(
            bodies * (_SEEN + DIMENSION) + hinges,
            bodies * 2 * DIMENSION,
            hidden=settings.width,
            layers=settings.layers,
            activation=nn.Tanh,
        )
        silence(self.network)

    def predict(self, state: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        for _ in range(self.substeps):
            state = runge_kutta(
                lambda at, _: self.rate(at, inputs), state, self.graph.frame_s / self.substeps
            )
            orientation = state[..., Q] / state[..., Q].norm(dim=-1, keepdim=True)
            state = torch.cat([state[..., X], orientation, state[..., TWIST]], dim=-1)
        kept = self.rigid.hold(state.detach()).kept(state[..., TWIST])
        state = torch.cat([state[..., :7], kept], dim=-1)
        return state, torch.zeros_like(state[:, None, :, TWIST]).expand(-1, ADDED, -1, -1)

    def rate(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the time derivative of states (batch, body, 13) under the frame's inputs."""
        motions = self.network(self._seen(state, inputs).float()).to(state)
        gain = self.on_joints(state, motions.unflatten(-1, (-1, 2, DIMENSION)))
        gain = self.viewer.change / self.graph.frame_s * gain
        spin = torch.cat([torch.zeros_like(state[..., :1]), 0.5 * state[..., W]], dim=-1)
        turning_rate = turning.multiply(spin, state[..., Q])
        return torch.cat([state[..., V], turning_rate, gain], dim=-1)

    def _seen(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        view, unit = self.viewer, self.viewer.change / self.graph.frame_s
        bodies = [
            state[..., X] / self.graph.length,
            turning.matrix(state[..., Q]).flatten(-2),
            state[..., V] / view.speed,
            state[..., W] * view.radius / view.speed,
            inputs.force / (unit * self.rigid.mass),
        ]
        torque = inputs.torque / (unit * self.rigid.mass.mean() * view.radius.mean())
        return torch.cat([torch.cat(bodies, dim=-1).flatten(1), torque], dim=-1)

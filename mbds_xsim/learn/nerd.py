"""NeRD: a transformer that predicts the next change of state in the robot's own frame.

Xu, Heiden, Akinola, Fox, Macklin and Narang, "Neural Robot Dynamics", CoRL 2025 (arXiv 2508.15755):
a causal transformer replaces the solver of a simulator. For each of the last states it sees the
bodies relative to the robot's base, the contact points and their distances from the ground, the
direction of gravity, and the joint drives; it predicts the change of the state. Relative to the
base, motion elsewhere or turned about the vertical looks the same. If a joint or link holds a body
on the world, the base is the world.

As in all models of bodies here, each body changes on the joint that carries it, and the part that
closed loops forbid is removed. Unlike the paper, six states are shown, not ten; the network knows
only the forces of the frame to come; and only the change after the last state is learned, with the
loss of the models of bodies, so that states may attend to later ones: there is no causal mask.
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
from mbds_xsim.learn.layers import keep, mlp, silence
from mbds_xsim.learn.model import Symmetry
from mbds_xsim.learn.recipe import Cosine, Recipe
from mbds_xsim.learn.rigid import TWIST, Q, V, W, X
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import HISTORY, KnownInputs, Start
from mbds_xsim.scene.mechanism import WORLD_INDEX

_BODY, _CONTACT = 18, 5
"""Inputs per body (position, frame, velocity, spin) and per contact (point, gap in two units)."""


class NerdSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of NeRD."""

    width: int = 384
    heads: int = 12
    layers: int = 6
    """Number of attention blocks."""
    read: int = 64
    """Width of the perceptron after the attention blocks."""
    recipe: Recipe = Recipe(rate=1e-3, batch=512, schedule=Cosine(), clip=1.0)


class NeRD(BodyModel):
    """Transformer that predicts changes of bodies on their joints from their last states."""

    tracks: ClassVar[Mapping[str, NerdSettings]] = {
        "paper": NerdSettings(),
        "lite": NerdSettings(
            width=64,
            heads=4,
            layers=2,
            recipe=msgspec.structs.replace(RECIPE, rate=1e-3),
        ),
    }
    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift", "turn"})
    revision: ClassVar[int] = 1

    def __init__(self, graph: Graph, statistics: Statistics, settings: NerdSettings) -> None:
        super().__init__(graph, statistics, settings)
        bodies, spheres = graph.body_count, len(self.viewer.sphere_body)
        forces = DIMENSION * bodies + len(graph.mechanism.hinges)
        inputs = _BODY * bodies + _CONTACT * spheres + DIMENSION + forces
        self.embed = nn.Linear(inputs, settings.width)
        self.place = nn.Embedding(HISTORY, settings.width)
        block = nn.TransformerEncoderLayer(
            settings.width,
            settings.heads,
            4 * settings.width,
            dropout=0.0,
            activation="gelu",
            batch_first=True,
            norm_first=True,
            bias=False,
        )
        last = nn.LayerNorm(settings.width, bias=False)
        self.blocks = nn.TransformerEncoder(
            block, settings.layers, norm=last, enable_nested_tensor=False
        )
        outputs = 2 * ADDED * DIMENSION * bodies
        self.read = mlp(settings.width, outputs, hidden=settings.read, layers=2, activation=nn.ReLU)
        silence(self.read)
        mechanism = graph.mechanism
        held = [(joint.parent, joint.child) for joint in mechanism.joints]
        held += [link.bodies for link in mechanism.distances]
        fixed = any(WORLD_INDEX in ends for ends in held)
        free = (link.body for link in mechanism.links if link.joint is None)
        self.base = None if fixed else next(free, None)
        keep(self, down=nn.functional.normalize(graph.gravity.double(), dim=0))

    def begin(self, start: Start) -> Tensor:
        """Return the bodies' last states in native frames, shape (batch, 6, body, 13)."""
        assert start.body is not None
        return self.native(start.body)

    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        return torch.cat([state[:, 1:], super().advance(state, inputs)[:, None]], dim=1)

    def positions(self, state: Tensor) -> Tensor:
        return super().positions(state[:, -1])

    def predict(self, state: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        origin, frame = self._base(state)
        place = self.place.weight
        tokens = self.embed(self._seen(state, inputs, origin, frame).to(place)) + place
        outputs = self.read(self.blocks(tokens)[:, -1]).to(state)
        outputs = outputs.unflatten(-1, (-1, ADDED, 2, DIMENSION)) @ frame[:, -1, None, None].mT
        last, unit = state[:, -1], self.viewer.speed * self.graph.frame_s
        moved = self.rigid.hold(last).kept(unit * self.on_joints(last, outputs[:, :, 0]))
        # Twists are on the joints where the bodies then are: a pendulum's turns with it.
        after = self.rigid.moved(last, moved.detach())
        hold = self.rigid.hold(after)
        gain = hold.kept(self.viewer.change * self.on_joints(after, outputs[:, :, 1]))
        smooth = torch.cat([last[..., :7], hold.kept(last[..., TWIST])], dim=-1)
        return smooth, torch.stack([moved, gain], dim=1)

    def _base(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the origin (batch, 6, 3) and frame (batch, 6, 3, 3) from which states are seen."""
        if self.base is None:
            origin = state.new_zeros(*state.shape[:2], DIMENSION)
            return origin, torch.eye(DIMENSION).to(state).expand(*state.shape[:2], -1, -1)
        base = state[:, :, self.base]
        return base[..., X], turning.matrix(base[..., Q])

    def _seen(self, state: Tensor, inputs: KnownInputs, origin: Tensor, frame: Tensor) -> Tensor:
        """Return the inputs that describe each state, shape (batch, 6, number)."""
        view, length = self.viewer, self.graph.length
        change = view.change / self.graph.frame_s

        def inside(vectors: Tensor) -> Tensor:
            return (vectors @ frame).flatten(2)

        touch = view.touch(state.flatten(0, 1))
        gap, _, arm = (part.view(*state.shape[:2], *part.shape[1:]) for part in touch)
        points = state[:, :, view.sphere_body, X] + arm - origin[:, :, None]
        force = inputs.force / (change * self.rigid.mass) @ frame[:, -1]
        torque = inputs.torque / (change * self.rigid.mass.mean() * view.radius.mean())
        now = torch.cat([force.flatten(1), torque], dim=-1)
        rotation = frame.mT[:, :, None] @ turning.matrix(state[..., Q])
        return torch.cat(
            [
                inside((state[..., X] - origin[:, :, None]) / length),
                rotation.flatten(2),
                inside(state[..., V] / view.speed),
                inside(state[..., W] * view.radius / view.speed),
                inside(points / length),
                (gap / length).flatten(2),
                torch.asinh(gap / (view.change * self.graph.frame_s)).flatten(2),
                inside(self.down.expand(*state.shape[:2], 1, -1)),
                nn.functional.pad(now[:, None], (0, 0, HISTORY - 1, 0)),
            ],
            dim=-1,
        )

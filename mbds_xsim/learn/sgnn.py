"""SGNN: a subequivariant graph network over objects and their particles.

Han et al., "Learning physical dynamics with subequivariant graph neural networks", NeurIPS 2022.
From two positions it predicts the displacement to the next frame. Every vector quantity has one
unit for all its axes; with a unit per axis, the network would not be equivariant to rotations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.layers import TensorModule, keep
from mbds_xsim.learn.model import Change, PointModel, Symmetry, pushed
from mbds_xsim.learn.recipe import Cosine, Plateau, Recipe
from mbds_xsim.learn.sgnn_network import Hierarchy, Network, pool
from mbds_xsim.learn.statistics import CHANNELS, Channels, Moments, Statistics
from mbds_xsim.learn.window import KnownInputs, Sample

UP = (0.0, 0.0, 1.0)


class SGNNSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of SGNN."""

    hidden: int = 200
    layers: int = 3
    """Number of linear layers of each network."""
    steps: int = 4
    """Number of message-passing steps in each stage."""
    unit: Literal["deviation", "spacing"] = "deviation"
    """Unit of positions: their deviation, or an edge's length, which no large motion increases."""
    target: Literal["displacement", "change"] = "displacement"
    """Output of the network: the displacement, or its change since the last one."""
    loss: Literal["l1", "mse"] = "l1"
    """Loss of the normalised target."""
    noise: float = 0.0
    """Noise on positions in training, relative to the deviation of displacements."""
    rigid: bool = False
    """Whether to project every predicted frame onto rigid bodies."""
    recipe: Recipe = Recipe(schedule=Plateau())


class SGNN(PointModel):
    """Subequivariant graph network for the next displacement of a scene's particles."""

    change: ClassVar[Change] = "displacement"
    needs_edges: ClassVar[bool] = True
    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift", "turn"})
    tracks: ClassVar[Mapping[str, SGNNSettings]] = {
        "paper": SGNNSettings(),
        # The authors of SGNN train with noise and publish rollouts that are projected.
        "native": SGNNSettings(noise=0.05, rigid=True, recipe=Recipe(batch=8, schedule=Plateau())),
        "lite": SGNNSettings(
            hidden=64,
            unit="spacing",
            target="change",
            rigid=True,
            recipe=Recipe(rate=1e-3, horizon=4, schedule=Cosine()),
        ),
    }

    def __init__(self, graph: Graph, statistics: Statistics, settings: SGNNSettings) -> None:
        super().__init__(graph, statistics, settings)
        self.settings = settings
        unit = statistics.isotropic(graph.gravity)
        lengths = {"deviation": float(unit.position.std[0]), "spacing": graph.spacing}
        self.register_buffer("length", torch.tensor(lengths[settings.unit]))
        self.displacement = Unit(unit.displacement)
        kinds = {"displacement": unit.displacement, "change": unit.acceleration}
        self.output = Unit(kinds[settings.target])
        self.channels = Channels(graph)
        self.register_buffer("channel_size", unit.channels.float())
        # Bodies are objects, and so is every anchor.
        anchors = -1 - torch.arange(graph.node_count)
        body = torch.where(graph.static.cpu(), anchors, graph.body.cpu())
        edges = graph.senders.cpu(), graph.receivers.cpu(), graph.inner.cpu()
        mass = graph.mass / graph.mass.max()
        about = torch.stack([graph.static.to(mass), mass], dim=-1).float()
        keep(self, about=about, up=UP)
        self.network = Network(
            Hierarchy(*edges, body),
            externals=len(CHANNELS) + graph.ground,
            scalars=about.shape[-1] + graph.ground,
            down=nn.functional.normalize(graph.gravity, dim=0).float(),
            hidden=settings.hidden,
            layers=settings.layers,
            steps=settings.steps,
        )

    def predict(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        last = history[:, -1] - history[:, -2]
        predicted = self.output.restore(self.normalised(history, inputs))
        displacement = predicted + last if self.settings.target == "change" else predicted
        if not self.settings.rigid:
            return displacement
        now, owner = history[:, -1], self.graph.body[: self.graph.particle_count]
        return nearest_rigid(now, now + displacement, owner.to(now.device)) - now

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        sample = pushed(self, sample)
        history, after = self.noisy(sample, generator)
        predicted = self.normalised(history, sample.inputs.at(0))
        target = self.target(history, after)
        error = (predicted - target) * self.graph.moving.to(predicted)
        return error.abs().mean() if self.settings.loss == "l1" else error.square().mean()

    def noisy(self, sample: Sample, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return noisy positions, and the next one shifted by the noise of the last of them.

        The displacement to it is the true one, so the model learns to correct the error of the
        velocity and to keep that of the position.
        """
        history = sample.start.history
        noise = torch.randn(history.shape, generator=generator).to(history)
        noise = self.settings.noise * self.displacement.std * noise * self.graph.moving.to(noise)
        return history + noise, sample.position[:, 0] + noise[:, -1]

    def target(self, history: Tensor, after: Tensor) -> Tensor:
        """Return the target of `normalised` for the next position `after`, (batch, particle, 3)."""
        step, last = after - history[:, -1], history[:, -1] - history[:, -2]
        return self.output.normalise(step - last if self.settings.target == "change" else step)

    def normalised(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the network's prediction for the particles, shape (batch, particle, 3)."""
        nodes = self.graph.with_anchors(history[:, -2:])
        now, last = nodes[:, 1], nodes[:, 1] - nodes[:, 0]
        vectors = self.polar(now, self.channels(history[:, -1], inputs))
        scalars = self.about.expand(len(now), -1, -1)
        if self.graph.ground:
            # Exact near the ground, and bounded where it does not matter.
            height = nn.functional.softsign(now @ self.up[:, None] / self.length)
            vectors = torch.cat([vectors, (height * self.up).unsqueeze(-2)], dim=-2)
            scalars = torch.cat([scalars, height], dim=-1)
        velocity = self.displacement.normalise(last)
        predicted = self.network(now / self.length, velocity, vectors, scalars)
        return predicted[:, : self.graph.particle_count]

    def polar(self, now: Tensor, channels: Tensor) -> Tensor:
        """Return forces as they are, and torques as torque × arm from the object's centre.

        A torque is an axial vector: no combination of it with forces and positions both rotates and
        mirrors with the frame. Its cross product with an arm does, and points where it pushes.
        """
        force, torque = (channels / self.channel_size[:, None]).unbind(-2)
        hierarchy = self.network.hierarchy
        arm = (now - (hierarchy.members @ now)[:, hierarchy.object_of]) / self.length
        return torch.stack([force, torch.linalg.cross(torque, arm)], dim=-2)


class Unit(TensorModule):
    """Mean, and one deviation for all axes, stored with the model."""

    def __init__(self, moments: Moments) -> None:
        super().__init__()
        self.register_buffer("mean", moments.mean.float())
        self.register_buffer("std", moments.std[0].float())

    def normalise(self, vectors: Tensor) -> Tensor:
        """Subtract the mean from vectors (…, 3) and divide by the deviation."""
        return (vectors - self.mean) / self.std

    def restore(self, vectors: Tensor) -> Tensor:
        """Undo `normalise`."""
        return vectors * self.std + self.mean


def nearest_rigid(shape: Tensor, predicted: Tensor, object_of: Tensor) -> Tensor:
    """Move each object rigidly, as close as possible to the predicted positions of its particles.

    The motion has the least sum of squared distances and is proper: never a mirror image. An
    object of one particle, or of particles on a line, keeps its shape trivially. A row with a
    number that is not finite becomes NaN.

    W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32
    (1976) 922.

    Args:
        shape: Particles at the right distances, in any pose, shape (…, particle, 3).
        predicted: Predicted positions, same shape.
        object_of: Object of each particle, numbered from 0 without gaps, shape (particle,).
    """
    kind = torch.arange(int(object_of.max()) + 1, device=object_of.device)
    if len(kind) == len(object_of):
        return predicted  # a point has no shape, and decompositions are expensive
    membership = (object_of == kind[:, None]).to(predicted)
    members = membership / membership.sum(dim=1, keepdim=True)
    arms = shape - (members @ shape)[..., object_of, :]
    centre = members @ predicted
    predicted_arms = predicted - centre[..., object_of, :]
    products = predicted_arms.unsqueeze(-1) * arms.unsqueeze(-2)
    covariance = pool(membership, products)
    rotated_arms = (_rotation(covariance)[..., object_of, :, :] @ arms.unsqueeze(-1)).squeeze(-1)
    return centre[..., object_of, :] + rotated_arms


def _rotation(covariance: Tensor) -> Tensor:
    """Return the rotation nearest to a matrix (…, 3, 3); any if not finite, where an SVD fails."""
    finite = covariance.isfinite().all(dim=-1).all(dim=-1)[..., None, None]
    left, _, right = torch.linalg.svd(torch.where(finite, covariance, 0.0))
    signs = torch.ones_like(left[..., 0])
    signs[..., -1] = torch.det(left @ right).sign()
    return left @ (signs.unsqueeze(-1) * right)

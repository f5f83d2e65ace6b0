"""SGNN: a subequivariant graph network over objects and their particles.

Han et al., "Learning physical dynamics with subequivariant graph neural networks", NeurIPS 2022.
From two positions it predicts the displacement to the next frame. Every quantity with a direction
has one unit for all its axes; with a unit for each, a rotation would not pass through.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.layers import keep
from mbds_xsim.learn.model import Change, PointModel, Symmetry, pushed
from mbds_xsim.learn.recipe import Cosine, Plateau, Recipe
from mbds_xsim.learn.sgnn_network import Hierarchy, Network, pool
from mbds_xsim.learn.statistics import CHANNELS, Channels, Moments, Statistics
from mbds_xsim.learn.window import KnownInputs, Sample

UP = (0.0, 0.0, 1.0)


class SGNNSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an SGNN is made of and how it learns."""

    hidden: int = 200
    layers: int = 3
    """Linear layers of each network."""
    steps: int = 4
    """Of message passing in each stage."""
    unit: Literal["deviation", "spacing"] = "deviation"
    """Of positions: their deviation, or the length of an edge, which far motions do not dwarf."""
    target: Literal["displacement", "change"] = "displacement"
    """What the network gives: the displacement, or its change since the last one."""
    loss: Literal["l1", "mse"] = "l1"
    """Of the normalised target."""
    noise: float = 0.0
    """On both positions in training, as a part of the displacements' deviation."""
    rigid: bool = False
    """Project every predicted frame onto rigid bodies."""
    recipe: Recipe = Recipe(schedule=Plateau())


class SGNN(PointModel):
    """The next displacement of a scene's particles."""

    change: ClassVar[Change] = "displacement"
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
    length: Tensor
    channel_size: Tensor
    about: Tensor
    up: Tensor

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
        alone = -1 - torch.arange(graph.node_count)
        body = torch.where(graph.static.cpu(), alone, graph.body.cpu())
        edges = graph.senders.cpu(), graph.receivers.cpu(), graph.inner.cpu()
        heavy = graph.mass / graph.mass.max()
        about = torch.stack([graph.static.to(heavy), heavy], dim=-1).float()
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
        given = self.output.restore(self.normalised(history, inputs))
        displacement = given + last if self.settings.target == "change" else given
        if not self.settings.rigid:
            return displacement
        now, owner = history[:, -1], self.graph.body[: self.graph.particle_count]
        return nearest_rigid(now, now + displacement, owner.to(now.device)) - now

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        sample = pushed(self, sample)
        history, after = self.noisy(sample, generator)
        given = self.normalised(history, sample.inputs.at(0))
        wanted = self.target(history, after)
        miss = (given - wanted) * self.graph.moving.to(given)
        return miss.abs().mean() if self.settings.loss == "l1" else miss.square().mean()

    def noisy(self, sample: Sample, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Disturb the positions, and give the next one, moved along with the last of them.

        The displacement to it is the true one, so that the velocity's error is to be corrected, the
        position's kept.
        """
        history = sample.start.history
        noise = torch.randn(history.shape, generator=generator).to(history)
        noise = self.settings.noise * self.displacement.std * noise * self.graph.moving.to(noise)
        return history + noise, sample.position[:, 0] + noise[:, -1]

    def target(self, history: Tensor, after: Tensor) -> Tensor:
        """Give what `normalised` should be if a position (batch, particle, 3) follows."""
        step, last = after - history[:, -1], history[:, -1] - history[:, -2]
        return self.output.normalise(step - last if self.settings.target == "change" else step)

    def normalised(self, history: Tensor, inputs: KnownInputs) -> Tensor:
        """Give the network's prediction for the particles, shape (batch, particle, 3)."""
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
        moved = self.network(now / self.length, velocity, vectors, scalars)
        return moved[:, : self.graph.particle_count]

    def polar(self, now: Tensor, channels: Tensor) -> Tensor:
        """Forces as they are, torques as torque × arm from the object's centre.

        A torque is an axial vector: no combination of it with forces and positions turns with the
        frame *and* mirrors with it. Its product with an arm does both, and points where it pushes.
        """
        force, torque = (channels / self.channel_size[:, None]).unbind(-2)
        hierarchy = self.network.hierarchy
        arm = (now - (hierarchy.members @ now)[:, hierarchy.object_of]) / self.length
        return torch.stack([force, torch.linalg.cross(torque, arm)], dim=-2)


class Unit(nn.Module):
    """A mean and one deviation for all axes, stored with the model."""

    mean: Tensor
    std: Tensor

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
    """Move each object's shape, without deforming it, next to where its particles were predicted.

    The motion has the least sum of squared distances and is proper: never a mirror image. An
    object of one particle, or of particles on a line, keeps its shape trivially. Where a row
    has a number that is not finite, its result is not a number.

    W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32
    (1976) 922.

    Args:
        shape: Particles with the right distances, any pose, shape (…, particle, 3).
        predicted: Of the same shape.
        object_of: The object of each particle, from 0 without gaps, shape (particle,).
    """
    kind = torch.arange(int(object_of.max()) + 1, device=object_of.device)
    if len(kind) == len(object_of):
        return predicted  # a point has no shape to keep, and decompositions are dear
    belongs = (object_of == kind[:, None]).to(predicted)
    members = belongs / belongs.sum(dim=1, keepdim=True)
    arms = shape - (members @ shape)[..., object_of, :]
    centre = members @ predicted
    reached = predicted - centre[..., object_of, :]
    products = reached.unsqueeze(-1) * arms.unsqueeze(-2)
    covariance = pool(belongs, products)
    turned = (_rotation(covariance)[..., object_of, :, :] @ arms.unsqueeze(-1)).squeeze(-1)
    return centre[..., object_of, :] + turned


def _rotation(covariance: Tensor) -> Tensor:
    """Rotation nearest to a matrix (…, 3, 3); any where it is not finite, as an SVD would fail."""
    finite = covariance.isfinite().all(dim=-1).all(dim=-1)[..., None, None]
    left, _, right = torch.linalg.svd(torch.where(finite, covariance, 0.0))
    signs = torch.ones_like(left[..., 0])
    signs[..., -1] = torch.det(left @ right).sign()
    return left @ (signs.unsqueeze(-1) * right)

"""Inputs of networks at the nodes, and statistics for normalisation.

Means and deviations are computed from training trajectories only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import TensorModule, keep
from mbds_xsim.learn.window import KnownInputs, Motions
from mbds_xsim.scene.mechanism import WORLD_INDEX, PlacedJoint
from mbds_xsim.scene.sampling_terms import HingeTorque

AxisWeights = dict[str, Array]
"""Weights by which a hinge's axis follows from the particles; see the buffers of `Channels`."""

CHANNELS = ("force", "torque")
"""Vectors of a node: its share by mass of its body's force [N], and its body's torque [N·m]."""

_RANK = 1e-6  # of the largest extent of a body's particles
_ROWS = 64  # trajectories at a time
_NEGLIGIBLE = 1e-9  # of the scene's length: smaller deviations are rounding
_KINDS = ("position", "displacement", "acceleration")


class Channels(TensorModule):
    """Module that turns inputs into vectors at the nodes.

    A rollout knows only particles, so the axis of a driven hinge must follow from them. If they
    span space, it is a fixed combination of their positions; if they span a plane, its part normal
    to the plane is along the cross product of two such combinations. Both turn with the body.
    """

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        driven = {load.joint for load in graph.scene.torques}
        driven |= {servo.joint for servo in graph.scene.servos}
        for term in graph.scene.sampling:
            driven |= set(term.joints) if isinstance(term, HingeTorque) else set()
        hinges = graph.mechanism.hinges
        idle = _idle(graph)
        weights = [_weights(graph, hinge) if hinge.name in driven else idle for hinge in hinges]
        for name, nothing in idle.items():
            values = np.array([each[name] for each in weights]).reshape(-1, len(nothing))
            keep(self, **{name: torch.from_numpy(values).float()})
        # 1 if a node is on a hinge's child, −1 if on its parent, (node, hinge).
        body, mass = graph.body.cpu(), graph.mass.cpu()
        child = torch.tensor([hinge.child for hinge in hinges], dtype=torch.int64)
        parent = torch.tensor([hinge.parent for hinge in hinges], dtype=torch.int64)
        acts = (body[:, None] == child).double() - (body[:, None] == parent).double()
        acts = acts * (body >= 0)[:, None]
        # Share of its body's mass in each node, 0 in anchors, (node,).
        body_mass = torch.from_numpy(graph.mechanism.mass)
        share = torch.where(body >= 0, mass / body_mass[body.clamp(min=0)], 0.0)
        keep(self, acts=acts.float(), share=share.float(), owner=graph.body.clamp(min=0))

    def forward(self, particles: Tensor, inputs: KnownInputs) -> Tensor:
        """Return the vectors at the nodes, shape (…, node, channel, 3).

        `particles` are positions in W [m], (…, particle, 3); `inputs` are of one frame.
        """
        force = inputs.force[..., self.owner, :] * self.share[:, None]
        torque = self.acts @ (inputs.torque[..., None] * self.axes(particles))
        return torch.stack([force, torque], dim=-2)

    def axes(self, particles: Tensor) -> Tensor:
        """Return the unit axes of the driven hinges in W, 0 for others, shape (…, hinge, 3)."""
        normal = torch.linalg.cross(self.first @ particles, self.second @ particles)
        return nn.functional.normalize(self.along @ particles + normal + self.fixed, dim=-1)


def _idle(graph: Graph) -> AxisWeights:
    """Return the weights of a hinge that is not driven."""
    particles = {name: np.zeros(graph.particle_count) for name in ("along", "first", "second")}
    return {**particles, "fixed": np.zeros(3)}


def _weights(graph: Graph, hinge: PlacedJoint) -> AxisWeights:
    if hinge.parent == WORLD_INDEX or graph.scene.dimension < 3:
        return {**_idle(graph), "fixed": hinge.axis}
    for body in (hinge.parent, hinge.child):
        weights = _of_body(graph, body, hinge.axis)
        if weights is not None:
            return weights
    raise Unsupported(
        f"joint {hinge.name!r} is driven, but the particles of each of its bodies are on one line, "
        "which does not show its axis; give one body a particle off that line"
    )


def _of_body(graph: Graph, body: int, axis: Array) -> AxisWeights | None:
    """Return the weights of a body's particles, or None if they do not determine the axis."""
    nodes = np.flatnonzero(graph.body.cpu().numpy() == body)
    points = graph.reference.cpu().numpy()[nodes]
    arms = points - points.mean(axis=0)
    extents, directions = np.linalg.svd(arms, full_matrices=False)[1:]
    rank = int(np.sum(extents > _RANK * graph.length))
    spanned = directions[:rank]
    inside = spanned.T @ (spanned @ axis)
    outside = axis - inside
    if rank < 2 and np.linalg.norm(outside) > _RANK:
        return None
    inverse = np.linalg.pinv(arms.T, rcond=_RANK)
    weights = _idle(graph)
    weights["along"][nodes] = inverse @ inside
    if rank == 2:
        normal = np.cross(spanned[0], spanned[1])
        weights["first"][nodes] = inverse @ spanned[0] * (outside @ normal)
        weights["second"][nodes] = inverse @ spanned[1]
    return weights


@dataclass(frozen=True, eq=False)
class Moments:
    """Mean and standard deviation of a vector per axis, shape (3,), float64."""

    mean: Tensor
    std: Tensor
    """Standard deviation; 1 along axes without variation."""

    def spread(self, moving: Tensor) -> float:
        """Return the root mean square of the deviations along moving axes that vary."""
        varying = moving.to(self.std.device) & (self.std != 1.0)
        deviations = self.std[varying if varying.any() else moving.to(self.std.device)]
        return float(deviations.square().mean().sqrt())

    def isotropic(self, up: Tensor) -> Moments:
        """Return moments that commute with turns about `up`: one deviation, a mean along `up`."""
        axis = torch.nn.functional.normalize(up, dim=0)
        varying = self.std != 1.0
        mean = (self.mean @ axis) * axis
        square = (self.std**2 + (self.mean - mean) ** 2)[varying]
        std = torch.sqrt(square.mean()) if len(square) else torch.ones(()).to(square)
        return Moments(mean, std.expand(3).clone())


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of the particles over all training trajectories and frames."""

    position: Moments
    """Positions [m]."""
    displacement: Moments
    """Displacements from one frame to the next [m]."""
    acceleration: Moments
    """Second differences of positions [m]."""
    channels: Tensor
    """Root mean square size of each of `CHANNELS` where it acts [N, N·m]; 1 if it never acts."""

    @staticmethod
    def of(motions: Motions) -> Statistics:
        """Compute the statistics; raise InputError if `motions` are not the training part."""
        if motions.split != "train":
            raise InputError(f"statistics: got the part {motions.split!r}, allowed is 'train'")
        first, second, third = (_moments(motions, order) for order in range(3))
        return Statistics(first, second, third, _sizes(motions))

    @staticmethod
    def of_nothing() -> Statistics:
        """Return the statistics of a scene without motion."""
        one = Moments(torch.zeros(DIMENSION).double(), torch.ones(DIMENSION).double())
        return Statistics(one, one, one, torch.ones(len(CHANNELS)).double())

    def isotropic(self, gravity: Tensor) -> Statistics:
        """Return statistics that commute with turns about gravity."""
        up = gravity.to(self.channels)
        return dataclasses.replace(
            self, **{name: getattr(self, name).isotropic(up) for name in _KINDS}
        )

    def to_state(self) -> dict[str, Tensor]:
        """Return plain tensors to store with a model."""
        moments = {
            f"{name}.{k}": v for name in _KINDS for k, v in vars(getattr(self, name)).items()
        }
        return {"channels": self.channels, **moments}

    @staticmethod
    def from_state(state: dict[str, Tensor]) -> Statistics:
        """Restore statistics from `to_state`."""
        first, second, third = (Moments(state[f"{k}.mean"], state[f"{k}.std"]) for k in _KINDS)
        return Statistics(first, second, third, state["channels"])


def _moments(motions: Motions, order: int) -> Moments:
    """Compute moments of differences of an order; two passes, so large means cost no digits."""

    def mean(transform: Callable[[Tensor], Tensor]) -> Tensor:
        total, count = torch.zeros(3, dtype=torch.float64), 0
        for k in range(0, len(motions), _ROWS):
            part = motions.position[k : k + _ROWS].double()
            values = part.diff(n=order, dim=1) if order else part
            total += transform(values).sum((0, 1, 2)).cpu()
            count += values[..., 0].numel()
        return total / count

    middle = mean(lambda values: values)
    std = torch.sqrt(mean(lambda values: (values - middle.to(values.device)) ** 2))
    return Moments(middle, torch.where(std > _NEGLIGIBLE * motions.graph.length, std, 1.0))


def _sizes(motions: Motions) -> Tensor:
    channels = Channels(motions.graph).to(motions.position.device)
    square = torch.zeros(len(CHANNELS), dtype=torch.float64)
    count = torch.zeros(len(CHANNELS), dtype=torch.float64)
    for k in range(0, len(motions), _ROWS):
        part = motions[k : k + _ROWS]
        inputs = KnownInputs(part.inputs.force.float(), part.inputs.torque.float())
        vectors = channels(part.position[:, :-1].float(), inputs).double()
        square += (vectors**2).sum((0, 1, 2, 4)).cpu()
        count += (vectors != 0).any(-1).sum((0, 1, 2)).cpu()
    return torch.where(count > 0, torch.sqrt(square / count.clamp(min=1)), 1.0)

"""Kinetic and potential energies of HGNN and LGNN, and the networks that learn them.

Kinetic energy is a sum over nodes of f(|v_i|²) and over rods (a body's tip and centre of mass) of
f(|v_i − v_j|²). The rods represent rotation and couple neighbouring nodes. The first and second
derivatives of f have closed forms, and so has the mass matrix ∂²T/∂v². The learned V depends on
positions and, by message passing, on distances.

Sources: Bhattoo, Ranu, Krishnan, NeurIPS 2022, and Bishnoi et al., ICLR 2023; the energy of rods is
not in these papers. Units are the scene's length, √(length / gravity) for times, and known masses
for kinetic terms. Functions of squared speeds are convex and increasing (Amos, Xu, Kolter: Input
convex neural networks, ICML 2017), so the mass matrix is positive definite for all parameters.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.learn.layers import TensorModule, keep, mixed, mlp, silence
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.mechanics_points import distinct, kinds_of
from mbds_xsim.scene.sampling import noise_components


@dataclass(frozen=True)
class Kinetic:
    """Kinetic energies of free nodes and of rods, as functions of squared speeds."""

    value: Tensor
    """Energies f [J], shape (batch, node + rod)."""
    first: Tensor
    """First derivatives f′ [kg], same shape."""
    second: Tensor
    """Second derivatives f″ [kg·s²/m²], same shape."""


class NodeEnergy(Protocol):
    """Kinetic and potential energy of a Lagrangian or Hamiltonian."""

    mechanics: Mechanics

    def kinetic(self, v: Tensor) -> Kinetic:
        """Return the kinetic energy at velocities of the free nodes (batch, node, 3)."""

    def potential(self, q: Tensor) -> Tensor:
        """Return the potential energy [J], shape (batch,), at free nodes (batch, node, 3)."""


def momentum(mechanics: Mechanics, kinetic: Kinetic, v: Tensor) -> Tensor:
    """Return ∂T/∂v, shape (batch, node, 3)."""
    terms = 2.0 * kinetic.first[..., None] * mixed(mechanics.speed_map, v)
    return mixed(mechanics.speed_map.T, terms)


class MassMatrix:
    """Mass matrix ∂²T/∂v² at given velocities: blocks 2 f′ 1 + 4 f″ v vᵀ of nodes and rods."""

    def __init__(self, energy: NodeEnergy, v: Tensor) -> None:
        self.mechanics, self.kinetic = energy.mechanics, energy.kinetic(v)
        self.each = mixed(self.mechanics.speed_map, v)  # velocities of nodes and rods

    def times(self, v: Tensor) -> Tensor:
        """Return the product with v, shape (batch, node, 3)."""
        vector, each, kinetic = mixed(self.mechanics.speed_map, v), self.each, self.kinetic
        own = 2.0 * kinetic.first[..., None] * vector
        along = kinetic.second[..., None] * (each * vector).sum(-1, keepdim=True)
        return mixed(self.mechanics.speed_map.T, own + 4.0 * along * each)

    def dense(self) -> Tensor:
        """Return the matrix in closed form, shape (batch, 3 · node, 3 · node), by columns."""
        each, kinetic, size = self.each, self.kinetic, 3 * self.mechanics.free
        outer = 4.0 * kinetic.second[..., None, None] * each[..., :, None] * each[..., None, :]
        own = 2.0 * kinetic.first[..., None, None] * torch.eye(3).to(each) + outer
        blocks = (self.mechanics.coupling @ own.flatten(-2)).flatten(1)
        flat = each.new_zeros(len(each), size * size)
        flat.index_copy_(1, self.mechanics.block, blocks)
        return flat.view(len(each), size, size).mT


def potential_force(energy: NodeEnergy, q: Tensor) -> Tensor:
    """Return −∂V/∂q [N], shape (batch, node, 3); differentiable if gradients are enabled."""
    outer = torch.is_grad_enabled()
    with torch.enable_grad():
        place = q if q.requires_grad else q.detach().requires_grad_()
        (slope,) = torch.autograd.grad(energy.potential(place).sum(), place, create_graph=outer)
    return -slope


class EnergyShape(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Size of the networks."""

    width: int = 5
    """Width of hidden layers, embeddings and messages."""
    hidden_layers: int = 2
    passes: int = 1
    """Number of rounds of message passing."""
    bend: float = 1.0
    """Weight of the network's kinetic energy relative to that of the known masses; the smaller,
    the closer to the latter learning starts."""


class SquarePlus(nn.Module):
    """Activation (x + √(x² + 4)) / 2: smooth, convex, increasing."""

    def forward(self, x: Tensor) -> Tensor:
        return _squareplus(x)


class ConvexScalar(nn.Module):
    """Convex increasing function of one number for each kind, with two derivatives."""

    def __init__(self, kinds: int, shape: EnergyShape) -> None:
        super().__init__()
        width, layers, self.bend = shape.width, shape.hidden_layers, shape.bend
        sizes = [1, *[width] * layers]
        self.raw = nn.ParameterList(
            0.5 * torch.randn(after, before) for before, after in itertools.pairwise(sizes)
        )
        self.last = nn.Parameter(0.5 * torch.randn(width) - 2.0)
        self.shift = nn.Embedding(kinds, layers * width)
        self.slope = nn.Embedding(kinds, 1)
        nn.init.zeros_(self.slope.weight)

    def forward(self, s: Tensor, kind: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values, first and second derivatives, each (batch, k), at s for kinds (k,)."""
        shifts = self.shift(kind).chunk(len(self.raw), dim=-1)
        weight = _squareplus(self.raw[0])[:, 0]
        jet = _bend(s[..., None] * weight + shifts[0], weight, None)
        for raw, shift in itertools.islice(zip(self.raw, shifts, strict=True), 1, None):
            across = (_squareplus(raw) / raw.shape[1]).T
            value, first, second = (part @ across for part in jet)
            jet = _bend(value + shift, first, second)
        across = self.bend * _squareplus(self.last) / len(self.last)
        value, first, second = (part @ across for part in jet)
        slope = 0.5 * _squareplus(self.slope(kind))[:, 0]
        return value + slope * s, first + slope, second


class Potential(TensorModule):
    """Potential V over its unit, as a function of positions over the scene's length."""

    axes: Tensor
    """1 along axes in which the scene moves, else 0: no learned force may leave a plane motion."""

    def __init__(self, mechanics: Mechanics, shape: EnergyShape) -> None:
        super().__init__()
        width = shape.width
        kind, kinds = kinds_of(mechanics.points)
        axes = torch.zeros(3)
        axes[noise_components(mechanics.mechanism.scene)] = 1.0
        keep(self, kind=kind, axes=axes)
        self.embed = nn.Embedding(kinds, width)
        self.of_place = _perceptron(width + 3, 1, shape)
        self.slope = nn.Linear(width, 3)
        # Without springs distances are constant: the gradient of a function of them lies along the
        # constraints, whose forces cancel it.
        self.of_distances = OfDistances(mechanics, shape) if mechanics.mechanism.springs else None

    def silence(self) -> None:
        """Start with almost no force, because a random one would have to be unlearned first."""
        of_distances = self.of_distances
        springs = [] if of_distances is None else [of_distances.of_edge, of_distances.of_node]
        silence(self.of_place, nn.Sequential(self.slope), *springs)

    def forward(self, x: Tensor) -> Tensor:
        """Return V, shape (batch,), at all nodes (batch, all nodes, 3)."""
        place = x[:, : len(self.kind)] * self.axes
        kind = self.embed(self.kind).expand(len(x), -1, -1)
        node_energy = self.of_place(torch.cat([kind, place], -1))[..., 0]
        energy = (node_energy + (self.slope(kind) * place).sum(-1)).sum(1)
        return energy if self.of_distances is None else energy + self.of_distances(x, kind)


class OfDistances(TensorModule):
    """Part of V from message passing on distances."""

    def __init__(self, mechanics: Mechanics, shape: EnergyShape) -> None:
        super().__init__()
        width = shape.width
        edge_map, ends, law = _edges(mechanics)
        keep(self, edge_map=edge_map, ends=ends, kind=law)
        self.passes = shape.passes
        self.embed = nn.Embedding(int(self.kind.max()) + 1, width)
        self.of_distance = _perceptron(width + 1, width, shape)
        self.message = _perceptron(2 * width, width, shape)
        self.renew = _perceptron(width, width, shape)
        self.of_edge = _perceptron(width, 1, shape)
        self.of_node = _perceptron(width, 1, shape)

    def forward(self, x: Tensor, node: Tensor) -> Tensor:
        """Return this part of V, (batch,), at all nodes (batch, all nodes, 3) with embeddings."""
        span = torch.linalg.vector_norm(self.edge_map @ x, dim=-1, keepdim=True)
        kind = self.embed(self.kind).expand(len(x), -1, -1)
        edge = self.of_distance(torch.cat([kind, span], -1))
        for _ in range(self.passes):
            a, b = node[:, self.ends[0]], node[:, self.ends[1]]
            node = node.index_add(1, self.ends[0], self.message(torch.cat([a, edge], -1)))
            node = node.index_add(1, self.ends[1], self.message(torch.cat([b, edge], -1)))
            edge = edge + self.renew(node[:, self.ends[0]] * node[:, self.ends[1]])
        return self.of_edge(edge).sum((1, 2)) + self.of_node(node).sum((1, 2))


class EnergyNetwork(TensorModule):
    """Learned kinetic and potential energy (a `NodeEnergy`)."""

    kind: Tensor
    """Kind of each free node, then of each rod."""

    def __init__(self, mechanics: Mechanics, shape: EnergyShape) -> None:
        super().__init__()
        self.mechanics = mechanics
        points = mechanics.points
        node_kind, node_kinds = kinds_of(points)
        rods = np.stack([points.rod_mass, points.rod_length], axis=1)
        kind = np.concatenate([node_kind[: points.free], node_kinds + distinct(rods)])
        keep(self, kind=kind)
        self.kinds = int(kind.max()) + 1
        scene = mechanics.mechanism.scene
        self.length, gravity = scene.length, math.hypot(*scene.gravity)
        self.square_speed = (gravity or scene.length) * scene.length
        self.unit = self.square_speed * float(points.mass[points.mass > 0].mean())
        self.of_speed = ConvexScalar(self.kinds, shape)
        self.of_place = Potential(mechanics, shape)

    def kinetic(self, v: Tensor) -> Kinetic:
        square, mass = self.square_speed, self.mechanics.moved_mass
        speed = mixed(self.mechanics.speed_map, v).square().sum(-1) / square
        value, first, second = self.of_speed(speed, self.kind)
        return Kinetic(mass * square * value, mass * first, mass / square * second)

    def potential(self, q: Tensor) -> Tensor:
        energy: Tensor = self.of_place(self.mechanics.all_nodes(q) / self.length)
        return self.unit * energy


class Drag(nn.Module):
    """Learned force −c v at nodes and between ends of rods; c ≥ 0, so it only removes energy."""

    def __init__(self, energy: EnergyNetwork, shape: EnergyShape) -> None:
        super().__init__()
        self.energy = [energy]  # in a list, so that its parameters are not the drag's
        self.embed = nn.Embedding(energy.kinds, shape.width)
        self.of_speed = _perceptron(shape.width + 1, 1, shape)

    def forward(self, v: Tensor) -> Tensor:
        """Return forces on the free nodes [N], shape (batch, node, 3), at their velocities."""
        (energy,) = self.energy
        mechanics = energy.mechanics
        velocity = mixed(mechanics.speed_map, v)
        # As a function of the speed itself, a whip's drag would make the integrator unstable.
        speed = torch.log1p(velocity.square().sum(-1)[..., None] / energy.square_speed)
        kinds = self.embed(energy.kind).expand(len(v), -1, -1)
        share = 0.1 * self.of_speed(torch.cat([kinds, speed], -1)) ** 2
        rate = math.sqrt(energy.square_speed) / energy.length
        push = rate * mechanics.moved_mass[:, None] * share * velocity
        return -mixed(mechanics.speed_map.T, push)


def _squareplus(x: Tensor) -> Tensor:
    return 0.5 * (x + torch.sqrt(x * x + 4.0))


def _bend(value: Tensor, first: Tensor, second: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Apply squareplus to a function, with two derivatives; `second` is None if it is linear."""
    root = torch.sqrt(value * value + 4.0)
    inverse = 1.0 / root
    bent = 0.5 * (value + root)
    slope, curve = bent * inverse, 2.0 * inverse * (inverse * first) ** 2
    return bent, slope * first, curve if second is None else curve + slope * second


def _perceptron(before: int, after: int, shape: EnergyShape) -> nn.Sequential:
    layers = shape.hidden_layers + 1
    return mlp(before, after, hidden=shape.width, layers=layers, activation=SquarePlus)


def _edges(mechanics: Mechanics) -> tuple[Array, Index, Index]:
    """Return vectors along rods, distance links and springs (edge, all nodes), nodes at their ends
    (2, edge), and the kinds of their laws (edge,).
    """
    points, mechanism = mechanics.points, mechanics.mechanism
    pairs = [*mechanism.distances, *mechanism.springs]
    spans = [points.span(pair.bodies, pair.in_body) for pair in pairs]
    rods = np.eye(points.count)[points.rods]
    ends = [[points.of_body(body).com for body in pair.bodies] for pair in pairs]
    sizes = [len(rods), len(mechanism.distances), len(mechanism.springs)]
    law = np.repeat(np.eye(3, 6), sizes, axis=0)
    law[sizes[0] + sizes[1] :, 3:] = mechanics.spring_law.numpy()
    edge_map = np.vstack([rods[:, 0] - rods[:, 1], *spans])
    return edge_map, np.vstack([points.rods, *ends]).T.copy(), distinct(law)

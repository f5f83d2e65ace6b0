"""HGNN and LGNN with contact: a learned energy moves bodies, and impulses at contacts are learned.

After Zhong, Dey and Chakraborty, "Extending Lagrangian and Hamiltonian neural networks with
differentiable contact models", NeurIPS 2021: smooth motion follows from an energy between impacts,
which change velocities at once. Theirs solve a convex problem for impulses, friction and
restitution being learned; here a network gives them, from what `BodyViewer` shows of the contacts,
so that soft contact that lasts for longer can be learned, too. Without contact spheres all is
learned energy, as in `energy_models`, from poses and twists of bodies rather than from particles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from mbds_xsim.learn import turning
from mbds_xsim.learn.body_model import ADDED, BodyModel, CorrectedModel
from mbds_xsim.learn.body_view import BodyView, BodyViewer
from mbds_xsim.learn.energy import Drag, EnergyNetwork, EnergyShape
from mbds_xsim.learn.energy_models import Hamiltonian, Lagrangian, NodeDynamics
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import keep, mlp, silence
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.model import runge_kutta
from mbds_xsim.learn.recipe import Cosine, Recipe
from mbds_xsim.learn.rigid import TWIST, JointHold, Q, W
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs

_TURN, _MOST_STEPS, _CENTRED = 2.0, 16, 1e-9
"""The furthest that a wheel turns in one step, since forces on its nodes change direction by as
much [rad]; the most steps of a frame; and how far off a body's centre a wheel's may be [m]."""


class ImpulseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of energies with impulses."""

    shape: EnergyShape = EnergyShape(width=16, bend=0.001)
    width: int = 64
    """Of the contacts' networks."""
    layers: int = 3
    """Linear layers of each of them."""
    substeps: int = 1
    """Steps in a frame, at least: what rolls may need more (`_rolling_steps`)."""
    recipe: Recipe = Recipe(rate=3e-3, batch=128, schedule=Cosine(), clip=1.0, skip=True)


class ImpulseModel(CorrectedModel):
    """Motion that follows from a learned energy, but for learned impulses at contacts."""

    kind: ClassVar[type[NodeDynamics]]
    tracks: ClassVar[Mapping[str, ImpulseSettings]] = {"native+": ImpulseSettings()}
    exact: ClassVar[frozenset[str]] = BodyModel.exact | {"nodes", "dynamics"}

    def __init__(self, graph: Graph, statistics: Statistics, settings: ImpulseSettings) -> None:
        super().__init__(graph, statistics, settings)
        self.substeps = max(settings.substeps, _rolling_steps(graph, statistics))
        mechanics = Mechanics(graph.scene)
        energy = EnergyNetwork(mechanics, settings.shape)
        energy.of_place.silence()
        self.dynamics = self.kind(energy, Drag(energy, settings.shape))
        self.nodes = BodyNodes(mechanics)
        seen = DIMENSION * BodyViewer.CONTACT + BodyViewer.CONTACT_SCALARS
        width, layers = settings.width, settings.layers
        self.of_contact = mlp(seen, width, hidden=width, layers=layers)
        self.to_contact = mlp(3 * width, DIMENSION * ADDED, hidden=width, layers=layers)
        silence(self.to_contact)

    def smooth(self, state: Tensor, inputs: KnownInputs) -> tuple[list[Tensor], JointHold | None]:
        step, states = self.graph.frame_s / self.substeps, [state]
        moving = torch.stack(self.nodes.placed(state), dim=1)

        def rate(at: Tensor) -> Tensor:
            q, v = at.unbind(1)
            q_rate, x_rate = self.dynamics.derivative(q, self.dynamics.conjugate(v), inputs)
            return torch.stack([q_rate, self.dynamics.velocity(x_rate)], dim=1)

        for _ in range(self.substeps):
            moving = self.nodes.corotating(states[-1]).step(rate, moving, step)
            after = self.nodes.bodies(moving[:, 0], moving[:, 1], states[-1], step)
            twist = after[..., TWIST] * self.rigid.moves
            states.append(torch.cat([after[..., :7], twist], dim=-1))
        return states, self.rigid.hold(states[-1].detach())

    def corrections(self, view: BodyView) -> tuple[Tensor, Tensor]:
        carrier, bodies = self.viewer.sphere_body, view.bodies.vectors
        given = torch.cat([view.contacts.vectors.flatten(2), view.contacts.scalars], dim=-1)
        contacts = self.of_contact(given)
        own = contacts.new_zeros(*bodies.shape[:2], contacts.shape[-1])
        own = own.index_add(1, carrier, contacts)[:, carrier]
        whole = contacts.sum(1, keepdim=True).expand_as(contacts)
        pushes = self.to_contact(torch.cat([contacts, own, whole], dim=-1))
        nothing = bodies.new_zeros(*bodies.shape[:2], ADDED, 2, DIMENSION)
        return nothing, pushes.unflatten(-1, (ADDED, DIMENSION))


def _rolling_steps(graph: Graph, statistics: Statistics) -> int:
    """Steps of a frame that what rolls on the ground needs, at twice its usual speed."""
    mechanism = graph.mechanism
    centred = np.abs(mechanism.sphere_offset).max(axis=1, initial=0.0) <= _CENTRED
    if not centred.any():
        return 1
    moments = statistics.displacement
    varying = torch.where(moments.std == 1.0, 0.0, moments.std)
    way = float(torch.sqrt((moments.mean**2 + varying**2).sum()))
    turn = 2.0 * way / float(mechanism.sphere_radius[centred].min())
    return min(_MOST_STEPS, max(1, math.ceil(turn / _TURN)))


@dataclass(frozen=True, eq=False)
class Corotating:
    """Coordinates in which the nodes of a body turn about its centre of mass with the spin it has.

    A Runge-Kutta step in them is one of Lawson's (SIAM Journal on Numerical Analysis 4, 1967): it
    follows a steady spin exactly, however fast, and has to resolve no more than what changes it.
    """

    pivot: Tensor
    """Node about which each free one turns, shape (node,)."""
    spin: Tensor
    """Of each free node [rad/s], shape (batch, 1, node, 3)."""
    fixed: Tensor | None
    """Places and velocities of the fixed nodes, which come last, shape (2, fixed node, 3); None
    where none is a pivot."""

    def step(self, rate: Callable[[Tensor], Tensor], moving: Tensor, step: float) -> Tensor:
        """Follow nodes and velocities (batch, 2, node, 3) with these rates for so long [s]."""

        def seen(at: Tensor, time: float) -> Tensor:
            at = self._turned(at, time)
            arm = at - self._centre(at)
            return self._turned(rate(at) - torch.linalg.cross(self.spin.expand_as(arm), arm), -time)

        return self._turned(runge_kutta(seen, moving, step), step)

    def _centre(self, at: Tensor) -> Tensor:
        if self.fixed is not None:
            at = torch.cat([at, self.fixed.expand(len(at), -1, -1, -1)], dim=2)
        return at[:, :, self.pivot]

    def _turned(self, vectors: Tensor, time: float) -> Tensor:
        centre = self._centre(vectors)
        turn = turning.matrix(turning.from_vector(time * self.spin))
        return centre + (turn @ (vectors - centre)[..., None])[..., 0]


class BodyNodes(nn.Module):
    """Bodies as the nodes of `mechanics_points`, and back."""

    carrier: Tensor
    carried: Tensor
    com: Tensor
    pivot: Tensor
    """Centre of mass that each free node belongs to, itself if it is one, shape (node,).

    It is a fixed node where the world holds the body there.
    """
    tip: Tensor
    """Node of each tip, or a fixed one behind them, shape (tip,)."""
    body: Tensor
    """Whose tip it is, shape (tip,)."""
    direction: Tensor
    """To it in the native frame, of length 1, shape (tip, 3)."""
    distance: Tensor
    """Of it from the centre of mass [m], shape (tip, 1)."""
    share: Tensor
    """Of a body's tips in its spin, shape (tip, 1): each sees two of three axes."""

    def __init__(self, mechanics: Mechanics) -> None:
        super().__init__()
        self.mechanics, bodies = mechanics, mechanics.points.bodies
        carrier, carried = mechanics.points.carrier
        count = np.array([len(body.tips) for body in bodies])
        com = np.array([body.com for body in bodies])
        pivot, own = com[carrier], com[com < mechanics.points.free]
        pivot[own] = own  # one body's may be another's tip
        self.held = bool((pivot >= mechanics.points.free).any())
        keep(
            self,
            carrier=carrier,
            carried=carried,
            com=com,
            pivot=pivot,
            tip=np.concatenate([body.tips for body in bodies]),
            body=np.repeat(np.arange(len(bodies)), count),
            direction=np.concatenate([body.directions for body in bodies]),
            distance=np.concatenate([body.distances for body in bodies])[:, None],
            share=(2.0 / (1.0 + np.repeat(count, count)))[:, None],
        )

    def placed(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Nodes and their velocities, on the constraints, each (batch, node, 3)."""
        return self.mechanics.placed(state[:, self.carrier], self.carried)

    def corotating(self, state: Tensor) -> Corotating:
        """Coordinates that turn with bodies in these states."""
        fixed = self.mechanics.fixed
        still = torch.stack([fixed, torch.zeros_like(fixed)]) if self.held else None
        return Corotating(self.pivot, state[:, None, self.carrier, W].detach(), still)

    def bodies(self, q: Tensor, v: Tensor, before: Tensor, step: float) -> Tensor:
        """States of the bodies with these nodes and velocities, shape (batch, body, 13).

        So long [s] after states `before`, whose spin is followed first: what is left is a small
        turn, the least one where a body has one tip alone.
        """
        x, v = self.mechanics.all_nodes(q), nn.functional.pad(v, (0, 0, 0, self._fixed))
        turned = turning.multiply(turning.from_vector(step * before[..., W]), before[..., Q])
        expected = turning.rotate(turned[:, self.body], self.direction)
        arm = (x[:, self.tip] - x[:, self.com][:, self.body]) / self.distance
        rate = (v[:, self.tip] - v[:, self.com][:, self.body]) / self.distance
        scalar = self._summed((expected * arm).sum(-1, keepdim=True)) + 1.0
        turn = torch.cat([scalar, self._summed(torch.linalg.cross(expected, arm))], dim=-1)
        turned = turning.multiply(turn / turn.norm(dim=-1, keepdim=True), turned)
        spin = self._summed(self.share * torch.linalg.cross(arm, rate))
        return torch.cat([x[:, self.com], turned, v[:, self.com], spin], dim=-1)

    @property
    def _fixed(self) -> int:
        return self.mechanics.points.count - self.mechanics.points.free

    def _summed(self, values: Tensor) -> Tensor:
        """Sum over each body's tips."""
        whole = values.new_zeros(len(values), len(self.com), values.shape[-1])
        return whole.index_add(1, self.body, values)


class ImpulseHGNN(ImpulseModel):
    """A learned Hamiltonian, and learned impulses."""

    kind: ClassVar[type[NodeDynamics]] = Hamiltonian


class ImpulseLGNN(ImpulseModel):
    """A learned Lagrangian, and learned impulses."""

    kind: ClassVar[type[NodeDynamics]] = Lagrangian

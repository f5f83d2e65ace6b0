"""HGNN and LGNN with contact: a learned energy moves bodies, and impulses at contacts are learned.

After Zhong, Dey and Chakraborty, "Extending Lagrangian and Hamiltonian neural networks with
differentiable contact models", NeurIPS 2021: smooth motion between impacts follows from an energy,
and impacts change velocities at once. Their model solves a convex problem for impulses, with
learned friction and restitution. Here a network predicts them from the `BodyViewer`'s view of the
contacts, so it can also learn soft contact that lasts longer. Without contact spheres the learned
energy does everything, as in `energy_models`, but is learned from poses and twists of bodies.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import ClassVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from mbds_xsim.learn import turning
from mbds_xsim.learn.body_model import ADDED, RECIPE, BodyModel, CorrectedModel
from mbds_xsim.learn.body_view import BodyView, BodyViewer
from mbds_xsim.learn.energy import Drag, EnergyNetwork, EnergyShape
from mbds_xsim.learn.energy_models import Hamiltonian, Lagrangian, NodeDynamics
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import TensorModule, keep, mlp, silence, summed
from mbds_xsim.learn.mechanics import Mechanics
from mbds_xsim.learn.model import runge_kutta
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.rigid import TWIST, JointHold, Q, W
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs

_TURN, _MOST_STEPS, _CENTRED = 2.0, 16, 1e-9
"""Largest turn of a wheel in one step [rad], by which forces on its nodes change direction; largest
number of steps per frame; largest offset of a wheel's centre from its body's [m]."""


class ImpulseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of HGNN and LGNN with impulses."""

    shape: EnergyShape = EnergyShape(width=16, bend=0.001)
    width: int = 64
    """Width of the contacts' networks."""
    layers: int = 3
    """Number of linear layers of each of them."""
    substeps: int = 1
    """Minimum number of steps per frame; rolling bodies may need more (`_rolling_steps`)."""
    recipe: Recipe = RECIPE


class ImpulseModel(CorrectedModel):
    """Model whose motion follows from a learned energy and learned impulses at contacts."""

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
        inputs = DIMENSION * BodyViewer.CONTACT + BodyViewer.CONTACT_SCALARS
        width, layers = settings.width, settings.layers
        self.of_contact = mlp(inputs, width, hidden=width, layers=layers)
        self.to_contact = mlp(3 * width, DIMENSION * ADDED, hidden=width, layers=layers)
        silence(self.to_contact)

    def smooth(self, state: Tensor, inputs: KnownInputs) -> tuple[list[Tensor], JointHold]:
        step, states = self.graph.frame_s / self.substeps, [state]
        moving = self.nodes.placed(state)

        def rate(at: Tensor) -> Tensor:
            q, v = at.unbind(1)
            q_rate, x_rate = self.dynamics.derivative(q, self.dynamics.conjugate(v), inputs)
            return torch.stack([q_rate, self.dynamics.velocity(x_rate)], dim=1)

        for _ in range(self.substeps):
            moving = self.nodes.step(rate, moving, states[-1], step)
            after = self.nodes.bodies(moving, states[-1], step)
            twist = after[..., TWIST] * self.rigid.moves
            states.append(torch.cat([after[..., :7], twist], dim=-1))
        last = states[-1].detach()
        corrected = len(self.viewer.sphere_body) > 0
        return states, self.rigid.hold(last) if corrected else self.rigid.unheld(last)

    def corrections(self, view: BodyView) -> tuple[None, Tensor]:
        carrier = self.viewer.sphere_body
        contacts = self.of_contact(view.contacts.flat)
        own = summed(contacts, carrier, self.graph.body_count)[:, carrier]
        total = contacts.sum(1, keepdim=True).expand_as(contacts)
        pushes = self.to_contact(torch.cat([contacts, own, total], dim=-1))
        return None, pushes.unflatten(-1, (ADDED, DIMENSION))


def _rolling_steps(graph: Graph, statistics: Statistics) -> int:
    """Return the steps per frame that rolling bodies need at twice their usual speed."""
    mechanism = graph.mechanism
    centred = np.abs(mechanism.sphere_offset).max(axis=1, initial=0.0) <= _CENTRED
    if not centred.any():
        return 1
    moments = statistics.displacement
    std = torch.where(moments.std == 1.0, 0.0, moments.std)
    displacement = float(torch.sqrt((moments.mean**2 + std**2).sum()))
    turn = 2.0 * displacement / float(mechanism.sphere_radius[centred].min())
    return min(_MOST_STEPS, max(1, math.ceil(turn / _TURN)))


class BodyNodes(TensorModule):
    """Conversion of bodies to the nodes of `mechanics_points`, and back."""

    pivot: Tensor
    """Centre of mass that each free node belongs to, itself if it is one, shape (node,).

    It is a fixed node if the world holds the body there.
    """
    still: Tensor
    """Positions and velocities of the fixed nodes, which follow the free ones, (2, node, 3)."""
    tip: Tensor
    """Node of each tip, which may be a fixed node, shape (tip,)."""
    body: Tensor
    """Body of each tip, shape (tip,)."""
    direction: Tensor
    """Unit vector to each tip in the native frame, shape (tip, 3)."""
    distance: Tensor
    """Distance of each tip from the centre of mass [m], shape (tip, 1)."""
    share: Tensor
    """Weight of each tip in its body's spin, shape (tip, 1): a tip sees two of three axes."""

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
            still=np.stack([mechanics.points.fixed, np.zeros_like(mechanics.points.fixed)]),
            tip=np.concatenate([body.tips for body in bodies]),
            body=np.repeat(np.arange(len(bodies)), count),
            direction=np.concatenate([body.directions for body in bodies]),
            distance=np.concatenate([body.distances for body in bodies])[:, None],
            share=(2.0 / (1.0 + np.repeat(count, count)))[:, None],
        )

    def placed(self, state: Tensor) -> Tensor:
        """Return the nodes and their velocities, on the constraints, (batch, 2, node, 3)."""
        return torch.stack(self.mechanics.placed(state[:, self.carrier], self.carried), dim=1)

    def step(
        self, rate: Callable[[Tensor], Tensor], moving: Tensor, state: Tensor, step: float
    ) -> Tensor:
        """Advance nodes and velocities (batch, 2, node, 3) of bodies in `state` by a step [s].

        The coordinates turn with each body's spin about its centre of mass. A Runge-Kutta step in
        them is Lawson's method (SIAM Journal on Numerical Analysis 4, 1967): it follows a steady
        spin exactly, however fast, and must resolve only the changes of the spin.
        """
        spin = state[:, None, self.carrier, W].detach()

        @functools.cache
        def turn(time: float) -> Tensor:
            return turning.matrix(turning.from_vector(time * spin))

        def corotating_rate(at: Tensor, time: float) -> Tensor:
            at = self._turned(at, turn(time))
            arm = at - self._centre(at)
            slope = rate(at) - torch.linalg.cross(spin.expand_as(arm), arm)
            return self._turned(slope, turn(-time))

        return self._turned(runge_kutta(corotating_rate, moving, step), turn(step))

    def bodies(self, moving: Tensor, before: Tensor, step: float) -> Tensor:
        """Return the states (batch, body, 13) of nodes and velocities (batch, 2, node, 3).

        They are a step [s] after states `before`, whose spin is followed first. The rest is a small
        turn, the smallest possible one if a body has only one tip.
        """
        x, v = self._with_fixed(moving).unbind(1)
        orientation = turning.multiply(turning.from_vector(step * before[..., W]), before[..., Q])
        expected = turning.rotate(orientation[:, self.body], self.direction)
        arm = (x[:, self.tip] - x[:, self.com][:, self.body]) / self.distance
        rate = (v[:, self.tip] - v[:, self.com][:, self.body]) / self.distance
        scalar = self._summed((expected * arm).sum(-1, keepdim=True)) + 1.0
        turn = torch.cat([scalar, self._summed(torch.linalg.cross(expected, arm))], dim=-1)
        orientation = turning.multiply(turn / turn.norm(dim=-1, keepdim=True), orientation)
        spin = self._summed(self.share * torch.linalg.cross(arm, rate))
        return torch.cat([x[:, self.com], orientation, v[:, self.com], spin], dim=-1)

    def _centre(self, moving: Tensor) -> Tensor:
        """Return the node about which each free node turns, and its velocity."""
        return (self._with_fixed(moving) if self.held else moving)[:, :, self.pivot]

    def _with_fixed(self, moving: Tensor) -> Tensor:
        return torch.cat([moving, self.still.expand(len(moving), -1, -1, -1)], dim=2)

    def _turned(self, moving: Tensor, turn: Tensor) -> Tensor:
        """Turn nodes and velocities by rotation matrices about their centres."""
        centre = self._centre(moving)
        return centre + (turn @ (moving - centre)[..., None])[..., 0]

    def _summed(self, values: Tensor) -> Tensor:
        """Sum over each body's tips."""
        return summed(values, self.body, len(self.com))


class ImpulseHGNN(ImpulseModel):
    """Learned Hamiltonian with learned impulses at contacts."""

    kind: ClassVar[type[NodeDynamics]] = Hamiltonian


class ImpulseLGNN(ImpulseModel):
    """Learned Lagrangian with learned impulses at contacts."""

    kind: ClassVar[type[NodeDynamics]] = Lagrangian

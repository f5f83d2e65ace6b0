"""Models of bodies, which predict the motion of a scene's bodies frame by frame.

Most of them correct smooth motion. A frame then begins with smooth motion on the joints under the
known inputs, by `BodyMechanics`, which is exact for flight without tumbling, or by a learned
energy. A network adds the rest, from its view of the frame (`BodyView`): for each body a
displacement and a change of its twist, for each contact sphere two impulses on its body, one that
displaces it and one that changes its twist. The least mass-weighted change removes the part that
joints forbid, so that rods keep their lengths; no step waits for a GPU.

The loss compares displacement and twist with the teacher's body by body, not particle by particle:
an impact of a disc is one wrench, not nineteen accelerations.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from mbds_xsim.dataset.points import Points
from mbds_xsim.learn import turning
from mbds_xsim.learn.body_view import BodyView, BodyViewer
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.layers import keep, summed
from mbds_xsim.learn.model import LearnedModel
from mbds_xsim.learn.recipe import Cosine, Recipe
from mbds_xsim.learn.rigid import TWIST, BodyMechanics, JointHold, Q, X
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Sample, Start

ADDED = 2
"""Number of outputs for each vector: one for a displacement, one for a change of the twist."""
RECIPE = Recipe(rate=3e-3, batch=128, schedule=Cosine(), clip=1.0, skip=True)
"""Recipe of most models of bodies."""

_LEAST = 1e-6
"""Offset of a squared distance, which keeps the slope of its root finite."""


class BodyModel(LearnedModel):
    """Base class of models that move a scene's bodies on its joints."""

    dtype: ClassVar[torch.dtype] = torch.float64
    needs_bodies: ClassVar[bool] = True
    exact: ClassVar[frozenset[str]] = frozenset({"rigid", "viewer"})
    """Names of the parts that compute in double precision."""

    def __init__(self, graph: Graph, statistics: Statistics, settings: Any) -> None:
        super().__init__(graph, statistics, settings)
        self.rigid = BodyMechanics(graph)
        self.viewer = BodyViewer(graph, statistics)
        mechanism, points = graph.mechanism, Points.of(graph.scene)
        keep(
            self,
            to_native=turning.conjugate(torch.from_numpy(mechanism.reference_orientation)),
            owner=torch.from_numpy(points.body),
            offset=torch.from_numpy(points.offset),
        )

    def in_precision(self) -> Self:
        """Convert networks to single precision, in which they take less than half the time."""
        super().in_precision()
        for name, part in self.named_children():
            if name not in self.exact:
                part.float()
        return self

    @abstractmethod
    def predict(self, state: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        """Return the states that a frame leads to, and the corrections to add to them.

        States are (batch, body, 13). Corrections, as the joints allow them, are a displacement
        [m, rad] and a change of the twists [m/s, rad/s], shape (batch, 2, body, 6).
        """

    def begin(self, start: Start) -> Tensor:
        """Return the states of the bodies in native frames, shape (batch, body, 13)."""
        assert start.body is not None
        return self.native(start.body[:, -1])

    def native(self, body: Tensor) -> Tensor:
        """Convert published states (…, body, 13) to native frames."""
        body = body.to(self.to_native)
        orientation = turning.multiply(body[..., Q], self.to_native.expand_as(body[..., Q]))
        return torch.cat([body[..., X], orientation, body[..., TWIST] * self.rigid.moves], dim=-1)

    def on_joints(self, state: Tensor, motions: Tensor) -> Tensor:
        """Return the twists (batch, body, 6) of bodies that move on the joints that carry them.

        Motions are shifts, and turns times the bodies' radii, shape (batch, body, 2, 3).
        """
        shift, turn = motions.unbind(-2)
        return self.viewer.links(state, shift, turn / self.viewer.radius) * self.rigid.moves

    def advance(self, state: Tensor, inputs: KnownInputs) -> Tensor:
        smooth, added = self.predict(state, inputs)
        moved = self.rigid.moved(smooth, added[:, 0])
        if len(self.rigid.rows):
            hold = self.rigid.hold(moved)
            moved = self.rigid.moved(moved, -hold.least(self.rigid.residual(moved)))
        return torch.cat([moved[..., :7], smooth[..., TWIST] + added[:, 1]], dim=-1)

    def positions(self, state: Tensor) -> Tensor:
        arm = turning.rotate(state[:, self.owner, Q], self.offset)
        return state[:, self.owner, X] + arm

    def loss(self, sample: Sample, generator: torch.Generator) -> Tensor:
        """Return the mean distance to the teacher's next frame, in units of second differences.

        The distance is the mass-weighted root mean square of displacements and twists together. In
        its square, rare violent frames would outweigh all others; with its logarithm, impacts would
        be learned last.
        """
        del generator
        assert sample.body is not None
        smooth, added = self.predict(self.begin(sample.start), sample.inputs.at(0))
        target = self.native(sample.body[:, 0])
        place = self.rigid.square(smooth, added[:, 0] - self.rigid.apart(smooth, target))
        twist = target[..., TWIST] - smooth[..., TWIST]
        speed = self.rigid.square(smooth, added[:, 1] - twist)
        error = place / self.graph.frame_s**2 + speed
        return torch.sqrt(error / self.viewer.change**2 + _LEAST).mean()


class CorrectedModel(BodyModel):
    """Model with smooth motion on a scene's joints, and a network for everything else."""

    @abstractmethod
    def smooth(self, state: Tensor, inputs: KnownInputs) -> tuple[list[Tensor], JointHold]:
        """Move over a frame without contact.

        Returns:
            The states at the start and after each step, and the joints at the last state; without
            joints (`BodyMechanics.unheld`) if nothing will be corrected.
        """

    @abstractmethod
    def corrections(self, view: BodyView) -> tuple[Tensor | None, Tensor]:
        """Return corrections of bodies and contacts over the deviation of second differences.

        Bodies have a displacement and a change of the twist, linear and angular parts, shape
        (batch, body, 2, 2, 3), or None: no change; contacts have impulses over mass, shape
        (batch, contact, 2, 3).
        """

    def predict(self, state: Tensor, inputs: KnownInputs) -> tuple[Tensor, Tensor]:
        states, hold = self.smooth(state, inputs)
        view, smooth = BodyView(self.viewer, [each.detach() for each in states]), states[-1]
        of_bodies, of_contacts = self.corrections(view)
        unit = torch.stack([self.viewer.change * self.graph.frame_s, self.viewer.change])
        added = []
        for k in range(ADDED):
            change = self.rigid.of_impulse(smooth, self._wrenches(view, of_contacts[:, :, k]))
            if of_bodies is not None:
                change = self.on_joints(smooth, of_bodies[:, :, k]) + change
            added.append(hold.kept(unit[k] * change))
        return smooth, torch.stack(added, dim=1)

    def _wrenches(self, view: BodyView, pushes: Tensor) -> Tensor:
        """Sum impulses at contacts to wrenches on the bodies about their centres of mass."""
        carrier = self.viewer.sphere_body
        pushes = pushes * self.rigid.mass[carrier]
        wrench = torch.cat([pushes, torch.linalg.cross(view.arm, pushes)], dim=-1)
        return summed(wrench, carrier, self.graph.body_count)

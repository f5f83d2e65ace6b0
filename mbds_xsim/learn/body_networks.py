"""GNS and SGNN over bodies: bodies pass messages over joints and receive those of contacts.

Both see the same view and correct the same smooth motion (`body_model`). The first reads vectors by
their components, as GNS does; the second combines them with weights that depend on inner products,
as SGNN does, so that its predictions turn with the scene about the vertical. They are named after
their kinds of network, not after the papers' models, which see only particles.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.body_model import ADDED, RECIPE, CorrectedModel
from mbds_xsim.learn.body_view import BodyView, BodyViewer, Seen
from mbds_xsim.learn.gns import InteractionLayer
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import keep, mlp, silence, summed
from mbds_xsim.learn.model import Symmetry
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.rigid import JointHold
from mbds_xsim.learn.sgnn_network import Edges, Passing, SubequivariantMap
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs

_VECTORS = 2 * ADDED  # output vectors of a body: linear and angular parts


class BodySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of GNS and SGNN over bodies."""

    width: int = 64
    layers: int = 3
    """Number of linear layers of each perceptron."""
    steps: int = 2
    """Number of message-passing steps over the joints."""
    substeps: int = 4
    """Number of steps of smooth motion per frame; must be even."""
    recipe: Recipe = RECIPE


class JointedModel(CorrectedModel):
    """Model with known smooth motion and a network that passes messages over the joints."""

    tracks: ClassVar[Mapping[str, BodySettings]] = {"native+": BodySettings()}

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        self.substeps = settings.substeps
        self.plain = nn.Parameter(torch.zeros(_VECTORS, BodyViewer.BODY))

    def smooth(self, state: Tensor, inputs: KnownInputs) -> tuple[list[Tensor], JointHold]:
        with torch.no_grad():
            return self.rigid.smooth(state, inputs, self.graph.frame_s, self.substeps)

    def corrections(self, view: BodyView) -> tuple[Tensor, Tensor]:
        plain = self.plain @ view.bodies.vectors.to(self.plain)
        added, pushes = self.read(view)
        return added + plain.reshape(added.shape), pushes

    @abstractmethod
    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        """Return `corrections` without the fixed combination of a body's own vectors."""


class BodyGNS(JointedModel):
    """Perceptrons of vector components, and GNS's interaction networks over the joints."""

    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift"})

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        viewer, width, layers = BodyViewer, settings.width, settings.layers

        def perceptron(inputs: int, outputs: int) -> nn.Sequential:
            return mlp(inputs, outputs, hidden=width, layers=layers)

        self.of_contact = perceptron(DIMENSION * viewer.CONTACT + viewer.CONTACT_SCALARS, width)
        self.of_body = perceptron(DIMENSION * viewer.BODY + viewer.BODY_SCALARS + width, width)
        self.of_joint = perceptron(DIMENSION * viewer.JOINT + viewer.JOINT_SCALARS, width)
        self.interactions = nn.ModuleList(
            InteractionLayer(width, layers - 1) for _ in range(settings.steps)
        )
        self.to_body = perceptron(width, DIMENSION * _VECTORS)
        self.to_contact = perceptron(2 * width, DIMENSION * ADDED)
        silence(self.to_body, self.to_contact)

    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        carrier = self.viewer.sphere_body
        contacts = self.of_contact(view.contacts.flat)
        bodies = view.bodies.flat
        received = summed(contacts, carrier, self.graph.body_count)
        nodes = self.of_body(torch.cat([bodies, received], dim=-1))
        nodes = self._passed(nodes, view.joints)
        pushes = self.to_contact(torch.cat([contacts, nodes[:, carrier]], dim=-1))
        added = self.to_body(nodes).unflatten(-1, (ADDED, 2, DIMENSION))
        return added, pushes.unflatten(-1, (ADDED, DIMENSION))

    def _passed(self, nodes: Tensor, joints: Seen) -> Tensor:
        """Pass messages between bodies, and from the world: its node is last and starts at zero."""
        if not len(self.viewer.senders):
            return nodes
        nodes = nn.functional.pad(nodes, (0, 0, 0, 1)).transpose(0, 1)
        edges = self.of_joint(joints.flat).transpose(0, 1)
        for interaction in self.interactions:
            nodes, edges = interaction(nodes, edges, self.viewer.senders, self.viewer.receivers)
        return nodes[:-1].transpose(0, 1)


class BodySGNN(JointedModel):
    """Subequivariant maps: combinations of the view's vectors and of the vertical direction.

    Spins are among the vectors, so the maps keep turns, but not mirror images.
    """

    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift", "turn"})

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        viewer, width = BodyViewer, settings.width
        size = {"hidden": width, "layers": settings.layers}
        keep(self, up=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))

        def combine(vectors: int, scalars: list[int], outputs: int) -> SubequivariantMap:
            return SubequivariantMap(vectors + 1, scalars, outputs=outputs, **size)

        self.of_contact = combine(viewer.CONTACT, [viewer.CONTACT_SCALARS], ADDED)
        self.of_body = combine(viewer.BODY + ADDED, [viewer.BODY_SCALARS, width], _VECTORS)
        self.passing = Passing(
            _VECTORS,
            edge_channels=viewer.JOINT + 1,
            edge_scalars=viewer.JOINT_SCALARS,
            **size,
            steps=settings.steps,
        )
        self.to_body = combine(viewer.BODY + _VECTORS, [viewer.BODY_SCALARS, width], _VECTORS)
        contact_scalars = [viewer.CONTACT_SCALARS, width, width]
        self.to_contact = combine(viewer.CONTACT + _VECTORS, contact_scalars, ADDED)
        self.edges = Edges(self.viewer.senders, self.viewer.receivers, graph.body_count + 1)
        silence(self.to_body.rest, self.to_contact.rest)

    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        carrier, body_view, contact_view = self.viewer.sphere_body, view.bodies, view.contacts
        bodies, contacts = self._with_up(body_view.vectors), self._with_up(contact_view.vectors)
        messages, hidden = self.of_contact(contacts, contact_view.scalars)
        received, hidden_sum = (
            summed(each, carrier, self.graph.body_count) for each in (messages, hidden)
        )
        seen = torch.cat([bodies, received], dim=-2)
        vectors, scalars = self.of_body(seen, body_view.scalars, hidden_sum)
        vectors, scalars = self._passed(vectors, scalars, view.joints)
        seen = torch.cat([bodies, vectors], dim=-2)
        added, _ = self.to_body(seen, body_view.scalars, scalars)
        seen = torch.cat([contacts, vectors[:, carrier]], dim=-2)
        pushes, _ = self.to_contact(seen, contact_view.scalars, hidden, scalars[:, carrier])
        return added.unflatten(-2, (ADDED, 2)), pushes

    def _passed(self, vectors: Tensor, scalars: Tensor, joints: Seen) -> tuple[Tensor, Tensor]:
        if not len(self.viewer.senders):
            return vectors, scalars
        vectors = nn.functional.pad(vectors, (0, 0, 0, 0, 0, 1))
        scalars = nn.functional.pad(scalars, (0, 0, 0, 1))
        along = self._with_up(joints.vectors)
        vectors, scalars = self.passing(vectors, scalars, self.edges, along, joints.scalars)
        return vectors[:, :-1], scalars[:, :-1]

    def _with_up(self, vectors: Tensor) -> Tensor:
        return torch.cat([vectors, self.up.to(vectors).expand(*vectors.shape[:2], 1, 3)], dim=-2)

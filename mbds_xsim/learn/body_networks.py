"""GNS and SGNN over bodies: message passing between bodies over joints, contacts read into them.

Both see the same view and add to the same smooth motion (`body_model`). The first takes vectors by
their components, as GNS does; the second combines them by weights that depend on inner products,
as SGNN does, so that its predictions turn along with the whole about the vertical. They have the
names of their kinds of network, not of the papers' models: those see particles alone.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import msgspec
import torch
from torch import Tensor, nn

from mbds_xsim.learn.body_model import ADDED, CorrectedModel
from mbds_xsim.learn.body_view import BodyView, BodyViewer, Seen
from mbds_xsim.learn.gns import InteractionLayer
from mbds_xsim.learn.graph import DIMENSION, Graph
from mbds_xsim.learn.layers import keep, mlp, silence
from mbds_xsim.learn.model import Symmetry
from mbds_xsim.learn.recipe import Cosine, Recipe
from mbds_xsim.learn.rigid import JointHold
from mbds_xsim.learn.sgnn_network import Edges, Passing, Scalars, SubequivariantMap
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs

_VECTORS = 2 * ADDED  # that a body is given: linear and angular parts


class BodySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hyper-parameters of GNS and SGNN over bodies."""

    width: int = 64
    layers: int = 3
    """Linear layers of each perceptron."""
    steps: int = 2
    """Of message passing over the joints."""
    substeps: int = 4
    """Steps of smooth motion in a frame, an even number."""
    recipe: Recipe = Recipe(rate=3e-3, batch=128, schedule=Cosine(), clip=1.0, skip=True)


class JointedModel(CorrectedModel):
    """Known smooth motion, and a network that passes messages over the joints."""

    tracks: ClassVar[Mapping[str, BodySettings]] = {"native+": BodySettings()}

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        self.substeps = settings.substeps
        self.plain = nn.Parameter(torch.zeros(_VECTORS, BodyViewer.BODY))

    def smooth(self, state: Tensor, inputs: KnownInputs) -> tuple[list[Tensor], JointHold | None]:
        with torch.no_grad():
            return self.rigid.smooth(state, inputs, self.graph.frame_s, self.substeps)

    def corrections(self, view: BodyView) -> tuple[Tensor, Tensor]:
        plain = self.plain @ view.bodies.vectors.to(self.plain)
        added, pushes = self.read(view)
        return added + plain.reshape(added.shape), pushes

    @abstractmethod
    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        """Give `corrections` but for what is a fixed combination of a body's own vectors."""


class BodyGNS(JointedModel):
    """Perceptrons of components, and GNS's interaction networks over the joints."""

    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift"})

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        see, width, layers = BodyViewer, settings.width, settings.layers

        def perceptron(inputs: int, outputs: int) -> nn.Sequential:
            return mlp(inputs, outputs, hidden=width, layers=layers)

        self.of_contact = perceptron(DIMENSION * see.CONTACT + see.CONTACT_SCALARS, width)
        self.of_body = perceptron(DIMENSION * see.BODY + see.BODY_SCALARS + width, width)
        self.of_joint = perceptron(DIMENSION * see.JOINT + see.JOINT_SCALARS, width)
        self.interactions = nn.ModuleList(
            InteractionLayer(width, layers - 1) for _ in range(settings.steps)
        )
        self.to_body = perceptron(width, DIMENSION * _VECTORS)
        self.to_contact = perceptron(2 * width, DIMENSION * ADDED)
        silence(self.to_body, self.to_contact)

    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        carrier = self.viewer.sphere_body
        contacts = self.of_contact(_flat(view.contacts))
        bodies = _flat(view.bodies)
        heard = contacts.new_zeros(*bodies.shape[:2], contacts.shape[-1])
        heard = heard.index_add(1, carrier, contacts)
        nodes = self.of_body(torch.cat([bodies, heard], dim=-1))
        nodes = self._passed(nodes, view.joints)
        pushes = self.to_contact(torch.cat([contacts, nodes[:, carrier]], dim=-1))
        added = self.to_body(nodes).unflatten(-1, (ADDED, 2, DIMENSION))
        return added, pushes.unflatten(-1, (ADDED, DIMENSION))

    def _passed(self, nodes: Tensor, joints: Seen) -> Tensor:
        """Let bodies hear of each other, and of the world behind them, which is silent."""
        if not len(self.viewer.senders):
            return nodes
        nodes = nn.functional.pad(nodes, (0, 0, 0, 1)).transpose(0, 1)
        edges = self.of_joint(_flat(joints)).transpose(0, 1)
        for interaction in self.interactions:
            nodes, edges = interaction(nodes, edges, self.viewer.senders, self.viewer.receivers)
        return nodes[:-1].transpose(0, 1)


class BodySGNN(JointedModel):
    """Subequivariant maps: combinations of what is seen, and of gravity's direction.

    Spins and cross products are among the vectors, so turns are kept, and mirror images are not.
    """

    symmetries: ClassVar[frozenset[Symmetry]] = frozenset({"shift", "turn"})
    up: Tensor

    def __init__(self, graph: Graph, statistics: Statistics, settings: BodySettings) -> None:
        super().__init__(graph, statistics, settings)
        see, width = BodyViewer, settings.width
        size = {"hidden": width, "layers": settings.layers}
        keep(self, up=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        self.of_contact = SubequivariantMap(
            see.CONTACT + 1, [see.CONTACT_SCALARS], outputs=ADDED, **size
        )
        self.of_body = SubequivariantMap(
            see.BODY + 1 + ADDED, [see.BODY_SCALARS, width], outputs=_VECTORS, **size
        )
        self.passing = Passing(
            _VECTORS,
            edge_channels=see.JOINT + 1,
            edge_scalars=see.JOINT_SCALARS,
            **size,
            steps=settings.steps,
        )
        self.to_body = SubequivariantMap(
            see.BODY + 1 + _VECTORS, [see.BODY_SCALARS, width], outputs=_VECTORS, **size
        )
        self.to_contact = SubequivariantMap(
            see.CONTACT + 1 + _VECTORS, [see.CONTACT_SCALARS, width, width], outputs=ADDED, **size
        )
        self.edges = Edges(self.viewer.senders, self.viewer.receivers, graph.body_count + 1)
        silence(self.to_body.rest, self.to_contact.rest)

    def read(self, view: BodyView) -> tuple[Tensor, Tensor]:
        carrier, seen, touching = self.viewer.sphere_body, view.bodies, view.contacts
        bodies, contacts = self._with_up(seen.vectors), self._with_up(touching.vectors)
        said, known = self.of_contact(contacts, Scalars(touching.scalars))
        heard = seen.vectors.new_zeros(*seen.vectors.shape[:2], ADDED, DIMENSION)
        heard = heard.index_add(1, carrier, said)
        told = known.new_zeros(*seen.vectors.shape[:2], known.shape[-1])
        told = told.index_add(1, carrier, known)
        vectors, scalars = self.of_body(
            torch.cat([bodies, heard], dim=-2), Scalars(seen.scalars), Scalars(told)
        )
        vectors, scalars = self._passed(vectors, scalars, view.joints)
        added, _ = self.to_body(
            torch.cat([bodies, vectors], dim=-2), Scalars(seen.scalars), Scalars(scalars)
        )
        pushes, _ = self.to_contact(
            torch.cat([contacts, vectors[:, carrier]], dim=-2),
            Scalars(touching.scalars),
            Scalars(known),
            Scalars(scalars[:, carrier]),
        )
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


def _flat(seen: Seen) -> Tensor:
    return torch.cat([seen.vectors.flatten(2), seen.scalars], dim=-1)

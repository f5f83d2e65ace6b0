"""Graph of a scene: everything that stays constant while it moves, as tensors."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.dataset.points import Points
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene

DIMENSION = 3
"""Dimension of all positions here, also in plane and line scenes, whose files omit axes."""


class Bundle:
    """Frozen dataclass whose tensors, and those of the bundles in it, are changed together."""

    def mapped(self, change: Callable[[Tensor], Tensor], within: type[Bundle]) -> Self:
        """Apply `change` to all tensors, also to those in bundles of the type `within`."""
        changed: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                changed[name] = change(value)
            elif isinstance(value, within):
                changed[name] = value.mapped(change, within)
        return dataclasses.replace(self, **changed)  # type: ignore[type-var]

    def to(self, device: torch.device | str) -> Self:
        """Move all tensors to a device."""
        return self.mapped(lambda values: values.to(device), Bundle)


class RowBundle(Bundle):
    """Bundle in which every tensor has a row for each member of a batch."""

    def __getitem__(self, key: Any) -> Self:
        """Index the rows of all tensors as those of an array."""
        return self.mapped(lambda values: values[key], RowBundle)

    def __len__(self) -> int:
        parts = vars(self).values()
        return len(next(part for part in parts if isinstance(part, Tensor | RowBundle)))


@dataclass(frozen=True, eq=False)
class Graph(Bundle):
    """Nodes and edges of a scene.

    Nodes are the particles (for a body without particles, its six stand-ins), followed by the
    static anchors. Edges go both ways. Real numbers are float64.
    """

    scene: Scene
    particle_count: int
    node_count: int
    body_count: int
    static: Tensor
    """Whether a node is an anchor, bool, shape (node,)."""
    body: Tensor
    """Body of each node, −1 for anchors, int64, shape (node,)."""
    senders: Tensor
    """Node that each directed edge comes from, int64, shape (edge,)."""
    receivers: Tensor
    """Node that each directed edge goes to, int64, shape (edge,)."""
    inner: Tensor
    """Whether both ends of an edge are in one body, bool, shape (edge,)."""
    mass: Tensor
    """Mass of each node, 0 for anchors [kg], shape (node,)."""
    reference: Tensor
    """Positions of the nodes in W at the reference pose [m], shape (node, 3)."""
    gravity: Tensor
    """Gravitational acceleration in W [m/s²], shape (3,)."""
    moving: Tensor
    """Whether the scene moves along x, y and z, bool, shape (3,)."""
    ground: bool
    """Whether there is a ground at z = 0."""
    length: float
    """Size of the scene [m]."""
    frame_s: float
    """Time between frames [s]."""

    @staticmethod
    def of(scene: Scene) -> Graph:
        """Build the graph of a scene; it may have no edges and no anchors.

        Raises:
            InputError: Its bodies collide with each other, which fixed edges cannot represent.
            Unsupported: A servo has targets that change and no input shows.
        """
        if scene.collisions:
            raise InputError(
                f"scene {scene.name!r}: got [collisions], allowed are scenes without; the graph of "
                "learned models has fixed edges, so they cannot see other bodies come near"
            )
        points = Points.of(scene)
        _check_drives(points.mechanism)
        edges = np.array(scene.edges, dtype=np.int64).reshape(-1, 2)
        edges[edges >= scene.particle_count] += len(points.body) - scene.particle_count
        edges = np.unique(np.sort(edges, axis=1), axis=0)  # each once; anchors after all points
        anchors = np.array(scene.anchors, dtype=np.float64).reshape(-1, DIMENSION)
        reference = np.concatenate([points.mechanism.com[points.body] + points.offset, anchors])
        body = np.concatenate([points.body, np.full(len(scene.anchors), -1)])
        senders, receivers = np.concatenate([edges, edges[:, ::-1]]).T
        moving = np.isin(np.arange(DIMENSION), points.axes)
        return Graph(
            scene=scene,
            particle_count=len(points.body),
            node_count=len(body),
            body_count=len(scene.bodies),
            static=torch.from_numpy(body < 0),
            body=torch.from_numpy(body),
            senders=torch.from_numpy(senders.copy()),
            receivers=torch.from_numpy(receivers.copy()),
            inner=torch.from_numpy((body[senders] == body[receivers]) & (body[senders] >= 0)),
            mass=torch.from_numpy(_masses(points, len(scene.anchors))),
            reference=torch.from_numpy(reference),
            gravity=torch.tensor(scene.gravity, dtype=torch.float64),
            moving=torch.from_numpy(moving),
            ground=scene.ground is not None,
            length=scene.length,
            frame_s=scene.clock.frame,
        )

    @property
    def anchor_positions(self) -> Tensor:
        """Positions of the static nodes in W [m], shape (anchor, 3)."""
        return self.reference[self.particle_count :]

    @functools.cached_property
    def spacing(self) -> float:
        """Root mean square length of the edges at the reference pose [m]; `length` if no edges."""
        if not len(self.senders):
            return self.length
        spans = self.reference[self.senders] - self.reference[self.receivers]
        return float(spans.square().sum(-1).mean().sqrt())

    @property
    def mechanism(self) -> Mechanism:
        """Arrays and spanning tree of the scene."""
        return Mechanism.of(self.scene)

    def with_anchors(self, particles: Tensor) -> Tensor:
        """Append the anchors to particle positions (…, particle, 3): all nodes, (…, node, 3)."""
        anchors = self.anchor_positions.to(particles)
        return torch.cat([particles, anchors.expand(*particles.shape[:-2], *anchors.shape)], -2)

    def embed(self, published: Tensor, *, rest: Tensor | float | None = None) -> Tensor:
        """Restore the components that a data file leaves out, to shape (…, particle, 3).

        `rest` has their values, (particle, 3) or a number; None: the positions of the reference
        pose.
        """
        if rest is None:
            rest = self.reference[: self.particle_count]
        shape = (*published.shape[:-1], DIMENSION)
        whole = torch.as_tensor(rest).to(published).expand(shape).clone()
        whole[..., self.moving] = published
        return whole


def check_edges(scene: Scene) -> None:
    """Raise Unsupported if bodies are joined, but nothing shows it to a model that sees edges."""
    if not _hides_joints(scene):
        return
    loaded = scene.springs or any(joint.is_loaded for joint in Mechanism.of(scene).joints)
    raise Unsupported(
        f"scene {scene.name!r}: got joined bodies and no edges, needed are edges: models of "
        "particles see only along them what joins bodies; give its bodies particles and edges"
        + ("" if loaded else ", or take gns+ or sgnn+")
    )


def instead(scene: Scene, *models: str) -> str:
    """Advise models in place of one that cannot represent a scene, with GNS and SGNN if these can.

    `models` are two or none.
    """
    names = [*models, *(() if _hides_joints(scene) else ("gns", "sgnn"))]
    if not names:
        return "give its bodies particles and edges, and take gns or sgnn"
    return f"take {', '.join(names[:-1])} or {names[-1]}"


def _hides_joints(scene: Scene) -> bool:
    return not scene.edges and bool(scene.joints or scene.distance_links or scene.springs)


def _check_drives(mechanism: Mechanism) -> None:
    """Refuse drives whose targets change: `KnownInputs` has only held forces and torques."""
    for drive in mechanism.drives:
        if np.ptp(drive.pushes(mechanism.scene.clock.steps)) > 0:
            raise Unsupported(
                f"servo of {drive.servo.joint!r}: got targets that change, allowed for a servo "
                "with a limit, or on a slider between bodies, is one target: it acts at every "
                "instant, and models are shown only held forces and torques"
            )


def _masses(points: Points, anchor_count: int) -> NDArray[np.float64]:
    """Return masses of particles, of stand-ins (equal shares of their body's), and 0 of anchors."""
    own = [particle.mass for body in points.mechanism.scene.bodies for particle in body.particles]
    share = points.mechanism.mass / np.bincount(points.body)
    return np.concatenate([own, share[points.body[len(own) :]], np.zeros(anchor_count)])

"""Figures by which models are judged, computed from particles alone.

A model returns only positions of particles, so its orientations, velocities and impulses cannot be
checked. Its particles are compared with the particles of the truth: for one motion, as engines are
judged (`ParticleMotion`), or for many rollouts at once (`RolloutFigures`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.base.files import write_whole
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, rollout
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.reference.cache import read_sealed, sealed
from mbds_xsim.scene.mechanism import JointKind
from mbds_xsim.scene.state import Batch

LOST = 0.1
"""Root mean square error above which a prediction is invalid, in lengths of the scene."""
EXPLODED = 10.0
"""Root mean square error above which a prediction has exploded, in lengths of the scene."""

_ON = 1e-9  # of the scene's length: tolerance for a node on a joint, a sphere on a particle
_REACH = 2  # frames to either side that determine a velocity
_EARTH = 9.81
_FLOOR = 1e-3  # of Σ m·g·length, as in the check of energy


@dataclass(frozen=True, eq=False)
class RigidPairs:
    """Pairs of nodes that are fixed in a common body: a rollout must keep their distances."""

    first: Tensor
    """First node of each pair, shape (pair,)."""
    second: Tensor
    distance: Tensor
    """Distance that the scene prescribes [m], float64, shape (pair,)."""

    @staticmethod
    def of(graph: Graph) -> RigidPairs:
        """Find the pairs; a node on a joint is fixed in both bodies, an anchor in the world."""
        fixed = _fixed_in(graph)
        shared = (fixed[:, None] & fixed[None]).any(-1)
        # The distance of two anchors does not depend on the model.
        moving = ~graph.static.numpy()
        shared &= moving[:, None] | moving[None]
        first, second = (torch.from_numpy(part) for part in np.nonzero(np.triu(shared, 1)))
        spans = graph.reference[first] - graph.reference[second]
        return RigidPairs(first, second, spans.norm(dim=-1))

    def __len__(self) -> int:
        return len(self.first)

    def gap(self, nodes: Tensor) -> Tensor:
        """Return how far nodes (…, node, 3) deviate at most from these distances [m], (…)."""
        if not len(self):
            return torch.full(nodes.shape[:-2], torch.nan).to(nodes)
        distance = (nodes[..., self.first, :] - nodes[..., self.second, :]).norm(dim=-1)
        return (distance - self.distance).abs().amax(-1)


def _fixed_in(graph: Graph) -> Mask:
    """Return whether each node is fixed in each body, the world last, shape (node, body + 1)."""
    fixed = np.zeros((graph.node_count, graph.body_count + 1), dtype=bool)
    fixed[np.arange(graph.node_count), graph.body.numpy()] = True
    for joint in graph.mechanism.joints:
        # Nodes that the joint moves in neither of its bodies.
        arm = _AWAY[joint.kind](graph.reference.numpy() - joint.anchor, joint.axis)
        on = np.linalg.norm(arm, axis=-1) <= _ON * graph.length
        for body, other in ((joint.parent, joint.child), (joint.child, joint.parent)):
            fixed[on & fixed[:, body], other] = True
    return fixed


_AWAY: dict[JointKind, Callable[[Array, Array], Array]] = {
    "fixed": lambda arm, _: np.zeros_like(arm),
    "hinge": lambda arm, axis: arm - (arm @ axis)[:, None] * axis,
    "slider": lambda arm, _: np.full_like(arm, np.inf),
    "ball": lambda arm, _: arm,
}


@dataclass(frozen=True, eq=False)
class ParticleMotion:
    """Particles of one motion."""

    graph: Graph
    start: Batch
    """Batch of one start, with the inputs that act."""
    position: Array
    """Positions of the particles [m], shape (frame, particle, 3)."""

    @property
    def mass(self) -> Array:
        """Masses of the particles [kg]."""
        return np.asarray(self.graph.mass[: self.graph.particle_count].numpy())


def particle_error(motion: ParticleMotion, truth: ParticleMotion) -> Array:
    """Return the root mean square distance of the particles [m], shape (frame,)."""
    difference = motion.position - truth.position
    return np.asarray(np.sqrt(np.mean(np.sum(difference**2, axis=-1), axis=-1)))


def gap(motion: ParticleMotion) -> Array:
    """Return the largest deviation of a rigid distance [m], shape (frame,); NaN without any."""
    nodes = motion.graph.with_anchors(torch.from_numpy(motion.position))
    return np.asarray(RigidPairs.of(motion.graph).gap(nodes).numpy())


def sunk(motion: ParticleMotion) -> Array:
    """Return the deepest overlap with the ground of contact spheres at particles [m], (frame,)."""
    mechanism, graph = motion.graph.mechanism, motion.graph
    own = mechanism.com[mechanism.sphere_body] + mechanism.sphere_offset
    apart = np.linalg.norm(own[:, None] - graph.reference[: graph.particle_count].numpy(), axis=-1)
    spheres, particles = np.nonzero(apart <= _ON * graph.length)
    if not len(spheres):
        return np.full(len(motion.position), np.nan)
    depth = mechanism.sphere_radius[spheres] - motion.position[:, particles, 2]
    return np.asarray(np.maximum(depth, 0.0).max(axis=1))


def way(motion: ParticleMotion) -> Array:
    """Return the mean path length of the particles since the start [m], shape (frame,)."""
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=-1).mean(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def unexplained_energy(motion: ParticleMotion, truth: ParticleMotion) -> Array:
    """Return the unexplained change of energy over the truth's scale, signed, shape (frame,).

    The kinetic energy of points, the potential energy and the inputs' work are compared with the
    reference's. With contact, where a bounce at another time is no error, only a rise above the
    most that the reference has had since the start counts: spin, which particles do not show, can
    become speed. NaN at known frames, and everywhere if particles do not determine
    the energy: with springs, loaded joints, driven hinges, or bodies without particles.

    A velocity needs frames on both sides, so its value is placed at the last of them.
    """
    mechanism, frames = motion.graph.mechanism, len(motion.position)
    hidden = bool(mechanism.springs or any(joint.is_loaded for joint in mechanism.joints))
    hidden = hidden or (mechanism.particles_per_body == 0).any()
    if hidden or motion.start.torque.any():
        return np.full(frames, np.nan)
    kinetic, potential = _energy(truth)
    spread = np.ptp(potential[np.isfinite(potential)])
    scale = max(np.nanmax(kinetic) + spread, _energy_floor(motion.graph))
    target = kinetic + potential - _work(truth)
    kinetic, potential = _energy(motion)
    balance = kinetic + potential - _work(motion)
    if motion.graph.scene.contacts:
        least, known = np.nanmax(target[:HISTORY]), np.where(np.isnan(target), -np.inf, target)
        target = np.maximum(np.maximum.accumulate(known), least)
        balance = np.maximum(balance, target)
    figure = np.full(frames, np.nan)
    figure[_REACH:] = ((balance - target) / scale)[:-_REACH]
    figure[:HISTORY] = np.nan
    return figure


def _energy(motion: ParticleMotion) -> tuple[Array, Array]:
    """Return the kinetic and the potential energy [J], each (frame,)."""
    position = motion.position
    change = position[3:-1] - position[1:-3]
    if motion.graph.scene.contacts:  # of second order, which does not overshoot at a bounce
        change = 0.5 * change
    else:  # of fourth order
        change = (8.0 * change - (position[4:] - position[:-4])) / 12.0
    velocity = np.full(position.shape, np.nan)
    velocity[_REACH:-_REACH] = change / motion.graph.frame_s
    kinetic = 0.5 * np.sum(velocity**2, axis=-1) @ motion.mass
    return kinetic, -(position @ motion.graph.gravity.numpy()) @ motion.mass


def _work(motion: ParticleMotion) -> Array:
    """Return the work of centre-of-mass forces, held over frames, since frame 0 [J], (frame,)."""
    mass, body = motion.mass, motion.graph.body[: motion.graph.particle_count].numpy()
    share = np.zeros((motion.graph.body_count, len(mass)))
    share[body, np.arange(len(mass))] = mass
    centre = np.einsum("bp,fpi->fbi", share / share.sum(axis=1, keepdims=True), motion.position)
    force = motion.start.force[0, : len(centre) - 1]
    steps = np.einsum("fbi,fbi->f", force, np.diff(centre, axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _energy_floor(graph: Graph) -> float:
    gravity = float(graph.gravity.norm()) or _EARTH
    return _FLOOR * float(graph.mass.sum()) * gravity * graph.length


@dataclass(frozen=True, eq=False)
class RolloutFigures:
    """Figures of predictions of the same trajectories, float64; frame 0 is the first predicted.

    They are infinite where the prediction is not finite, and NaN where the truth is unknown.
    """

    error: Array
    """Mean over particles of the squared distance [m²], (trajectory, frame)."""
    energy: Array
    """|E − E of the truth| over the truth's energy scale, (trajectory, frame)."""
    gap: Array
    """Largest deviation of a rigid distance [m], (trajectory, frame); NaN without rigid pairs."""
    one_step: Array
    """Mean squared distance of one-frame predictions from true windows [m²], (trajectory,); NaN
    without such a prediction."""

    def split(self, parts: int) -> list[RolloutFigures]:
        """Split the trajectories, in order, into `parts` equal parts."""
        each = zip(*(np.split(values, parts) for values in vars(self).values()), strict=True)
        return [RolloutFigures(*values) for values in each]

    def write(self, path: Path) -> None:
        """Write the figures to a file, whole or not at all."""
        write_whole(path, sealed(path, vars(self)))


def read_figures(path: Path) -> RolloutFigures | None:
    """Read stored figures; None if the file is missing or damaged."""
    arrays = read_sealed(path)
    return None if arrays is None else RolloutFigures(**arrays)


def figures_on(
    model: LearnedModel, motions: Motions, *, horizon: int, stride: int, device: str = "cpu"
) -> RolloutFigures:
    """Test a model on its device; figures are NaN if a trajectory's first window is unknown.

    The truth is on the CPU, where predictions are measured too. Rollouts have `horizon` frames;
    teacher-forced predictions start every `stride` frames.
    """
    start = motions.position[:, :HISTORY].isfinite().flatten(1).all(1)
    rows = torch.nonzero(start)[:, 0]
    known = motions[rows]
    shown = known.to(device)
    predicted = rollout(model, shown, steps=horizon).cpu()
    step = one_step_error(model, shown, frames=horizon, stride=stride)
    figures = {}
    for name, values in vars(measure(known, predicted, step)).items():
        figures[name] = np.full((len(motions), *values.shape[1:]), np.nan)
        figures[name][rows.numpy()] = values
    return RolloutFigures(**figures)


def measure(motions: Motions, predicted: Tensor, one_step: Array | None = None) -> RolloutFigures:
    """Compare predictions with the true motions, whose unknown frames are NaN.

    `predicted` has positions from frame `HISTORY` on [m], shape (trajectory, frame, particle, 3);
    `one_step` is the error of one-frame predictions, if known.
    """
    frames, graph = predicted.shape[1], motions.graph
    truth = motions.position[:, HISTORY - 1 : HISTORY + frames].double()
    prediction = torch.cat([truth[:, :1], predicted.double()], dim=1)
    known = truth.isfinite().all(-1).all(-1)
    pairs = RigidPairs.of(graph)
    target, scale = _total_energy(graph, truth)
    energy = (_total_energy(graph, prediction)[0] - target).abs() / scale
    return RolloutFigures(
        error=_marked(_squared_distance(prediction, truth), known),
        energy=_marked(energy, target.isfinite()),
        gap=_marked(pairs.gap(graph.with_anchors(prediction)), known & bool(len(pairs))),
        one_step=np.full(len(motions), np.nan) if one_step is None else one_step,
    )


def one_step_error(model: LearnedModel, motions: Motions, *, frames: int, stride: int) -> Array:
    """Return the error of one-frame predictions from true windows, which chaos does not affect.

    It is the mean squared distance over known windows, one every `stride` frames, and particles
    [m²], shape (trajectory,); infinite if a prediction is not finite.
    """
    total, count = torch.zeros(len(motions)).double(), torch.zeros(len(motions))
    for last in range(HISTORY - 1, HISTORY - 1 + frames, stride):
        window = motions.position[:, last + 1 - HISTORY : last + 2]
        rows = torch.nonzero(window.isfinite().all(-1).all(-1).all(-1))[:, 0]
        if not len(rows):
            continue
        sample = motions.sample(rows, last, 1)
        with torch.no_grad():
            state = model.advance(model.begin(sample.start), sample.inputs.at(0))
            predicted = model.positions(state).double()
        error = _squared_distance(predicted, sample.position[:, 0].double()).cpu()
        rows = rows.cpu()
        total[rows] += torch.where(error.isfinite(), error, torch.inf)
        count[rows] += 1
    return np.asarray((total / count).numpy())


def _squared_distance(first: Tensor, second: Tensor) -> Tensor:
    return (first - second).square().sum(-1).mean(-1)


def _marked(values: Tensor, known: Tensor) -> Array:
    """Drop the last true frame; mark lost values as infinite and unknown ones as NaN."""
    lost = torch.where(values.isfinite(), values, torch.inf)
    return np.asarray(torch.where(known, lost, torch.nan)[:, 1:].numpy())


def _total_energy(graph: Graph, position: Tensor) -> tuple[Tensor, Tensor]:
    """Return the particles' energy [J], (trajectory, frame), and its scale (trajectory, 1)."""
    mass = graph.mass[: graph.particle_count]
    velocity = torch.gradient(position, spacing=graph.frame_s, dim=1)[0]
    kinetic = 0.5 * velocity.square().sum(-1) @ mass
    potential = -(position @ graph.gravity) @ mass
    high, low, fast = (
        part.nan_to_num(nan=other).amax(1, keepdim=True)
        for part, other in ((potential, -1e300), (-potential, -1e300), (kinetic, 0.0))
    )
    scale = fast + (high + low).clamp(min=0.0)
    return kinetic + potential, scale.clamp(min=_energy_floor(graph))

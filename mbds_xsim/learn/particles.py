"""What particles alone tell of a motion: the figures by which models are judged.

A model gives positions of particles and nothing else, so orientations, velocities and impulses are
not there to be checked. What can be seen is compared with the truth seen in the same way: one
motion as engines are judged (`ParticleMotion`), or many rollouts at once (`RolloutFigures`).
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
"""Root mean square error at which a prediction is no longer valid, of the scene's length."""
EXPLODED = 10.0
"""The same at which it has exploded."""

_ON = 1e-9  # of the scene's length: a node lies on a joint, a sphere on a particle
_REACH = 2  # frames to either side that a velocity is made of
_EARTH = 9.81
_FLOOR = 1e-3  # of Σ m·g·length, as in the check of energy


@dataclass(frozen=True, eq=False)
class RigidPairs:
    """Pairs of nodes that are fixed in a common body: a rollout must keep their distances."""

    first: Tensor
    """Shape (pair,)."""
    second: Tensor
    distance: Tensor
    """That the scene prescribes [m], float64."""

    @staticmethod
    def of(graph: Graph) -> RigidPairs:
        """Find them; a node on a joint is fixed in both of its bodies, an anchor in the world."""
        fixed = _fixed_in(graph)
        shared = (fixed[:, None] & fixed[None]).any(-1)
        # The distance of two anchors is not the model's doing.
        moving = ~graph.static.numpy()
        shared &= moving[:, None] | moving[None]
        first, second = (torch.from_numpy(part) for part in np.nonzero(np.triu(shared, 1)))
        apart = graph.reference[first] - graph.reference[second]
        return RigidPairs(first, second, apart.norm(dim=-1))

    def __len__(self) -> int:
        return len(self.first)

    def gap(self, nodes: Tensor) -> Tensor:
        """Largest deviation from the prescribed distances [m], shape (…), of nodes (…, node, 3)."""
        if not len(self):
            return torch.full(nodes.shape[:-2], torch.nan).to(nodes)
        apart = (nodes[..., self.first, :] - nodes[..., self.second, :]).norm(dim=-1)
        return (apart - self.distance).abs().amax(-1)


def _fixed_in(graph: Graph) -> Mask:
    """Whether each node is fixed in each body, the world (−1) last, shape (node, body + 1)."""
    fixed = np.zeros((graph.node_count, graph.body_count + 1), dtype=bool)
    fixed[np.arange(graph.node_count), graph.body.numpy()] = True
    for joint in graph.mechanism.joints:
        # Nodes that the joint leaves where they are in both of its bodies.
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
    """The particles of one motion."""

    graph: Graph
    start: Batch
    """A batch of one, with the inputs that act."""
    position: Array
    """[m], shape (frame, particle, 3)."""

    @property
    def mass(self) -> Array:
        """Of the particles [kg]."""
        return np.asarray(self.graph.mass[: self.graph.particle_count].numpy())


def particle_error(motion: ParticleMotion, truth: ParticleMotion) -> Array:
    """Root mean square over particles of their distance [m], (frame,)."""
    apart = motion.position - truth.position
    return np.asarray(np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1)))


def gap(motion: ParticleMotion) -> Array:
    """Largest deviation of a distance that no motion changes [m], (frame,); NaN without any."""
    nodes = motion.graph.with_anchors(torch.from_numpy(motion.position))
    return np.asarray(RigidPairs.of(motion.graph).gap(nodes).numpy())


def sunk(motion: ParticleMotion) -> Array:
    """Deepest overlap with the ground of contact spheres that are at a particle [m], (frame,)."""
    mechanism, graph = motion.graph.mechanism, motion.graph
    own = mechanism.com[mechanism.sphere_body] + mechanism.sphere_offset
    apart = np.linalg.norm(own[:, None] - graph.reference[: graph.particle_count].numpy(), axis=-1)
    spheres, particles = np.nonzero(apart <= _ON * graph.length)
    if not len(spheres):
        return np.full(len(motion.position), np.nan)
    depth = mechanism.sphere_radius[spheres] - motion.position[:, particles, 2]
    return np.asarray(np.maximum(depth, 0.0).max(axis=1))


def way(motion: ParticleMotion) -> Array:
    """Mean way of the particles from the start on [m], (frame,)."""
    steps = np.linalg.norm(np.diff(motion.position, axis=0), axis=-1).mean(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def unexplained_energy(motion: ParticleMotion, truth: ParticleMotion) -> Array:
    """Energy that came or went without a reason, over the truth's scale, with its sign; (frame,).

    Kinetic energy of points, potential energy and the inputs' work, against the reference's. With
    contact, where a bounce at another time is no error, the rise above what there was at the
    start. NaN at frames that were given, and all over where particles do not tell it: with springs,
    driven hinges, and bodies without particles.

    A velocity is made of frames to either side, so a value stands where the last of them is.
    """
    mechanism, frames = motion.graph.mechanism, len(motion.position)
    hidden = bool(mechanism.springs or any(joint.is_loaded for joint in mechanism.joints))
    hidden = hidden or (mechanism.particles_per_body == 0).any()
    if hidden or motion.start.torque.any():
        return np.full(frames, np.nan)
    kinetic, potential = _energy(truth)
    spread = np.ptp(potential[np.isfinite(potential)])
    scale = max(np.nanmax(kinetic) + spread, _energy_floor(motion.graph))
    due = kinetic + potential - _work(truth)
    kinetic, potential = _energy(motion)
    balance = kinetic + potential - _work(motion)
    if motion.graph.scene.contacts:
        due = np.full(frames, np.nanmax(due[:HISTORY]))
        balance = np.maximum(balance, due)
    figure = np.full(frames, np.nan)
    figure[_REACH:] = ((balance - due) / scale)[:-_REACH]
    figure[:HISTORY] = np.nan
    return figure


def _energy(motion: ParticleMotion) -> tuple[Array, Array]:
    """Kinetic and potential [J], each (frame,)."""
    position = motion.position
    change = position[3:-1] - position[1:-3]
    if motion.graph.scene.contacts:  # of second order, which at a bounce overshoots neither side
        change = 0.5 * change
    else:  # of fourth order
        change = (8.0 * change - (position[4:] - position[:-4])) / 12.0
    velocity = np.full(position.shape, np.nan)
    velocity[_REACH:-_REACH] = change / motion.graph.frame_s
    kinetic = 0.5 * np.sum(velocity**2, axis=-1) @ motion.mass
    return kinetic, -(position @ motion.graph.gravity.numpy()) @ motion.mass


def _work(motion: ParticleMotion) -> Array:
    """Of the forces on centres of mass, held over frames, from frame 0 on [J], (frame,)."""
    mass, body = motion.mass, motion.graph.body[: motion.graph.particle_count].numpy()
    share = np.zeros((motion.graph.body_count, len(mass)))
    share[body, np.arange(len(mass))] = mass
    centre = np.einsum("bp,fpi->fbi", share / share.sum(axis=1, keepdims=True), motion.position)
    force = motion.start.force[0, : len(centre) - 1]
    steps = np.einsum("fbi,fbi->f", force, np.diff(centre, axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _energy_floor(graph: Graph) -> float:
    pull = float(graph.gravity.norm()) or _EARTH
    return _FLOOR * float(graph.mass.sum()) * pull * graph.length


@dataclass(frozen=True, eq=False)
class RolloutFigures:
    """Of predictions of the same trajectories, all float64, frame 0 the first predicted.

    Infinite where the prediction is not finite, not a number where the truth is not known.
    """

    error: Array
    """Mean over particles of the squared distance [m²], (trajectory, frame)."""
    energy: Array
    """|E − E of the truth| over the truth's energy scale, (trajectory, frame)."""
    gap: Array
    """Largest deviation of a rigid distance [m], (trajectory, frame); NaN without rigid pairs."""
    one_step: Array
    """Squared distance of predictions by one frame from true windows [m²], (trajectory,); NaN
    where there is no such prediction."""

    def split(self, parts: int) -> list[RolloutFigures]:
        """Take so many equal parts of the trajectories, in order."""
        each = zip(*(np.split(values, parts) for values in vars(self).values()), strict=True)
        return [RolloutFigures(*values) for values in each]

    def write(self, path: Path) -> None:
        """Keep them, whole or not at all."""
        write_whole(path, sealed(path, vars(self)))


def read_figures(path: Path) -> RolloutFigures | None:
    """Read what was kept; None where there is none that is as it was written."""
    arrays = read_sealed(path)
    return None if arrays is None else RolloutFigures(**arrays)


def figures_on(
    model: LearnedModel, motions: Motions, *, horizon: int, stride: int, device: str = "cpu"
) -> RolloutFigures:
    """Test a model on its device; trajectories whose first window is not known are left unknown.

    The truth is on the CPU, where predictions are measured too. Rollouts have `horizon` frames;
    teacher-forced predictions start every `stride` frames.
    """
    start = motions.position[:, :HISTORY].isfinite().flatten(1).all(1)
    rows = torch.nonzero(start)[:, 0]
    known = motions[rows]
    shown = known.to(device)
    predicted = rollout(model, shown, steps=horizon).cpu()
    step = one_step_error(model, shown, frames=horizon, stride=stride)
    whole = {}
    for name, values in vars(measure(known, predicted, step)).items():
        whole[name] = np.full((len(motions), *values.shape[1:]), np.nan)
        whole[name][rows.numpy()] = values
    return RolloutFigures(**whole)


def measure(motions: Motions, predicted: Tensor, one_step: Array | None = None) -> RolloutFigures:
    """Hold predictions against what happened, where frames that are not known are not numbers.

    Predicted are positions from frame `HISTORY` on [m], shape (trajectory, frame, particle, 3);
    beside them may stand the error of predictions by one frame.
    """
    frames, graph = predicted.shape[1], motions.graph
    truth = motions.position[:, HISTORY - 1 : HISTORY + frames].double()
    rolled = torch.cat([truth[:, :1], predicted.double()], dim=1)
    known = truth.isfinite().all(-1).all(-1)
    pairs = RigidPairs.of(graph)
    due, scale = _total_energy(graph, truth)
    energy = (_total_energy(graph, rolled)[0] - due).abs() / scale
    return RolloutFigures(
        error=_marked(_squared_distance(rolled, truth), known),
        energy=_marked(energy, due.isfinite()),
        gap=_marked(pairs.gap(graph.with_anchors(rolled)), known & bool(len(pairs))),
        one_step=np.full(len(motions), np.nan) if one_step is None else one_step,
    )


def one_step_error(model: LearnedModel, motions: Motions, *, frames: int, stride: int) -> Array:
    """Predict one frame from true windows, every `stride` frames: not chaotic, so comparable.

    Mean over known windows and particles of the squared distance [m²], shape (trajectory,);
    infinite where a prediction is not finite.
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
            after = model.positions(state).double()
        error = _squared_distance(after, sample.position[:, 0].double()).cpu()
        rows = rows.cpu()
        total[rows] += torch.where(error.isfinite(), error, torch.inf)
        count[rows] += 1
    return np.asarray((total / count).numpy())


def _squared_distance(first: Tensor, second: Tensor) -> Tensor:
    return (first - second).square().sum(-1).mean(-1)


def _marked(values: Tensor, known: Tensor) -> Array:
    """Behind the last true frame: infinite where lost, not a number where nothing is known."""
    lost = torch.where(values.isfinite(), values, torch.inf)
    return np.asarray(torch.where(known, lost, torch.nan)[:, 1:].numpy())


def _total_energy(graph: Graph, position: Tensor) -> tuple[Tensor, Tensor]:
    """Of the particles as points [J], shape (trajectory, frame), and its scale (trajectory, 1)."""
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

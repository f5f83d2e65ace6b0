"""Figures of rollouts, trajectory by trajectory and frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model
from mbds_xsim.learn.rollout import rollout
from mbds_xsim.learn.shift.rigid import RigidPairs
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.reference.cache import read_sealed, sealed
from mbds_xsim.write import write_whole

__all__ = ["EXPLODED", "LOST", "Figures", "figures_on", "measure", "one_step_error", "read_figures"]

Array = NDArray[np.float64]

LOST = 0.1
"""Root mean square error at which a prediction is no longer valid, of the scene's length."""
EXPLODED = 10.0
"""The same at which it has exploded."""

_ENERGY_FLOOR = 1e-3  # of Σ m·g·length, as in the check of energy
_EARTH = 9.81


@dataclass(frozen=True, eq=False)
class Figures:
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

    def write(self, path: Path) -> None:
        """Keep them, whole or not at all."""
        write_whole(path, sealed(path, {name: getattr(self, name) for name in _NAMES}))


_NAMES = tuple(Figures.__dataclass_fields__)


def read_figures(path: Path) -> Figures | None:
    """Read what was kept; None where there is none that is as it was written."""
    arrays = read_sealed(path)
    return None if arrays is None else Figures(**arrays)


def figures_on(
    model: Model, motions: Motions, *, horizon: int, stride: int, device: str = "cpu"
) -> Figures:
    """Test a model; trajectories whose first window is not known are left unknown.

    Args:
        model: Of the motions' type of numbers, on the device.
        motions: The truth, on the CPU.
        horizon: Frames of a rollout.
        stride: Frames from a window of the teacher-forced predictions to the next.
        device: Where to predict; what is predicted is measured on the CPU.
    """
    start = motions.position[:, :HISTORY].isfinite().flatten(1).all(1)
    rows = torch.nonzero(start)[:, 0]
    known = motions[rows]
    shown = known.to(device)
    predicted = rollout(model, shown, steps=horizon).position.cpu()
    step = one_step_error(model, shown, frames=horizon, stride=stride)
    return _spread(measure(known, predicted, step), rows.numpy(), len(motions))


def measure(motions: Motions, predicted: Tensor, one_step: Array | None = None) -> Figures:
    """Hold predictions against what happened.

    Args:
        motions: The truth; frames that are not known are not numbers.
        predicted: Positions from frame `HISTORY` on [m], shape (trajectory, frame, particle, 3).
        one_step: Error of predictions by one frame, where there are any.
    """
    frames = predicted.shape[1]
    seen = motions.position[:, HISTORY - 1 : HISTORY + frames].double()
    told = torch.cat([seen[:, :1], predicted.double()], dim=1)
    known = seen.isfinite().all(-1).all(-1)
    pairs = RigidPairs.of(motions.graph)
    nothing = np.full(len(motions), np.nan)
    return Figures(
        error=_marked(_squared_distance(told, seen), known),
        energy=_energy_error(motions.graph, told, seen),
        gap=_marked(pairs.gap(motions.graph.with_anchors(told)), known & bool(len(pairs))),
        one_step=nothing if one_step is None else one_step,
    )


def one_step_error(model: Model, motions: Motions, *, frames: int, stride: int) -> Array:
    """Predict one frame from true windows, every `stride` frames: not chaotic, so comparable.

    Args:
        model: Which model.
        motions: The truth; windows that are not known are left out.
        frames: To come after the first window, of which to take the windows.
        stride: Frames from a window to the next.

    Returns:
        Mean over windows and particles of the squared distance [m²], shape (trajectory,);
        infinite where a prediction is not finite.
    """
    total, count = torch.zeros(len(motions)).double(), torch.zeros(len(motions))
    for last in range(HISTORY - 1, HISTORY - 1 + frames, stride):
        window = motions.position[:, last + 1 - HISTORY : last + 2]
        rows = torch.nonzero(window.isfinite().all(-1).all(-1).all(-1))[:, 0]
        if not len(rows):
            continue
        sample = motions.sample(rows, torch.full_like(rows, last), 1)
        with torch.no_grad():
            state = model.advance(model.begin(sample.start), sample.inputs.at(0))
            after = model.positions(state).double()
        error = _squared_distance(after, sample.position[:, 0].double()).cpu()
        rows = rows.cpu()
        total[rows] += torch.where(error.isfinite(), error, torch.inf)
        count[rows] += 1
    return np.asarray((total / count).numpy())


def _spread(figures: Figures, rows: NDArray[np.int64], count: int) -> Figures:
    """Put figures of some rows among all."""
    whole = {}
    for name in _NAMES:
        values = getattr(figures, name)
        whole[name] = np.full((count, *values.shape[1:]), np.nan)
        whole[name][rows] = values
    return Figures(**whole)


def _squared_distance(told: Tensor, seen: Tensor) -> Tensor:
    return (told - seen).square().sum(-1).mean(-1)


def _energy_error(graph: Graph, told: Tensor, seen: Tensor) -> Array:
    truth, scale = _energy(graph, seen)
    return _marked((_energy(graph, told)[0] - truth).abs() / scale, truth.isfinite())


def _marked(values: Tensor, known: Tensor) -> Array:
    """Behind the last true frame: infinite where lost, not a number where nothing is known."""
    lost = torch.where(values.isfinite(), values, torch.inf)
    return np.asarray(torch.where(known, lost, torch.nan)[:, 1:].numpy())


def _energy(graph: Graph, position: Tensor) -> tuple[Tensor, Tensor]:
    """Of the particles as points [J], shape (trajectory, frame), and its scale (trajectory, 1)."""
    mass = graph.mass[: graph.particle_count]
    velocity = torch.gradient(position, spacing=graph.frame_s, dim=1)[0]
    kinetic = 0.5 * velocity.square().sum(-1) @ mass
    potential = -(position @ graph.gravity) @ mass
    pull = float(graph.gravity.norm()) or _EARTH
    floor = _ENERGY_FLOOR * float(mass.sum()) * pull * graph.length
    high, low, fast = (
        part.nan_to_num(nan=other).amax(1, keepdim=True)
        for part, other in ((potential, -1e300), (-potential, -1e300), (kinetic, 0.0))
    )
    return kinetic + potential, (fast + (high + low).clamp(min=0.0)).clamp(min=floor)

"""Effect of the integrator's step and of the given velocities on rollouts of HGNN and LGNN.

python -m benchmarks.energy_rollouts MODELS DATA [SCENE] > reports/energy-rollouts.md

Trained models of single engines, seed 0, predict the test part of their own engine's native data:
with one or more Runge-Kutta steps per frame, and with velocities that are differences of the nodes'
last six positions instead of the engine's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import print_head, print_table
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.learn.energy_models import EnergyModel
from mbds_xsim.learn.model import go_on
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.particles import EXPLODED, measure
from mbds_xsim.learn.window import HISTORY, Motions, Start
from mbds_xsim.report.quantity import number

MODELS = ("hgnn", "lgnn")
SUBSTEPS = (1, 2, 4, 8)
FRAMES = (10, 100)
BACKWARD = (-1 / 5, 5 / 4, -10 / 3, 5.0, -5.0, 137 / 60)
"""Weights of six equidistant values for the derivative at the last one, exact to degree five."""
_COMMAND = "python -m benchmarks.energy_rollouts out/models out/study"
_TEXT = f"""\
HGNN and LGNN start from an engine's body poses and velocities, GNS and SGNN from six frames of
positions. *Differences*: from the engine's poses alone, velocities being backward differences of
the nodes' last six places, with the steps of the training. *n steps*: Runge-Kutta steps a frame,
whatever was *trained with*. Mean squared error [m²] at t = {FRAMES[0]} on the test part of the
training's own engine, native data, seed 0; behind it how many predictions were lost or off by over
{EXPLODED:g} lengths of the scene at t = {FRAMES[1]}, which count as {EXPLODED:g} lengths."""


def from_places(model: EnergyModel, motions: Motions) -> Tensor:
    """Return start states from the bodies' last six poses, without their velocities."""
    assert motions.body is not None
    still = motions.body.clone()
    still[..., 7:] = 0.0

    def places(frame: int) -> Tensor:
        known = motions.position[:, :HISTORY], motions.velocity[:, frame], still[:, frame, None]
        return model.begin(Start(*known))[:, 0]

    history = [places(frame) for frame in range(HISTORY)]
    parts = [weight * place for weight, place in zip(BACKWARD, history, strict=True)]
    moving = torch.stack(parts).sum(0) / motions.graph.frame_s
    q, v = model.mechanics.project(history[-1], moving)
    return torch.stack([q, model.dynamics.conjugate(v)], dim=1)


def errors(model: EnergyModel, motions: Motions, state: Tensor | None = None) -> tuple[str, ...]:
    """Return the error at the first of `FRAMES`, and the number of predictions lost by the last."""
    rows = torch.arange(len(motions))
    sample = motions.sample(rows, torch.full_like(rows, HISTORY - 1), FRAMES[-1])
    with torch.no_grad():
        initial = model.begin(sample.start) if state is None else state
        predicted = go_on(model, initial, sample.inputs)
    largest = (EXPLODED * motions.graph.length) ** 2
    capped = np.minimum(measure(motions, predicted).error, largest)
    lost = int((capped.max(axis=1) >= largest).sum())
    return number(float(capped[:, FRAMES[0] - 1].mean())), f"{lost} of {len(motions)}"


def rows_of(models: Path, data: Path, scene: str) -> Iterator[list[str]]:
    """Yield a table row for each model and engine."""
    for name in MODELS:
        for path in sorted((models / scene / "native" / name).glob("*-s0.pt")):
            model, facts = read_model(path)
            engines = facts["train_engines"].split(",")
            if len(engines) > 1 or "interval" in facts:
                continue
            assert isinstance(model, EnergyModel)
            print(path, file=sys.stderr)
            file = load_dataset(data / scene / f"{engines[0]}-native.h5")
            motions = Motions.of(file, "test", bodies=True, dtype=model.dtype)
            trained = model.substeps
            texts = [str(trained)]
            for model.substeps in SUBSTEPS:
                texts += errors(model, motions)
            model.substeps = trained
            with torch.no_grad():
                texts += errors(model, motions, from_places(model, motions))
            yield [f"{name}, {engines[0]}", *texts]


def main(models: Path, data: Path, scene: str = "6pendulum") -> None:
    """Print the page."""
    torch.set_num_threads(1)
    ways = [f"{n} step{'s' * (n > 1)}" for n in SUBSTEPS] + ["differences"]
    headings = "|".join(f">{way}|>lost" for way in ways)
    title = "Rollouts of HGNN and LGNN: steps and given velocities"
    print_head(title, f"{_COMMAND} > reports/energy-rollouts.md", _TEXT)
    print(f"## {scene}\n")
    print_table(f"|>trained with|{headings}", rows_of(models, data, scene))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])

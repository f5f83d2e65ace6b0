"""SGNN learns how a rigid body flies: a regular tetrahedron, whose motion is known exactly."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import ConstantAcceleration, ConstantVelocity, LearnedModel
from mbds_xsim.learn.sgnn import SGNN, SGNNSettings
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import KnownInputs, Motions
from mbds_xsim.scene.scene import Body, Particle, Scene
from tests.learn.models import squared_error

torch.set_num_threads(1)
CORNERS = ((0.1, 0.1, 0.1), (0.1, -0.1, -0.1), (-0.1, 0.1, -0.1), (-0.1, -0.1, 0.1))
SCENE = Scene(
    name="tetrahedron",
    bodies=(Body("tetrahedron", particles=tuple(Particle(corner) for corner in CORNERS)),),
    length=1.0,
    edges=tuple(combinations(range(4), 2)),
)
FRAMES, AHEAD = 30, 10
STEPS, BATCH, RATE = 200, 16, 3e-3


def flights(split: str, count: int, seed: int) -> Motions:
    """Throws with a spin: all moments of inertia are equal, so that it stays the same."""
    rng = np.random.default_rng(seed)
    time = SCENE.clock.frame * np.arange(FRAMES)[:, None]
    fall = 0.5 * np.array(SCENE.gravity) * time**2
    centre = rng.normal(size=(count, 1, 3)) * time + fall
    spin = (3.0 * rng.normal(size=(count, 1, 3)) * time).reshape(-1, 3)
    first = Rotation.from_quat(np.repeat(Rotation.random(count, rng=rng).as_quat(), FRAMES, 0))
    pose = (Rotation.from_rotvec(spin) * first).as_matrix().reshape(count, FRAMES, 3, 3)
    position = centre[:, :, None] + np.einsum("tfij,pj->tfpi", pose, CORNERS)
    return Motions(
        graph=Graph.of(SCENE),
        split=split,
        index=np.arange(count),
        position=torch.from_numpy(position).float(),
        velocity=torch.zeros(position.shape),
        inputs=KnownInputs(torch.zeros(count, FRAMES - 1, 1, 3), torch.zeros(count, FRAMES - 1, 0)),
    )


def trained(train: Motions, settings: SGNNSettings) -> SGNN:
    torch.manual_seed(0)
    model = SGNN(train.graph, Statistics.of(train), settings)
    optimiser: Any = torch.optim.Adam(model.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=STEPS)
    generator = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        optimiser.zero_grad()
        torch.autograd.backward(model.loss(train.draw(BATCH, generator), generator))
        optimiser.step()
        schedule.step()
    return model


def error(model: LearnedModel, test: Motions) -> float:
    """Mean squared error [m²] after so many frames."""
    return float(squared_error(model, test, steps=AHEAD)[:, -1].mean())


SETTINGS = {
    "displacement": SGNNSettings(hidden=32, rigid=True),
    "change": SGNNSettings(hidden=32, target="change", rigid=True),
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_learns_to_fly(settings: SGNNSettings) -> None:
    train, test = flights("train", 200, seed=1), flights("test", 50, seed=2)
    model = trained(train, settings)
    statistics = Statistics.of(train)
    trivial = ConstantVelocity, ConstantAcceleration
    best = min(error(kind(train.graph, statistics, None), test) for kind in trivial)
    assert error(model, test) < 0.1 * best

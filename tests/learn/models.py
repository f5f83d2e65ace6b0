"""Untrained models as files, and errors of models."""

from __future__ import annotations

from pathlib import Path

import torch

from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import LearnedModel, rollout
from mbds_xsim.learn.model_file import save_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.simulate.registry import load_scene

__all__ = ["squared_error", "untrained"]


def untrained(
    folder: Path, scene: str, training: str = "mujoco", seed: int = 0, variant: str = "native"
) -> Path:
    """Write a small GNS where training would put it, with the facts of a training."""
    statistics = Statistics.of_nothing()
    settings = GNSSettings(width=8, steps=1)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = GNS(Graph.of(load_scene(scene)), statistics, settings)
    facts = {"model": "gns", "train_engines": training, "variant": variant, "training": training,
             "seed": str(seed), "wall_s": "12.5", "cpu_s": "12.0", "device": "cpu"}  # fmt: skip
    path = folder / scene / variant / "gns" / f"{training}-s{seed}.pt"
    save_model(path, model, "gns", settings, statistics, **facts)
    return path


def squared_error(model: LearnedModel, motions: Motions, steps: int | None = None) -> torch.Tensor:
    """Mean over particles of the squared distance [m²], shape (trajectory, frame)."""
    predicted = rollout(model, motions, steps=steps)
    truth = motions.position[:, HISTORY : HISTORY + predicted.shape[1]]
    return ((predicted - truth) ** 2).sum(-1).mean(-1)

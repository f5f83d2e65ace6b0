"""Models that are not trained, as files."""

from __future__ import annotations

from pathlib import Path

import torch

from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model_file import save_model
from mbds_xsim.learn.statistics import CHANNELS, Moments, Statistics
from mbds_xsim.registry import load_scene

__all__ = ["untrained"]


def untrained(folder: Path, scene: str, training: str = "mujoco", seed: int = 0) -> Path:
    """Write a small GNS where training would put it, with what training took."""
    unit = Moments(torch.zeros(3).double(), torch.ones(3).double())
    statistics = Statistics(unit, unit, unit, torch.ones(len(CHANNELS)).double())
    settings = GNSSettings(width=8, steps=1)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = GNS(Graph.of(load_scene(scene)), statistics, settings)
    facts = {"model": "gns", "train_engines": training, "variant": "native", "training": training,
             "seed": str(seed), "wall_s": "12.5", "cpu_s": "12.0", "device": "cpu"}  # fmt: skip
    path = folder / scene / "native" / "gns" / f"{training}-s{seed}.pt"
    save_model(path, model, "gns", settings, statistics, **facts)
    return path

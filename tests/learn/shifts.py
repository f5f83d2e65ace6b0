"""Data of two engines, and barely trained models of all trainings."""

from __future__ import annotations

from pathlib import Path

import msgspec
import torch

from mbds_xsim.base.isolate import HERE
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.learn.gns import GNS, GNSSettings
from mbds_xsim.learn.model_file import save_model
from mbds_xsim.learn.shift import study
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.window import Motions
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

SCENE = "1pendulum"
ENGINES = ("mujoco", "exudyn")
TRAININGS = {"mujoco": ("mujoco",), "exudyn": ("exudyn",), "all": ENGINES}
STEPS, COUNT, SEEDS = 18, 40, 2


def make(folder: Path) -> Path:
    scene = msgspec.structs.replace(load_scene(SCENE), clock=Clock(steps=STEPS))
    choice = Choice.parse(engines=",".join(ENGINES), profiles="native")
    request = Request((scene,), choice, COUNT, folder / "data")
    generate(request, workers=0)
    for training, engines in TRAININGS.items():
        for seed in range(SEEDS):
            train(folder, training, engines, seed)
    return folder


def train(folder: Path, training: str, engines: tuple[str, ...], seed: int, **more: str) -> None:
    files = [load_dataset(folder / "data" / SCENE / f"{name}-native.h5") for name in engines]
    motions = Motions.joined([Motions.of(file, "train") for file in files])
    statistics, settings = Statistics.of(motions), GNSSettings(width=8, steps=1)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = GNS(motions.graph, statistics, settings)
    facts = {
        "train_engines": ",".join(engines), "variant": "native", "training": training,
        "seed": str(seed), "profile": "tiny", "ended": "steps",
        "train_trajectories": str(len(motions)), **more,
    }  # fmt: skip
    path = folder / "models" / SCENE / "native" / "gns" / f"{training}-s{seed}.pt"
    save_model(path, model, "gns", settings, statistics, **facts)


def shift_of(folder: Path, at: int | None = None) -> Shift:
    """Test the models of a folder on the data next to them."""
    question = study.question_of(folder / "models", folder / "data", SCENE, at=at)
    return study.study(question, conduct=HERE).shift

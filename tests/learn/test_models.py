"""Every model goes through the same training; files of models hold what they state."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from mbds_xsim.base import versions
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.model import build, load_model, model_names, rollout, track_of
from mbds_xsim.learn.model_file import read_model, save_model
from mbds_xsim.learn.recipe import Profile, Recipe
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import train
from mbds_xsim.learn.window import Motions
from tests.golden import check_golden, shadow

Data = Callable[..., Dataset]


def _read(data: Data, name: str, split: str) -> Motions:
    kind = load_model(name)
    return Motions.of(
        data("2pendulum", trajectories=100), split, bodies=kind.needs_bodies, dtype=kind.dtype
    )


def test_golden_models(data: Data) -> None:
    figures = {}
    for name in model_names():
        training, test = _read(data, name, "train"), _read(data, name, "test")
        model = build(name, training.graph, Statistics.of(training), track=track_of(name))
        figures[name] = shadow(rollout(model, test, steps=2))

    check_golden("models", versions.MODELS, figures, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in model_names() if load_model(name).tracks])
def test_a_model_learns(data: Data, name: str) -> None:
    training, validation = _read(data, name, "train"), _read(data, name, "validation")
    model = build(name, training.graph, Statistics.of(training), track=track_of(name))
    fixed = training.draw(64, torch.Generator().manual_seed(7), horizon=2)
    before = model.loss(fixed, torch.Generator().manual_seed(8)).item()
    profile = Profile(steps=15, every=5, windows=4, horizon=2, until_level=False)
    own = load_model(name).tracks[track_of(name)].recipe
    recipe = Recipe(rate=1e-3, batch=16, horizon=own.horizon)
    run = train(model, training, validation, recipe, profile)
    assert run.ended == "steps"
    assert [point.step for point in run.curve] == [5, 10, 15]
    assert model.loss(fixed, torch.Generator().manual_seed(8)).item() < before


def test_a_model_of_other_code_is_refused(data: Data, scratch: Path) -> None:
    training = _read(data, "gns", "train")
    statistics = Statistics.of(training)
    model = build("gns", training.graph, statistics, track="lite")
    path = scratch / "model.pt"
    save_model(path, model, "gns", {"width": 64, "pushed": 0.5}, statistics)
    with pytest.raises(
        InputError, match=r"another version of the code \(.*pushed.*\); train it again"
    ):
        read_model(path)
    save_model(path, model, "gns", model.tracks["paper"], statistics)
    with pytest.raises(
        InputError, match=r"^[^\n]*another version of the code[^\n]*; train it again$"
    ):
        read_model(path)


def test_what_is_no_model_is_refused(scratch: Path) -> None:
    path = scratch / "model.pt"
    path.write_text("no model")
    with pytest.raises(InputError, match="no trained model"):
        read_model(path)
    torch.save({"format": "another"}, path)
    with pytest.raises(InputError, match="train it again"):
        read_model(path)

"""Errors in the code of another package's model name its line, and the file that was tested."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import build, load_model, refusal, rollout
from mbds_xsim.learn.model_file import read_facts, save_model
from mbds_xsim.learn.plugins import in_a_line
from mbds_xsim.learn.runs import prepared
from mbds_xsim.learn.shift import rollouts
from mbds_xsim.learn.shift.domains import load_paired
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.train import train
from mbds_xsim.learn.trained import TrainedModel, trained_model
from mbds_xsim.learn.trainings import planned
from mbds_xsim.simulate.registry import load_scene
from tests.learn.conftest import TINY, Ask
from tests.learn.shifts import SCENE
from tests.plugins import installed

_SOURCE = """
import msgspec
import torch
from mbds_xsim.learn.model import Hold
from mbds_xsim.learn.recipe import Recipe

class Settings(msgspec.Struct):
    recipe: Recipe = Recipe(batch=4)

class Erring(Hold):
    tracks = {"lite": Settings()}

    def __init__(self, graph, statistics, settings):
        super().__init__(graph, statistics, settings)
        self.rate = torch.nn.Parameter(torch.zeros(2 if len(graph.scene.bodies) < 3 else "x"))

    def predict(self, history, inputs):
        raise ValueError("no such\\nthing")
"""
_BUILT, _PREDICTED = (
    next(k for k, line in enumerate(_SOURCE.splitlines(), 1) if word in line)
    for word in ("self.rate", "raise")
)


@pytest.fixture(autouse=True)
def file(tmp_path: Path) -> Iterator[Path]:
    """Install a model with an error, and return the path of its module."""
    folder = tmp_path / "erring"
    with installed(folder, {"erring": _SOURCE}, models={"mine": "erring:Erring"}):
        yield folder / "erring.py"
    sys.modules.pop("erring", None)


def test_the_line_of_an_error_in_training_and_in_construction_is_named(
    ask: Ask, file: Path
) -> None:
    (run,) = planned(ask("mine")).runs
    model, _, parts = prepared(run)
    with pytest.raises(ValueError, match="no such") as caught:
        train(model, *parts, run.recipe, TINY)
    assert in_a_line(caught.value) == f"ValueError: no such thing (line {_PREDICTED} of {file})"
    with pytest.raises(ValueError, match="no such") as caught:
        rollout(model, parts[0])
    assert in_a_line(caught.value).endswith(f"(line {_PREDICTED} of {file})")
    assert refusal("mine", Graph.of(load_scene("3pendulum"))).endswith(f"(line {_BUILT} of {file})")


def _saved(folder: Path, studied: Path) -> TrainedModel:
    """Write the model's file as the page for those who add one shows, but in another folder."""
    graph, statistics = load_paired(studied / "data", SCENE).graph, Statistics.of_nothing()
    path, settings = folder / "weights" / "best.pt", load_model("mine").tracks["lite"]
    facts = {"training": "both", "train_engines": "mujoco, exudyn", "variant": "native", "seed": 3}
    save_model(path, build("mine", graph, statistics), "mine", settings, statistics, **facts)
    return trained_model(path)


def test_a_file_in_any_folder_is_of_its_registered_model(tmp_path: Path, studied: Path) -> None:
    trained = _saved(tmp_path, studied)
    assert (trained.kind, trained.model, trained.seed) == ("mine", "weights", 3)
    assert trained.engines == ("mujoco", "exudyn")
    assert "model" not in read_facts(trained.file)


@pytest.mark.usefixtures("apart")
def test_the_file_of_a_model_that_cannot_be_tested_is_named(
    tmp_path: Path, studied: Path, file: Path
) -> None:
    test, trained = load_paired(studied / "data", SCENE), _saved(tmp_path, studied)
    places = {(trained, domain.name): tmp_path / domain.name for domain in test.domains}
    with torch.no_grad(), pytest.raises(InputError) as refused:
        rollouts._test(test.scene, places, test.domains, rollouts.RolloutPlan(3))
    assert str(refused.value) == (
        f"{trained.path}: testing it failed: ValueError: no such thing (line {_PREDICTED} of "
        f"{file}); repair it, or remove its file"
    )


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize(
    ("where", "error"),
    [("_joined", OSError("disk")), ("figures_on", torch.OutOfMemoryError("of the device"))],
)
def test_data_or_memory_that_fail_are_not_called_the_models_error(
    where: str, error: Exception, tmp_path: Path, studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(rollouts, where, fail)
    test, trained = load_paired(studied / "data", SCENE), _saved(tmp_path, studied)
    places = {(trained, domain.name): tmp_path / domain.name for domain in test.domains}
    with pytest.raises(type(error), match=str(error)):
        rollouts._test(test.scene, places, test.domains, rollouts.RolloutPlan(3))

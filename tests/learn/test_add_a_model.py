"""The model on the page for those who add one passes the suite, is trained, and is a simulator."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import load_model, model_names, refusal, trainable
from mbds_xsim.learn.trainings import planned
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.models import ModelContract
from tests.command_line import CommandLine
from tests.learn.conftest import Ask
from tests.plugins import installed

_PAGE = Path(__file__).parents[2] / "docs" / "add-a-model.md"
_CODE = re.findall(r"^```python\n(.*?)^```$", _PAGE.read_text("utf-8"), re.M | re.S)
_NAME = "recurrence"


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Install the page's first example, as a package of its own."""
    model, _, _ = _CODE
    place = {_NAME: f"{_NAME}:Recurrence"}
    with installed(tmp_path_factory.mktemp(_NAME) / _NAME, {_NAME: model}, models=place):
        yield
    sys.modules.pop(_NAME, None)


class TestExample(ModelContract):
    @pytest.fixture
    def name(self) -> str:
        return _NAME


def _check_charted(run: CommandLine, file: str) -> None:
    """Chart a trained model beside an engine."""
    chart = ("--engines", "pybullet", "--limit", "0.1", "--starts", "1", "--json", "-")
    charted = run("tradeoff", "2pendulum", "--models", file, *chart)
    assert charted.code == 0, charted.err
    assert f'"{_NAME}' in charted.out


@pytest.mark.usefixtures("apart")
def test_it_is_trained_and_charted_like_the_others(
    made: Path, run: CommandLine, tmp_path: Path
) -> None:
    words = ("--on", "mujoco", "--models", _NAME, "--profile", "smoke", "--out", "models")
    trained = run("train", str(made / "2pendulum"), *words)
    assert trained.code == 0, trained.err
    (file,) = tmp_path.rglob(f"models/2pendulum/native/{_NAME}/mujoco-s0.pt")
    _check_charted(run, str(file))


@pytest.mark.usefixtures("here")
def test_one_that_was_trained_elsewhere_is_charted(run: CommandLine) -> None:
    exec(_CODE[1], {})
    _check_charted(run, f"models/2pendulum/matched/{_NAME}/mujoco-s0.pt")


_MODEL = "from mbds_xsim.learn.model import Hold\nclass Mine(Hold):\n"


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("raise OSError('no licence\\nhere')", "OSError: no licence here"),
        ("import sys; sys.exit(5)", "RuntimeError: it exits with 5"),
        ("Mine = 3", "is no LearnedModel"),
        ("", "AttributeError: "),
        (f"{_MODEL}    tracks = ['lite']", "has no tracks by name, but ['lite']"),
        (f"{_MODEL}    tracks = {{'lite': 3}}", "has no recipe in its track lite"),
    ],
)
def test_a_model_that_cannot_be_loaded_is_named_and_harms_no_other(
    source: str, says: str, ask: Ask, tmp_path: Path
) -> None:
    folder = tmp_path / "broken"
    with installed(folder, {"broken_model": source}, models={"mine": "broken_model:Mine"}):
        assert "mine" in model_names()
        assert "mine" not in trainable()
        assert "gns" in trainable()
        with pytest.raises(InputError, match=r"^the model mine cannot be used: ") as refused:
            load_model("mine")
        with pytest.raises(InputError, match=r"^the model mine cannot be used: "):
            planned(ask("mine"))
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
    sys.modules.pop("broken_model", None)


_FAILS = """
import os
from types import SimpleNamespace

from mbds_xsim.learn.model import PointModel
from mbds_xsim.learn.recipe import Recipe

class Fails(PointModel):
    tracks = {"lite": SimpleNamespace(recipe=Recipe())}

    def __init__(self, graph, statistics, settings):
        os.chdir("/")
        print("hello")
        raise KeyError("no such\\nbody")

    def predict(self, history, inputs): ...
    def loss(self, sample, generator): ...
"""


def test_a_model_that_fails_on_a_scene_cannot_represent_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph, folder, here = Graph.of(load_scene("2pendulum")), tmp_path / "fails", Path.cwd()
    with installed(folder, {"fails": _FAILS}, models={"fails": "fails:Fails"}):
        message = refusal("fails", graph)
    assert message.startswith("fails:Fails fails on scene '2pendulum': KeyError: ")
    assert "\n" not in message
    assert Path.cwd() == here
    assert capsys.readouterr() == ("", "hello\n")
    sys.modules.pop("fails", None)


_LONG = """
import msgspec
from mbds_xsim.learn.model import Hold
from mbds_xsim.learn.recipe import Recipe

class Settings(msgspec.Struct):
    recipe: Recipe = Recipe()
    warm: int = 20_000

class Long(Hold):
    tracks = {"lite": Settings()}
"""


def test_one_whose_file_could_not_be_read_is_refused_before_its_training(
    ask: Ask, tmp_path: Path
) -> None:
    line = "^the model long could not be read from its file: .* warm: got 20000, allowed is 0 to"
    with (
        installed(tmp_path / "long", {"long_model": _LONG}, models={"long": "long_model:Long"}),
        pytest.raises(InputError, match=line),
    ):
        planned(ask("long"))
    sys.modules.pop("long_model", None)

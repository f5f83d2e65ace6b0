"""Small motions given by formulas, data sets of few trajectories, and studies of such data."""

from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.groups import TrainingGroup, groups
from mbds_xsim.learn.recipe import Profile
from mbds_xsim.learn.runs import TrainingRequest
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.learn.window import KnownInputs, Motions
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.learn import shifts

torch.set_num_threads(1)

Analytic = Callable[..., Motions]
Ask = Callable[..., TrainingRequest]

TINY = Profile(steps=12, every=4, windows=4, horizon=2, until_level=False, least=5)


@pytest.fixture(scope="session")
def analytic() -> Analytic:
    """Make float64 motions x(t) of a scene's particles, t in frames."""

    def make(
        name: str,
        course: Callable[[torch.Tensor], torch.Tensor],
        *,
        frames: int = 20,
        rows: int = 4,
    ) -> Motions:
        graph = Graph.of(load_scene(name))
        rest = graph.reference[: graph.particle_count]
        time = torch.arange(frames, dtype=torch.float64)[:, None, None]
        size = torch.linspace(0.5, 1.0, rows, dtype=torch.float64)[:, None, None, None]
        position = rest + size * course(time).expand(frames, graph.particle_count, 3)
        position = torch.where(graph.moving, position, rest)
        hinges = len(graph.mechanism.hinges)
        return Motions(
            graph=graph,
            split="train",
            index=np.arange(rows),
            position=position,
            velocity=position.diff(dim=1, append=position[:, -1:]) / graph.frame_s,
            inputs=KnownInputs(
                torch.zeros(rows, frames - 1, graph.body_count, 3, dtype=torch.float64),
                torch.zeros(rows, frames - 1, hinges, dtype=torch.float64),
            ),
        )

    return make


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what a module's tests cache apart."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MBDS_XSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Dataset]:
    """Make (once) a small data set of a scene in MuJoCo."""
    made: dict[str, Dataset] = {}

    def make(name: str, *, trajectories: int = 30, steps: int = 25) -> Dataset:
        if name not in made:
            scene = msgspec.structs.replace(load_scene(name), clock=Clock(steps=steps))
            out = tmp_path_factory.mktemp("data")
            choice = Choice.parse(engines="mujoco", profiles="native")
            generate(Request((scene,), choice, trajectories, out), workers=0)
            made[name] = load_dataset(out / name / "mujoco-native.h5")
        return made[name]

    return make


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """A folder for checkpoints."""
    return tmp_path


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of a short chain in two engines."""
    scene = msgspec.structs.replace(load_scene("2pendulum"), clock=Clock(steps=12))
    out = tmp_path_factory.mktemp("made")
    choice = Choice.parse(engines="mujoco,pybullet", profiles="native")
    generate(Request((scene,), choice, 40, out), workers=0)
    return out


@pytest.fixture(scope="session")
def group(made: Path) -> TrainingGroup:
    (training_group,) = groups([made])
    return training_group


@pytest.fixture
def ask(group: TrainingGroup, tmp_path: Path) -> Ask:
    def make(*models: str, on: str = "all", seeds: int = 1, out: str = "models") -> TrainingRequest:
        return TrainingRequest(
            groups=[group],
            models=models or ("gns",),
            on=on,
            seeds=seeds,
            profile_name="smoke",
            profile=TINY,
            out=tmp_path / out,
        )

    return make


@pytest.fixture(scope="session")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of two engines, and barely trained models of all trainings."""
    return shifts.make(tmp_path_factory.mktemp("shift"))


@pytest.fixture(scope="module")
def shift(studied: Path, apart: None) -> Shift:
    """The study of those."""
    del apart
    return shifts.shift_of(studied)

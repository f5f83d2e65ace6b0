"""Which data each training sees: mixtures of engines, and parts of the data of each."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset import shard
from mbds_xsim.dataset.generate import Request as DataRequest
from mbds_xsim.dataset.generate import generate
from mbds_xsim.dataset.layout import SPLITS
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.dataset.variant import folder_name
from mbds_xsim.learn import runs
from mbds_xsim.learn.groups import Share, TrainingGroup, groups, mixed, shares_of, turns
from mbds_xsim.learn.recipe import Recipe
from mbds_xsim.learn.shift.domains import load_paired
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.trainings import planned
from mbds_xsim.learn.window import Motions
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Clock
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import Simulation, simulate
from tests.learn.conftest import Ask

ENGINES = "mujoco,pybullet"


def test_a_mixture_has_each_start_once_and_from_the_engine_whose_turn_it_is(
    group: TrainingGroup,
) -> None:
    engines = tuple(group.files)
    mixture = mixed(group, Share(engines), "train")
    alone = {engine: mixed(group, Share((engine,)), "train") for engine in engines}
    assert engines == ("mujoco", "pybullet")
    for motions in alone.values():
        assert np.array_equal(motions.index, mixture.index)
    assert not torch.equal(alone["mujoco"].position[:, 1:], alone["pybullet"].position[:, 1:])
    for row, number in enumerate(mixture.index):
        own = alone[engines[(number // 3) % 2]]
        assert torch.equal(mixture.position[row], own.position[row])
        assert torch.equal(mixture.velocity[row], own.velocity[row])


@pytest.mark.parametrize("count", [2, 3, 4])
def test_every_engine_of_a_mixture_is_seen_at_every_speed(count: int) -> None:
    numbers = np.arange(3 * count * 10)
    turn = turns(numbers, count)
    for engine in range(count):
        speeds = numbers[turn == engine] % 3
        assert np.bincount(speeds, minlength=3).tolist() == [10, 10, 10]


def test_what_one_engine_lacks_no_training_sees(group: TrainingGroup) -> None:
    short = dict(group.data)
    data = short["pybullet"]
    keep = np.isin(data.index, [0, 7], invert=True)
    small = {
        name: values[keep] for name, values in data.small.items() if name in ("index", "split")
    }
    short["pybullet"] = dataclasses.replace(data, small={**data.small, **small})
    lacking = dataclasses.replace(group)
    vars(lacking)["data"] = short
    numbers = lacking.numbers("train")
    assert set(group.numbers("train")) - set(numbers) == {0, 7}
    assert np.array_equal(mixed(lacking, Share(("mujoco",)), "train").index, numbers)


def test_an_engine_that_published_nothing_is_left_out(
    made: Path, ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    shutil.copytree(made, data)
    _publish_nothing(data, monkeypatch)
    (group,) = groups([data])
    assert list(group.files) == list(ENGINES.split(","))
    assert group.left_out == {"exudyn": "none of 40 trajectories drawn passed its checks"}
    request = dataclasses.replace(ask(on="each"), groups=[group])
    assert {run.training for run in planned(request).runs} == set(ENGINES.split(","))
    assert planned(request).left_out == {f"{group.name}/exudyn": group.left_out["exudyn"]}
    paired = load_paired(data, "2pendulum")
    assert [domain.engine for domain in paired.domains] == list(ENGINES.split(","))
    assert paired.left_out == {"exudyn-native": group.left_out["exudyn"]}

    for engine in ENGINES.split(","):
        (data / "2pendulum" / f"{engine}-native.h5").unlink()
    none = r"exudyn-native.h5: none of 40 .*; generate other data"
    with pytest.raises(InputError, match=none):
        groups([data])
    with pytest.raises(InputError, match=r"2pendulum: no trajectory was published"):
        load_paired(data, "2pendulum")


def test_a_variant_that_published_nothing_is_left_out(
    made: Path, ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    shutil.copytree(made, data)
    _publish_nothing(data, monkeypatch, profile="matched")
    empty, group = groups([data])
    assert not empty.files
    plan = planned(dataclasses.replace(ask(on="each"), groups=[empty, group]))
    assert {run.group.name for run in plan.runs} == {group.name}
    assert plan.left_out == {f"{empty.name}/exudyn": empty.left_out["exudyn"]}


def _publish_nothing(
    data: Path, monkeypatch: pytest.MonkeyPatch, *, profile: str = "native"
) -> None:
    """Make data of another engine that loses every trajectory at once."""

    def lose(*arguments: Any) -> Simulation:
        done = simulate(*arguments)
        lost = (Failure(0, "lost"),) * len(done.trajectory.position)
        nothing = np.full_like(done.trajectory.position, np.nan)
        trajectory = dataclasses.replace(done.trajectory, position=nothing, failures=lost)
        return dataclasses.replace(done, trajectory=trajectory)

    monkeypatch.setattr(shard, "simulate", lose)
    scene = msgspec.structs.replace(load_scene("2pendulum"), clock=Clock(steps=12))
    choice = Choice.parse(engines="exudyn", profiles=profile)
    generate(DataRequest((scene,), choice, 40, data), workers=0)


def test_what_data_are_too_few_or_short_for_is_said_before_any_run(
    group: TrainingGroup, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    lacking = dataclasses.replace(group)
    data = dict(group.data)
    for engine, file in data.items():
        split = np.where(file.index % 3, file.small["split"], SPLITS.index("train"))
        data[engine] = dataclasses.replace(file, small={**file.small, "split": split})
    vars(lacking)["data"] = data
    request = dataclasses.replace(ask(on="each,by-interval"), groups=[lacking])
    with pytest.raises(InputError, match=r"no trajectory of validation is of the interval 'low'"):
        planned(request)
    long = Recipe(horizon=8)
    monkeypatch.setattr(runs.TrainingRun, "recipe", long)
    line = r"mujoco-native.h5: got trajectories of 13 frames, gns in the track lite needs at least"
    with pytest.raises(InputError, match=f"{line} 14; generate longer ones"):
        planned(ask(on="mujoco"))


def test_the_name_of_a_scene_names_no_other_folder(group: TrainingGroup, ask: Ask) -> None:
    strange = dataclasses.replace(group, scene_name="../my arm")
    (run,) = planned(dataclasses.replace(ask(), groups=[strange])).runs
    assert run.path.resolve().is_relative_to(ask().out.resolve())
    assert run.identity["scene"] == "../my arm"
    assert run.name.startswith(f"{folder_name('../my arm')}/native/gns/")


def test_leave_one_out_leaves_it_out(group: TrainingGroup) -> None:
    shares = shares_of(group, "leave-one-out,mujoco,all")
    assert shares == {
        "not-mujoco": Share(("pybullet",)),
        "not-pybullet": Share(("mujoco",)),
        "mujoco": Share(("mujoco",)),
        "all": Share(("mujoco", "pybullet")),
    }


def test_an_interval_has_its_starts_of_one_engine_alone(group: TrainingGroup) -> None:
    shares = shares_of(group, "by-interval")
    assert list(shares) == [f"{e}-{i}" for e in ("mujoco", "pybullet") for i in INTERVALS]
    assert shares_of(group, "mujoco-low") == {"mujoco-low": Share(("mujoco",), "low")}
    for place, interval in enumerate(INTERVALS):
        for split in ("train", "validation"):
            whole = mixed(group, Share(("mujoco",)), split)
            part = mixed(group, shares[f"mujoco-{interval}"], split)
            assert part.index.tolist() == [n for n in whole.index.tolist() if n % 3 == place]
            row = whole.index.tolist().index(part.index[0])
            assert torch.equal(part.position[0], whole.position[row])


def test_statistics_are_of_the_training_part_and_engine(ask: Ask, group: TrainingGroup) -> None:
    (run,) = planned(ask(on="pybullet")).runs
    _, statistics, _ = runs.prepared(run)
    data: Dataset = group.data["pybullet"]
    own = Statistics.of(Motions.of(data, "train"))
    whole = np.array([data.position[int(row)] for row in range(len(data))])
    assert torch.equal(statistics.position.mean, own.position.mean)
    x = Motions.of(data, "train").graph.embed(torch.from_numpy(whole)).double().mean((0, 1, 2))
    assert not torch.allclose(statistics.position.mean, x, rtol=1e-6)

"""What is trained: models that cannot be are left out, data and places that do not fit refused."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import msgspec
import pytest

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.dataset.read import Dataset
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.groups import groups
from mbds_xsim.learn.train import check_identity
from mbds_xsim.learn.trainings import planned
from mbds_xsim.scene.scene import Scene
from tests.learn.carried import carry_out
from tests.learn.conftest import TINY, Ask


def test_what_a_model_cannot_represent_is_left_out(data: Callable[..., Dataset], ask: Ask) -> None:
    (ball,) = groups([data("balldrop").path])
    request = dataclasses.replace(ask("gns", "hgnn", on="each"), groups=[ball])
    plan = planned(request)
    assert [run.model for run in plan.runs] == ["gns"]
    assert list(plan.left_out) == ["balldrop/native/hgnn"]
    assert "contact" in plan.left_out["balldrop/native/hgnn"]


def test_a_scene_that_has_no_graph_is_left_out_for_every_model(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal is a reason like any other, and does not end the planning."""

    def refuse(_: Scene) -> Graph:
        raise Unsupported("servo of 'rail': got targets that change")

    request = ask("gns", "gns+")
    monkeypatch.setattr(Graph, "of", refuse)
    with pytest.raises(InputError, match=r"^nothing to train: gns: servo .*; gns\+: servo"):
        planned(request)


def test_nothing_to_train_is_said_with_every_reason(data: Callable[..., Dataset], ask: Ask) -> None:
    (ball,) = groups([data("balldrop").path])
    request = dataclasses.replace(ask("hgnn", "lgnn", on="each"), groups=[ball])
    with pytest.raises(InputError, match=r"^nothing to train: hgnn: .*contact.*; lgnn: .*contact"):
        planned(request)


def test_data_that_lack_the_forces_of_their_scene_are_refused_before_any_run(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.window.has_known_forces", lambda _: True)
    with pytest.raises(InputError, match="lacks input/known_force, which earlier"):
        planned(ask())


def test_damaged_data_are_not_trained_on(made: Path, ask: Ask, tmp_path: Path) -> None:
    folder = shutil.copytree(made, tmp_path / "data")
    shard_file = folder / "2pendulum/mujoco-native/0000000000.h5"
    with h5py.File(shard_file, "r+") as file:
        file["position"][2, 3] += 1e-6
    request = dataclasses.replace(ask(on="each"), groups=groups([folder]))
    with pytest.raises(InputError, match="dataset position is not what was written"):
        planned(request)
    planned(dataclasses.replace(request, on="pybullet"))  # reads none of these data


def test_another_run_in_its_place_is_refused(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    carry_out(ask())
    longer = msgspec.structs.replace(TINY, steps=16)
    plan = planned(dataclasses.replace(ask(), profile=longer), only=True)
    assert list(plan.blocked) == [run.name for run in plan.runs]
    assert "a model of another profile" in next(iter(plan.blocked.values()))
    with pytest.raises(InputError, match=r"of another profile \(steps 12, now 16\); name another"):
        planned(dataclasses.replace(ask(), profile=longer))
    with pytest.raises(InputError, match=r"a model of another track, settings;"):
        planned(dataclasses.replace(ask(), track="native"))
    with pytest.raises(InputError, match=r"a model of another device;"):
        planned(dataclasses.replace(ask(), device="cuda"))
    monkeypatch.setattr("mbds_xsim.learn.gns.GNS.revision", 1)
    with pytest.raises(InputError, match=r"a model of another revision;"):
        planned(ask())


def test_a_file_that_states_no_device_fits_any(ask: Ask) -> None:
    (run,) = planned(ask()).runs
    stated = {key: value for key, value in run.identity.items() if key != "device"}
    check_identity(run.path, "a model", stated, run.identity)

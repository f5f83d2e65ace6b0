"""Data and models that a shift study refuses, each in one line."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import h5py
import msgspec
import pytest
import torch

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import HERE
from mbds_xsim.commands import app
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import Dataset, load_dataset
from mbds_xsim.learn.shift import study
from mbds_xsim.learn.shift.domains import check_data, load_paired
from mbds_xsim.learn.trained import Selection, TrainedModel, check_budget, find_models
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.learn.shifts import ENGINES, SCENE, STEPS, TRAININGS, train

pytestmark = pytest.mark.usefixtures("apart")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--settings", "native,mached"], "got 'mached', .*1pendulum has data of native alone; ge"),
        (["--settings", "native,"], "--settings: got '', "),
        (["--on", "mujoco"], "--on: got 'mujoco', allowed is each, leave-one-out, all"),
        (["--at", "15"], r"--at: got 15, allowed in 1pendulum is 1, 10$"),
        (["--scene", SCENE, "--scene", "balldrop"], "balldrop: no data files"),
    ],
)
def test_what_is_not_there_is_refused_before_the_first_scene_is_studied(
    studied: Path, words: list[str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.shift.study.study", pytest.fail)
    with pytest.raises(InputError, match=line):
        app(
            ["shift", str(studied / "models"), str(studied / "data"), *words], standalone_mode=False
        )


@pytest.mark.parametrize(
    ("device", "line"),
    [
        ("tpu", "--device: got 'tpu', allowed is cpu or cuda"),
        pytest.param(
            "cuda",
            "torch finds no GPU here; allowed is cpu",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_a_device_that_is_not_there_is_refused(studied: Path, device: str, line: str) -> None:
    words = ["shift", str(studied / "models"), str(studied / "data"), "--device", device]
    with pytest.raises(InputError, match=line):
        app(words, standalone_mode=False)


def _copied(studied: Path, tmp_path: Path) -> Path:
    shutil.copytree(studied / "data" / SCENE, tmp_path / SCENE)
    return tmp_path


@pytest.mark.parametrize("name", ["start/velocity", "input/force"])
def test_unpaired_domains_are_refused(
    studied: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = _copied(studied, tmp_path)
    paired = load_paired(data, SCENE)
    shard = max((data / SCENE / "mujoco-native").glob("*.h5"))  # the last are those of tests
    with h5py.File(shard, "r+") as file:
        place = file["index"][()].tolist().index(paired.index[0])
        file[name][place, ..., 0] += 1e-9
    with pytest.raises(
        InputError, match=rf"{shard.name}: dataset {name} is not what was written; get"
    ):
        load_paired(data, SCENE)
    # Checksums that fit say nothing of pairing.
    monkeypatch.setattr(Dataset, "check", lambda *_: None)
    with pytest.raises(InputError, match=f"{name} of trajectory {paired.index[0]} is not that"):
        load_paired(data, SCENE)


def test_data_without_the_known_forces_of_their_scene_are_refused(
    studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.learn.window.has_known_forces", lambda _: True)
    with pytest.raises(InputError, match="lacks input/known_force, which earlier"):
        load_paired(studied / "data", SCENE)


def test_data_that_share_no_test_trajectory_are_refused(
    studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = Dataset.rows_of
    monkeypatch.setattr(
        Dataset, "rows_of", lambda self, split: rows(self, split)[: 2 * (self.variant[0] == "m")]
    )
    with pytest.raises(InputError, match=r"in all 2 files \(exudyn-native has fewest, 0\); make"):
        load_paired(studied / "data", SCENE)


def test_other_seeds_are_refused(studied: Path, tmp_path: Path) -> None:
    data = _copied(studied, tmp_path)
    with h5py.File(data / SCENE / "mujoco-native.h5", "r+") as file:
        file.attrs["seed"] = 7
    with pytest.raises(InputError, match="seed 7, unlike exudyn-native"):
        load_paired(data, SCENE)


def test_a_damaged_learning_curve_is_refused_before_the_study(studied: Path) -> None:
    curve = studied / "models" / SCENE / "native" / "gns" / "mujoco-s0.curve.json"
    curve.write_text("{")
    try:
        with pytest.raises(InputError, match=r"mujoco-s0\.curve\.json: no learning curve"):
            study.question_of(studied / "models", studied / "data", SCENE)
    finally:
        curve.unlink()


def test_a_cache_that_cannot_be_written_to_is_refused_before_the_study(
    studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", "/proc/cache")
    with pytest.raises(InputError, match="MBDS_XSIM_CACHE: cannot write /proc/cache/shift"):
        study.question_of(studied / "models", studied / "data", SCENE)


def test_data_with_no_frame_to_predict_are_refused(tmp_path: Path) -> None:
    scene = msgspec.structs.replace(load_scene(SCENE), clock=Clock(steps=HISTORY - 1))
    choice = Choice.parse(engines="mujoco", profiles="native")
    generate(Request((scene,), choice, 12, tmp_path), workers=0)
    with pytest.raises(InputError, match="got trajectories of 6 frames, needed are at least 7"):
        load_paired(tmp_path, SCENE)


def test_without_torch_the_command_says_what_to_install(
    studied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mbds_xsim.commands.shared.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"shift needs torch, which is not installed: pip"):
        app(["shift", str(studied / "models"), str(studied / "data")], standalone_mode=False)


def test_missing_data_and_models_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no data files"):
        load_paired(tmp_path, SCENE)
    with pytest.raises(InputError, match="no trained models"):
        find_models(tmp_path, SCENE)
    path = tmp_path / SCENE / "native" / "gns" / "mujoco-s0.pt"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"-s0\.pt: no trained model, or a damaged one; give an"):
        find_models(tmp_path, SCENE)


def test_a_model_of_another_scene_is_refused(studied: Path) -> None:
    entry = find_models(studied / "models", SCENE)[0]
    with pytest.raises(InputError, match="not trained on the scene of the data"):
        entry.load(load_scene(SCENE))
    paired = dataclasses.replace(load_paired(studied / "data", SCENE), scene=load_scene(SCENE))
    with pytest.raises(InputError, match="not trained on the scene of the data"):
        check_data([entry], paired)


def test_other_training_data_are_refused(studied: Path) -> None:
    paired = load_paired(studied / "data", SCENE)
    entry = find_models(studied / "models", SCENE)[0]
    content = {domain.engine: domain.content for domain in paired.domains}
    good = dataclasses.replace(entry, data=(("mujoco", content["mujoco"]),))
    check_data([entry, good], paired)
    bad = dataclasses.replace(entry, data=(("mujoco", content["exudyn"]),))
    with pytest.raises(InputError, match="another data set mujoco-native than the tested one"):
        check_data([good, bad], paired)


def test_one_of_two_engines_left_out_is_found_by_the_word_that_trained_it(studied: Path) -> None:
    entry = find_models(studied / "models", SCENE)[0]
    other = dataclasses.replace(entry, training="not-mujoco-native", engines=("exudyn",))

    assert other.single
    assert Selection.parse(None, "leave-one-out", None).has(other)
    assert not Selection.parse(None, "each", None).has(other)


def test_trainings_that_differ_in_more_than_their_engines_are_refused(studied: Path) -> None:
    entry = find_models(studied / "models", SCENE)[0]

    def trained(**facts: str) -> TrainedModel:
        return dataclasses.replace(entry, budget=tuple(facts.items()))

    check_budget([trained(profile="a", starts="b"), trained(profile="a"), trained()])
    other = dataclasses.replace(trained(profile="c"), model="sgnn")
    check_budget([trained(profile="a"), other])
    with pytest.raises(InputError, match="another starts than"):
        check_budget([trained(profile="a", starts="b"), trained(profile="a", starts="c")])
    matched = dataclasses.replace(trained(profile="a", starts="c"), variant="matched")
    check_budget([trained(profile="a", starts="b"), matched])
    with pytest.raises(InputError, match="another profile than"):
        check_budget([trained(profile="b", starts="b"), matched])


def test_a_model_that_has_seen_the_test_part_is_refused(studied: Path) -> None:
    """None of its domains is there, so checksums say nothing; a larger set has another split."""
    paired = load_paired(studied / "data", SCENE)
    entry = dataclasses.replace(find_models(studied / "models", SCENE)[0], data=())
    same = int(load_dataset(studied / "data" / SCENE / "mujoco-native.h5").attributes["count"])
    for drawn in (None, (0, same), (1, 10 * same)):
        check_data([dataclasses.replace(entry, drawn=drawn)], paired)
    leaking = dataclasses.replace(entry, drawn=(0, 10 * same))
    with pytest.raises(InputError, match=f"on trajectory {paired.index[0]} of the test part"):
        check_data([leaking], paired)


def test_fewer_trajectories_are_the_first_ones(studied: Path) -> None:
    whole, part = (load_paired(studied / "data", SCENE, count) for count in (None, 3))
    assert part.index.tolist() == whole.index[:3].tolist()
    assert sorted(part.index % 3) == [0, 1, 2]
    assert [len(domain.rows) for domain in part.domains] == [3, 3]
    assert len(part.batch) == 3


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_fewer_test_trajectories_than_intervals_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    scene = msgspec.structs.replace(load_scene(SCENE), clock=Clock(steps=STEPS))
    choice = Choice.parse(engines=",".join(ENGINES), profiles="native")
    generate(Request((scene,), choice, 10, tmp_path / "data"), workers=0)
    for training, engines in TRAININGS.items():
        train(tmp_path, training, engines, 0)
    writes = [f"--{name}={tmp_path / name}" for name in ("html", "rollouts", "png", "csv")]

    app(["shift", str(tmp_path / "models"), str(tmp_path / "data"), *writes], standalone_mode=False)

    assert '<script type="application/json" id="data">' in (tmp_path / "html").read_text()
    assert (tmp_path / "rollouts").read_bytes().startswith(b"\x89PNG")


def test_a_part_of_the_models_and_domains(studied: Path) -> None:
    models, data = studied / "models", studied / "data"
    part = Selection.parse("native", "each", 1)
    shift = study.study(
        study.question_of(models, data, SCENE, trajectories=2, part=part), conduct=HERE
    ).shift
    trained = [model for model in shift.models if model.engines]
    assert trained
    assert all(model.seed == 0 and len(model.engines) == 1 for model in trained)
    assert {domain.variant for domain in shift.domains} == {"native", ""}
    with pytest.raises(InputError, match="--settings: got 'matched', "):
        study.question_of(models, data, SCENE, part=Selection.parse("matched", None, None))
    line = "none of the 6 models there is selected; there are each native, all native, of seed 0"
    with pytest.raises(InputError, match=line):
        find_models(models, SCENE, Selection.parse(None, "leave-one-out", None))

"""`mbds-xsim export`: npz and CSV files hold the same numbers, and can be audited."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import locked
from mbds_xsim.base.isolate import Silent
from mbds_xsim.dataset.audit import audit_file
from mbds_xsim.dataset.export import LOST, Form, _check_target, export
from mbds_xsim.dataset.foreign import Provenance, read_foreign
from mbds_xsim.dataset.layout import FIELDS
from mbds_xsim.dataset.read import Dataset, load_dataset, parse_numbers
from mbds_xsim.scene.file import read_scene
from mbds_xsim.scene.scene import Scene

from .conftest import Make

MOTION = ("position", "velocity", "body/position", "body/orientation", "body/velocity")
SET = "1pendulum/mujoco-matched"


@pytest.fixture(scope="module")
def data(whole: Path) -> Dataset:
    return load_dataset(whole / f"{SET}.h5")


def _exported(whole: Path, out: Path, form: Form, numbers: list[int] | None = None) -> Path:
    export(whole, out, form, numbers=numbers, progress=Silent())
    return out / SET


def test_npz_files_hold_every_trajectory(whole: Path, data: Dataset, tmp_path: Path) -> None:
    done = export(whole, tmp_path, "npz", progress=Silent())
    files = sorted((tmp_path / SET).glob("*.npz"))
    assert (done.files, done.trajectories, len(files)) == (3, len(data), 3)
    assert done.bytes == sum(file.stat().st_size for file in files)
    parts = [np.load(file) for file in files]
    for name in (*MOTION, "input/force", "index"):
        whole_set = np.concatenate([part[name] for part in parts])
        np.testing.assert_array_equal(whole_set, np.asarray(data[name]))
        assert whole_set.dtype == np.asarray(data[name]).dtype
    split = np.concatenate([part["split"] for part in parts])
    np.testing.assert_array_equal(split, data.small["split"])


def test_what_is_not_carried_is_said(whole: Path, data: Dataset, tmp_path: Path) -> None:
    """Every dataset of the file is in the export or named as lost, in print and in the README."""
    folder = _exported(whole, tmp_path, "npz", [0])
    there = set(np.load(folder / "0000000000.npz").files)
    lost = " ".join(LOST["npz"])
    missing = set(load_dataset(data.files[0])) - there
    assert missing == {name for name in FIELDS if name.startswith(("check/", "start/"))}
    assert all(f"({name.split('/')[0]}/…" in lost for name in missing)
    readme = (folder / "README.md").read_text()
    assert all(line in readme for line in LOST["npz"])


@pytest.mark.parametrize("form", ["npz", "csv"])
def test_an_export_can_be_audited(form: Form, whole: Path, data: Dataset, tmp_path: Path) -> None:
    """The figures, the start and the inputs are those of the data set."""
    folder = _exported(whole, tmp_path, form, [16])
    scene = read_scene(folder / "scene.toml")
    assert scene == data.scene
    result = audit_file(
        folder / f"0000000016.{form}", scene if form == "csv" else None, Provenance()
    )
    assert (result.verdict, result.trajectories) == ("pass", 1)
    assert "start and inputs: those of seed 0, index 16, with noise" in result.taken
    row = data.index.tolist().index(16)
    stored = dict(zip(data["check/name"], np.asarray(data["check/figure"])[row], strict=True))
    figures = {finding.check: finding.figure for finding in result.findings}
    for check in ("start", "gap", "energy", "momentum"):
        assert figures[check] == pytest.approx(stored[check], rel=1e-6), check


def test_csv_files_hold_the_same_bits(whole: Path, data: Dataset, tmp_path: Path) -> None:
    folder = _exported(whole, tmp_path, "csv", [0, 36])
    assert sorted(path.name for path in folder.glob("*.csv")) == [
        "0000000000.csv",
        "0000000036.csv",
    ]
    (source,) = read_foreign(folder / "0000000036.csv", data.scene)
    row = data.index.tolist().index(36)
    for name in (*MOTION, "body/angular_velocity", "input/force"):
        stored = np.asarray(data[name][row], dtype=np.float64)
        read = source.arrays[name][0].astype(np.asarray(data[name]).dtype)
        np.testing.assert_array_equal(read, stored)
    assert source.facts["seed"] == 0


@pytest.mark.parametrize("form", ["npz", "csv"])
def test_the_same_export_makes_the_same_bytes(form: Form, whole: Path, tmp_path: Path) -> None:
    contents = [
        {
            path.name: path.read_bytes()
            for path in _exported(whole, tmp_path / out, form, [5]).iterdir()
        }
        for out in ("one", "one", "other")
    ]
    assert contents[0] == contents[1] == contents[2]


def test_bad_requests_are_one_line(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--indices: got 40, allowed for .* is 0 … 39"):
        _exported(whole, tmp_path, "npz", [3, 40])
    with pytest.raises(InputError, match=r"--engines: got 'dart', allowed for .* is mujoco"):
        export(whole, tmp_path, "npz", engines="dart", progress=Silent())
    with pytest.raises(InputError, match="holds no data set"):
        export(tmp_path, tmp_path / "out", "npz", progress=Silent())
    with pytest.raises(InputError, match="there is no such file or folder"):
        export(tmp_path / "nothing", tmp_path / "out", "npz", progress=Silent())
    assert not list(tmp_path.iterdir())
    _exported(whole, tmp_path, "csv", [3])
    with pytest.raises(InputError, match=r"holds 0000000003\.csv, which is not of this export"):
        _exported(whole, tmp_path, "csv", [4])
    _exported(whole, tmp_path / "all", "npz")
    with pytest.raises(InputError, match=r"holds 0000000016\.npz, which is not of this export"):
        _exported(whole, tmp_path / "all", "npz", [3])


def test_an_export_goes_on_after_it_was_killed(whole: Path, tmp_path: Path) -> None:
    folder = _exported(whole, tmp_path, "csv", [3])
    (folder / ".0000000003.csv.host-1.part").write_bytes(b"# seed")
    _exported(whole, tmp_path, "csv", [3])
    there = {file.name for file in folder.iterdir()}
    assert there == {"README.md", "scene.toml", "0000000003.csv"}


def test_two_exports_at_once(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with locked(tmp_path), pytest.raises(InputError, match=r"is in use by process \d+; wait"):
        _exported(whole, tmp_path, "csv", [3])

    def other(_: Dataset) -> None:
        monkeypatch.undo()
        _exported(whole, tmp_path, "csv", [4])

    monkeypatch.setattr(Dataset, "check", other)
    with pytest.raises(InputError, match=r"holds 0000000004\.csv, which is not of this export"):
        _exported(whole, tmp_path, "csv", [3])


def test_two_sets_of_one_folder_are_refused(whole: Path, tmp_path: Path) -> None:
    """A copy beside the original has the same scene and variant, and would replace it."""
    for name in ("one", "two"):
        shutil.copytree(whole, tmp_path / "data" / name)
    with pytest.raises(InputError, match=r"one/.* and .*two/.* would both be written to .*"):
        _exported(tmp_path / "data", tmp_path / "out", "csv", [3])
    assert not (tmp_path / "out").exists()


def test_files_of_other_data_are_not_kept_for_their_numbers(
    whole: Path, data: Dataset, tmp_path: Path
) -> None:
    """A number asked for that was rejected is not of this export, whatever wrote its file."""
    small = {**data.small, "index": data.index[data.index != 3]}
    lacking = dataclasses.replace(data, small=small)
    target = _exported(whole, tmp_path, "csv", [3])
    with pytest.raises(InputError, match=r"holds 0000000003\.csv, which is not of this export"):
        _check_target(lacking, tmp_path, "csv", [3, 4])
    assert (target / "0000000003.csv").is_file()


@pytest.mark.parametrize("form", ["npz", "csv"])
def test_rejected_trajectories_are_kept_apart(
    form: Form, make: Make, rod: Scene, tmp_path: Path
) -> None:
    """They do not replace published ones, and everything says what they are."""
    strict = msgspec.structs.replace(rod.budget, energy=1e-15, energy_first_order=1e-15)
    scene = msgspec.structs.replace(rod, budget=strict)
    make(tmp_path / "data", scene=scene, trajectories=3)
    file = tmp_path / "data/rejected" / SET / "0000000000.h5"
    done = export(file, tmp_path / "out", form, progress=Silent())
    assert (done.rejected, done.trajectories) == (True, 3)
    assert "rejected trajectories" not in done.lost
    assert not (tmp_path / "out" / SET).exists()
    folder = tmp_path / "out/rejected" / SET
    readme = (folder / "README.md").read_text()
    assert "rejected, do not use as data" in readme
    assert "certified" not in readme
    assert "rejected trajectories" not in readme
    text = (folder / f"0000000000.{form}").read_bytes()
    assert "uncertified" not in repr(load_dataset(file))
    if form == "csv":
        assert b"# certification: rejected, do not use as data\n" in text
        assert b"# reason: energy" in text
    else:
        arrays = np.load(folder / "0000000000.npz")
        assert str(arrays["certification"]) == "rejected, do not use as data"
        assert "energy" in arrays["reason"][0]


def test_damaged_data_are_not_exported(make: Make, tmp_path: Path) -> None:
    make(tmp_path / "data", trajectories=4)
    with h5py.File(tmp_path / "data" / SET / "0000000000.h5", "r+") as file:
        file["position"][2, 3] += 1e-6
    with pytest.raises(InputError, match="dataset position is not what was written"):
        _exported(tmp_path / "data", tmp_path / "out", "npz")
    assert not (tmp_path / "out").exists()


def test_numbers_are_read_as_people_write_them() -> None:
    assert parse_numbers("7, 0-2,1", "--indices") == [7, 0, 1, 2, 1]
    for text in ("", "3-1", "a", "1,,2", "-1", "0-999999999999", "0-9999998,0-9"):
        with pytest.raises(InputError, match=r"--indices: got"):
            parse_numbers(text, "--indices")

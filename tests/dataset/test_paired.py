"""Pairs: the same trajectories in several data sets, read when they are asked for."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.paired import load_pairs
from mbds_xsim.dataset.read import Dataset, UnknownDataset, load_dataset
from mbds_xsim.dataset.verify import recheck
from mbds_xsim.scene.scene import Scene
from tests.dataset.conftest import Make

COUNT = 30
NAMES = ("mujoco-matched", "mujoco-native")


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of two settings, which differ for a reader as two engines do."""
    out = tmp_path_factory.mktemp("paired")
    make(out, trajectories=COUNT, settings="matched,native")
    return out / "1pendulum"


@pytest.fixture
def files(folder: Path) -> list[Dataset]:
    """Open both data sets."""
    return [load_dataset(folder / f"{name}.h5") for name in NAMES]


def test_trajectories_of_a_number_are_side_by_side(folder: Path, files: list[Dataset]) -> None:
    pairs = load_pairs(folder)
    shared = sorted({*files[0].index.tolist()} & {*files[1].index.tolist()})
    expected = np.stack(
        [np.stack([one["position"][one.index == k][0] for one in files]) for k in shared]
    )

    assert tuple(pairs.files) == NAMES
    assert pairs.index.tolist() == shared
    position = pairs["position"]
    assert position.shape == expected.shape == (len(pairs), 2, 11, *expected.shape[3:])
    assert not (position[:, 0] == position[:, 1]).all()
    odd = np.arange(len(pairs)) % 2 == 1
    for key in (3, -1, slice(2, 9, 3), [4, 2], odd, (3, 1), (slice(None), 0, -1), (odd, 1), ...):
        np.testing.assert_array_equal(position[key], expected[key], strict=True)
    np.testing.assert_array_equal(np.stack(list(position)), expected)
    with pytest.raises(IndexError):
        position[len(pairs)]


def test_a_part_of_the_split_is_paired_alone(folder: Path, files: list[Dataset]) -> None:
    pairs = load_pairs(folder / "mujoco-native.h5", folder / "mujoco-matched.h5", split="train")

    assert 0 < len(pairs) < COUNT
    assert tuple(pairs.files) == NAMES[::-1]
    assert set(pairs.index) == set(files[0].index[files[0].rows_of("train")])
    spin = pairs["body/angular_velocity"][:]
    for k, one in enumerate(reversed(files)):
        rows = np.isin(one.index, pairs.index)
        np.testing.assert_array_equal(spin[:, k], one["body/angular_velocity"][rows])


def test_what_is_the_same_in_all_comes_once(folder: Path) -> None:
    pairs = load_pairs(folder, split="test")

    assert pairs["time"].shape == (11,)
    np.testing.assert_array_equal(pairs["index"], pairs.index)
    assert {"position", "time", "graph/edge"} <= set(pairs)
    assert pairs.scene.name == "1pendulum"
    with pytest.raises(UnknownDataset, match="no dataset is called 'positions'"):
        pairs["positions"]


def test_what_cannot_be_paired_is_refused(make: Make, folder: Path, tmp_path: Path) -> None:
    make(tmp_path / "other", trajectories=3, seed=1)
    other = tmp_path / "other" / "1pendulum" / "mujoco-matched.h5"

    with pytest.raises(InputError, match="pairing takes two or more data sets, each of another"):
        load_pairs(other)
    with pytest.raises(InputError, match="pairing takes two or more data sets, each of another"):
        load_pairs(other, folder / "mujoco-matched.h5")
    with pytest.raises(InputError, match=r"seed 0, unlike mujoco-matched\.h5 \(1\)"):
        load_pairs(other, folder / "mujoco-native.h5")


def test_a_variant_in_which_nothing_is_published_leaves_the_others_paired(
    make: Make, rod: Scene, tmp_path: Path
) -> None:
    strict = msgspec.structs.replace(rod.budget, energy=1e-15, energy_first_order=1e-15)
    scene = msgspec.structs.replace(rod, budget=strict)
    settings = "matched,native"
    make(tmp_path, scene=scene, trajectories=3, engines="exudyn,mujoco", settings=settings)
    folder = tmp_path / "1pendulum"
    empty = [folder / f"{name}-matched.h5" for name in ("exudyn", "mujoco")]

    assert [*load_pairs(folder).files] == ["exudyn-native", "mujoco-native"]
    with h5py.File(folder / "joint.h5") as file:
        assert file["valid"][()].sum() == 6
        assert file["valid_in_all"][()].all()
    card = (folder / "README.md").read_text("utf-8")
    but = " but `exudyn-matched.h5` and `mujoco-matched.h5`, without any (`joint.h5`)"
    assert f"3 of 3 are published in all of them{but}" in card
    assert 'load_dataset("exudyn-native.h5")' in card
    assert recheck(folder / "joint.h5", "joint").problems == []
    with pytest.raises(InputError, match=r"none of 3 trajectories drawn passed .*: no traj"):
        load_pairs(*empty)
    (folder / "exudyn-native.h5").unlink()
    with pytest.raises(InputError, match=r"pairing takes .* settings; .*none of 3 trajectories"):
        load_pairs(folder)


def test_without_xarray_the_line_that_installs_it(
    folder: Path, files: list[Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    for data in (files[0], load_pairs(folder)):
        with pytest.raises(InputError, match=r"needs xarray.*pip install 'mbds-xsim\[frames\]'"):
            data.to_xarray()


def test_xarray_takes_names_of_any_datasets(folder: Path, files: list[Dataset]) -> None:
    """Rows are those of trajectories; what all share comes whole."""
    pytest.importorskip("xarray")
    assert files[0].to_xarray("position", rows=1)["position"].shape[0] == 1
    one = files[0].to_xarray(["time", "position"], rows=slice(0, 2))
    assert (one["time"].shape, one["position"].shape[:2]) == ((11,), (2, 11))
    assert list(files[0].to_xarray("position")) == ["position"]
    assert list(load_pairs(folder).to_xarray("velocity")) == ["velocity"]
    for data in (files[0], load_pairs(folder)):
        with pytest.raises(UnknownDataset, match="no dataset is called 'positon'"):
            data.to_xarray(["positon"])


def test_xarray_has_the_axes_of_the_layout(folder: Path, files: list[Dataset]) -> None:
    pytest.importorskip("xarray")
    one = files[0].to_xarray(("position", "body/orientation"), rows=slice(2, 5))
    both = load_pairs(folder).to_xarray()

    assert one["body/orientation"].dims == ("trajectory", "frame", "body", "wxyz")
    np.testing.assert_array_equal(one["position"], files[0]["position"][2:5])
    assert one["trajectory"].values.tolist() == files[0].index[2:5].tolist()
    assert both["position"].dims == ("trajectory", "engine", "frame", "point", "axis")
    apart = both["position"].sel(engine=NAMES[0]) - both["position"].sel(engine=NAMES[1])
    assert float(abs(apart).max()) > 0
    assert both["frame"].values == pytest.approx(files[0].time)

"""Reading: the same numbers as the file, mapped, and windows of them as training draws them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbds_xsim
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset import series
from mbds_xsim.dataset.read import Dataset, joined_files
from mbds_xsim.scene.scene import Scene

from .conftest import STEPS, TRAJECTORIES, Make

FILE = "1pendulum/mujoco-matched.h5"


@pytest.fixture(scope="module")
def data(whole: Path) -> Dataset:
    return mbds_xsim.load_dataset(whole / FILE)


def test_it_says_what_it_is(data: Dataset, rod: Scene) -> None:
    assert repr(data) == (
        "<1pendulum mujoco matched (certified): 40 trajectories of 10 steps of 0.02 s>"
    )
    assert data.scene == rod
    assert len(data) == TRAJECTORIES
    assert data.position.shape == (TRAJECTORIES, STEPS + 1, 1, 3)


@pytest.mark.parametrize(
    "name", ["position", "body/orientation", "input/force", "start/velocity", "check/figure"]
)
def test_arrays_are_the_file_s(name: str, data: Dataset, whole: Path) -> None:
    with h5py.File(whole / FILE) as file:
        series, stored = data[name], file[name][()]
        assert np.array_equal(np.asarray(series), stored, equal_nan=True)
        for row in (0, 15, 16, 36, -1):
            assert np.array_equal(series[row], stored[row], equal_nan=True)
        assert np.array_equal(np.stack(list(series)), stored, equal_nan=True)


def test_nothing_can_be_overwritten(data: Dataset) -> None:
    with pytest.raises(ValueError, match="read-only"):
        data.position[0][0] = 1.0


def test_one_row_is_a_batch_of_one(data: Dataset) -> None:
    assert data.batch(17).index.tolist() == [17]
    (one,) = data.trajectory(np.int64(17)).position
    assert np.array_equal(one, data["body/position"][17])


def test_a_row_that_is_not_there(data: Dataset) -> None:
    with pytest.raises(IndexError, match="row 40 of 40"):
        data.position[TRAJECTORIES]


def test_a_data_set_is_a_mapping(data: Dataset) -> None:
    names = list(data)
    assert names[:4] == ["index", "interval", "time", "position"]
    assert list(data.keys()) == names
    assert all(name in data for name in names)
    assert {name: np.shape(values) for name, values in data.items()} == {
        name: np.shape(values) for name, values in zip(names, data.values(), strict=True)
    }
    assert dict(data).keys() == data.keys()
    assert "known_force" not in data
    assert data.get("known_force") is None
    assert np.array_equal(data.time, 0.02 * np.arange(STEPS + 1))
    assert data.time is data["time"]


@pytest.mark.parametrize("key", [0, slice(0, 2), [0, 1], np.array([True])])
def test_rows_are_asked_of_a_series(key: Any, data: Dataset) -> None:
    with pytest.raises(KeyError, match=r"^data\[.*\]: a data set is indexed by names of its data"):
        data[key]


def test_an_unknown_dataset(data: Dataset) -> None:
    with pytest.raises(InputError, match=r"did you mean 'position'\? There are: index, i"):
        data["positions"]
    with pytest.raises(KeyError):
        data.windows(2, names=("positions",))


KEYS = st.one_of(
    st.integers(-720, 720),
    st.slices(TRAJECTORIES),
    st.lists(st.integers(-TRAJECTORIES, TRAJECTORIES - 1), max_size=5),
    st.lists(st.booleans(), min_size=TRAJECTORIES, max_size=TRAJECTORIES).map(np.array),
    st.lists(st.booleans(), min_size=3, max_size=3).map(np.array),
    st.lists(st.integers(0, 299), min_size=4, max_size=4).map(lambda k: np.reshape(k, (2, 2))),
    st.sampled_from([None, ..., (), 1.5, "position", (..., 0), (None, 3)]),
)
INNER = st.one_of(
    st.integers(-2, 2), st.slices(STEPS + 1), st.just(...), st.sampled_from([[0, 2], [1, 0]])
)


@settings(max_examples=60, deadline=None)
@given(key=KEYS | st.tuples(KEYS, INNER) | st.tuples(KEYS, INNER, INNER))
def test_a_series_is_indexed_as_an_array(key: Any, data: Dataset) -> None:
    """Indexing gives what numpy gives, and raises an IndexError where numpy does."""
    array = np.asarray(data.position)
    try:
        wanted = array[key]
    except IndexError:
        with pytest.raises(IndexError):
            data.position[key]
        return
    got = data.position[key]
    assert got.shape == wanted.shape
    assert np.array_equal(got, wanted)


def test_a_series_knows_what_an_array_knows(data: Dataset) -> None:
    series, array = data["body/position"], np.asarray(data["body/position"])
    assert (series.shape, series.ndim, series.dtype) == (array.shape, array.ndim, array.dtype)
    assert repr(series) == "<body/position: float64 of shape (40, 11, 1, 3)>"
    assert np.asarray(series, dtype=np.float32).dtype == np.float32
    with pytest.raises(ValueError, match="an array of the whole dataset is a copy"):
        np.asarray(series, copy=False)


def test_windows_are_the_frames_of_their_place(data: Dataset) -> None:
    windows = data.windows(6)
    assert len(windows) == TRAJECTORIES * (STEPS + 1 - 5)
    rng = np.random.default_rng(0)
    numbers = rng.integers(len(windows), size=200)
    position, velocity = windows.take(numbers)
    rows, frames = windows.where(numbers)
    assert len(np.unique(rows // 16)) == 3  # from all shards
    for k, (row, frame) in enumerate(zip(rows, frames, strict=True)):
        assert np.array_equal(position[k], data.position[row][frame : frame + 6])
        assert np.array_equal(velocity[k], data.velocity[row][frame : frame + 6])


def test_windows_fetch_as_torch_does(data: Dataset) -> None:
    windows = data.windows(3, names=("position",))
    (batch,) = windows.take([5, 200])
    assert np.array_equal(windows[5][0], batch[0])
    assert np.array_equal(windows.__getitems__([5, 200])[1][0], batch[1])
    copy = pickle.loads(pickle.dumps(windows))
    assert np.array_equal(copy[200][0], batch[1])
    with pytest.raises(IndexError):
        windows[len(windows)]
    with pytest.raises(IndexError):
        windows.take([len(windows)])
    with pytest.raises(IndexError, match="window -1 of"):
        windows.take([3, -1])
    for other in ([True, False], [0.5], [[1, 2]], 3):  # numpy would make windows 1, 0 and 0 of two
        with pytest.raises(IndexError, match="by whole numbers in a row, got"):
            windows.take(other)  # type: ignore[arg-type]
    assert np.array_equal(data.windows(3, names="position")[5][0], batch[0])
    assert len(windows.take([])[0]) == 0


def test_a_file_that_is_mapped_again_is_not_searched_again(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To open it as HDF5 takes a hundred times as long, and only some are mapped at a time."""
    windows = data.windows(3)
    before = windows.take(range(len(windows)))
    monkeypatch.setattr(series, "open_hdf5", lambda path: pytest.fail(f"{path} was opened"))
    series._values.cache_clear()
    series._bytes_of.cache_clear()
    for got, wanted in zip(windows.take(range(len(windows))), before, strict=True):
        assert np.array_equal(got, wanted)


def test_windows_of_a_part(data: Dataset) -> None:
    test = data.windows(2, split="test")
    rows, _ = test.where(np.arange(len(test)))
    assert np.array_equal(np.unique(rows), np.arange(36, 40))
    both = data.windows(2, split="test", rows=np.array([3, 37]))
    assert len(both) == STEPS
    mask = np.arange(len(data)) == 37
    assert np.array_equal(data.windows(2, rows=mask).rows, [37])


def test_windows_of_frames_and_steps_stay_in_their_trajectory(data: Dataset) -> None:
    """There is one step less than frames: no window may reach into the next trajectory."""
    windows = data.windows(4, names=("position", "input/force"))
    assert len(windows) == TRAJECTORIES * (STEPS - 3)
    position, force = windows.take(range(len(windows)))
    for k, (row, frame) in enumerate(zip(*windows.where(np.arange(len(windows))), strict=True)):
        assert np.array_equal(position[k], data.position[row][frame : frame + 4])
        assert np.array_equal(force[k], data["input/force"][row][frame : frame + 4])
    assert len(data.windows(STEPS, names=("input/force", "position"))) == TRAJECTORIES
    with pytest.raises(InputError, match="length: got 11, allowed is 1 to 10 frames"):
        data.windows(STEPS + 1, names=("position", "input/force"))


@pytest.mark.parametrize("name", ["start/position", "check/figure", "interval"])
def test_windows_need_frames(name: str, data: Dataset) -> None:
    with pytest.raises(InputError, match=f"names: got '{name}', which has neither frames nor"):
        data.windows(1, names=("position", name))
    with pytest.raises(InputError, match="names: got none, allowed are datasets of frames"):
        data.windows(1, names=())


def test_windows_too_long(data: Dataset) -> None:
    with pytest.raises(InputError, match="length: got 12, allowed is 1 to 11 frames"):
        data.windows(12)
    with pytest.raises(InputError, match=r"length: got 2\.5, allowed is 1 to 11 frames"):
        data.windows(2.5)  # type: ignore[arg-type]


def test_an_unknown_part(data: Dataset) -> None:
    with pytest.raises(InputError, match="split: got 'eval', allowed is train, validation, test"):
        data.rows_of("eval")


def test_one_shard_alone(whole: Path) -> None:
    shard = mbds_xsim.load_dataset(whole / "1pendulum/mujoco-matched/0000000016.h5")
    assert shard.index.tolist() == list(range(16, 32))
    assert len(shard.windows(11)) == 16
    with pytest.raises(InputError, match="is one shard; the split is in the file that joins"):
        shard.rows_of("train")


def test_files_that_hold_no_trajectories(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no trajectories, it is of the kind 'joint'"):
        mbds_xsim.load_dataset(whole / "1pendulum/joint.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        mbds_xsim.load_dataset(tmp_path / "text.h5")
    with pytest.raises(InputError, match=r"nothing\.h5: there is no such file"):
        mbds_xsim.load_dataset(tmp_path / "nothing.h5")


def test_shards_that_are_missing_are_told(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=3)
    (tmp_path / "1pendulum/mujoco-matched/0000000000.h5").unlink()
    with pytest.raises(InputError, match=r"1 of its 1 shards are missing, first .*0000000000"):
        mbds_xsim.load_dataset(tmp_path / FILE)
    with h5py.File(tmp_path / FILE) as file:  # and no zeros are made up
        assert np.isnan(file["position"][()]).all()
    (tmp_path / FILE).with_suffix("").rename(tmp_path / "elsewhere")
    assert joined_files(tmp_path) == [tmp_path / FILE]


def test_the_package_knows_no_other_names() -> None:
    with pytest.raises(AttributeError, match="no attribute 'load_data'"):
        mbds_xsim.load_data  # noqa: B018


@pytest.mark.parametrize("name", [FILE, "1pendulum/mujoco-matched/0000000000.h5"])
def test_files_that_were_cut_off(name: str, make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=6)
    whole = (tmp_path / name).read_bytes()
    for size in range(0, len(whole), 1024):
        (tmp_path / name).unlink()  # mapped values must not change
        (tmp_path / name).write_bytes(whole[:size])
        with pytest.raises(InputError, match=rf"{Path(name).name} cannot be read as HDF5 \("):
            mbds_xsim.load_dataset(tmp_path / FILE).check()


@pytest.mark.parametrize(
    "text", [b"\x89HDF\r\n", b"OHDR", b"GCOL", b"mujoco-matched/0000000000.h5"]
)
def test_damage_is_told_in_one_line(text: bytes, make: Make, tmp_path: Path) -> None:
    """HDF5 raises several kinds of errors for damage; Python raises those for invalid text."""
    make(tmp_path, trajectories=6)
    whole = (tmp_path / FILE).read_bytes()
    assert text in whole
    (tmp_path / FILE).write_bytes(whole.replace(text, b"\xff" * len(text)))
    with pytest.raises(InputError, match=r"^\S+matched\.h5 cannot be read as HDF5 \(.*\); it is"):
        mbds_xsim.load_dataset(tmp_path / FILE).check()


def test_values_are_held_against_their_checksums(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=6)
    data = mbds_xsim.load_dataset(tmp_path / FILE)
    data.check()
    shard = tmp_path / "1pendulum/mujoco-matched/0000000000.h5"
    with h5py.File(shard, "r+") as file:
        file["velocity"][1, 2] += 1e-6
    data.check(["position"])
    with pytest.raises(InputError, match="no dataset is called 'velocty'; did you mean 'velocity'"):
        data.check(["velocty"])
    with pytest.raises(InputError, match=r"0\.h5: dataset velocity is not what was written; get"):
        data.check(["position", "velocity"])


def test_a_shard_of_another_set_is_not_taken_for_its_own(make: Make, tmp_path: Path) -> None:
    make(tmp_path / "one", trajectories=6)
    make(tmp_path / "two", trajectories=6, seed=1)
    shard = "1pendulum/mujoco-matched/0000000000.h5"
    (tmp_path / "two" / shard).replace(tmp_path / "one" / shard)
    with pytest.raises(InputError, match=r"0\.h5: not the shard that mujoco-matched\.h5 joins"):
        mbds_xsim.load_dataset(tmp_path / "one" / FILE).check()

"""Any layout of HDF5 is read right, or refused in one line, by everything that reads."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

import mbds_xsim
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Silent
from mbds_xsim.dataset import series
from mbds_xsim.dataset.audit import audit_file
from mbds_xsim.dataset.export import export
from mbds_xsim.dataset.foreign import Provenance
from mbds_xsim.dataset.summary import summaries
from mbds_xsim.dataset.verify import recheck, verify

from .conftest import Make
from .repack import ELSEWHERE, LAYOUTS, OTHER_TYPES, repack

FILE = "1pendulum/mujoco-matched.h5"
SHARD = "1pendulum/mujoco-matched/0000000000.h5"
NAMES = ("position", "velocity", "body/orientation", "input/force", "check/figure")


@pytest.fixture
def copy(few: Path, tmp_path: Path) -> Path:
    """A copy whose shard is renamed, so that a repacked one can take its place."""
    folder = Path(shutil.copytree(few, tmp_path / "copy"))
    (folder / SHARD).rename(tmp_path / "old.h5")
    return folder


def _readers(shard: Path, out: Path) -> dict[str, Callable[[], object]]:
    def exported() -> object:
        return export(shard, out, "npz", progress=Silent())

    return {
        "load": lambda: np.asarray(mbds_xsim.load_dataset(shard).position),
        "inspect": lambda: summaries(shard),
        "export": exported,
        "audit": lambda: audit_file(shard, None, Provenance()),
    }


@pytest.mark.parametrize("userblock", [0, 512])
@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_has_the_same_numbers(
    name: str, userblock: int, few: Path, copy: Path, tmp_path: Path
) -> None:
    repack(tmp_path / "old.h5", copy / SHARD, LAYOUTS[name], userblock=userblock)

    was, data = (mbds_xsim.load_dataset(folder / FILE) for folder in (few, copy))

    data.check()
    for each in NAMES:
        assert np.array_equal(np.asarray(data[each]), np.asarray(was[each]), equal_nan=True)
        assert not data[each][0].flags.writeable
    numbers = [0, 7, 30]
    for got, wanted in zip(
        data.windows(6).take(numbers), was.windows(6).take(numbers), strict=True
    ):
        assert np.array_equal(got, wanted)
    assert recheck(copy / SHARD, "shard").problems == []
    for read in _readers(copy / SHARD, tmp_path / "out").values():
        read()


@pytest.mark.parametrize("name", ELSEWHERE)
def test_values_in_other_files_are_refused(name: str, copy: Path, tmp_path: Path) -> None:
    repack(tmp_path / "old.h5", copy / SHARD, ELSEWHERE[name])

    for read in _readers(copy / SHARD, tmp_path / "out").values():
        with pytest.raises(InputError, match="another file; put"):
            read()
    assert "another file" in recheck(copy / SHARD, "shard").problems[0]
    with pytest.raises(InputError, match="another file; put"):
        np.asarray(mbds_xsim.load_dataset(copy / FILE).position)


@pytest.mark.parametrize("name", OTHER_TYPES)
def test_other_types_are_refused(name: str, copy: Path, tmp_path: Path) -> None:
    repack(tmp_path / "old.h5", copy / SHARD, OTHER_TYPES[name])

    with pytest.raises(InputError, match=r"layout: time has the type .*, not <f8"):
        mbds_xsim.load_dataset(copy / SHARD)
    assert recheck(copy / SHARD, "shard").problems
    with pytest.raises(InputError, match=r"0\.h5: position is .*, expected is float32"):
        mbds_xsim.load_dataset(copy / FILE).position[0]


def test_a_virtual_dataset_without_its_file_is_refused(copy: Path, tmp_path: Path) -> None:
    repack(tmp_path / "old.h5", copy / SHARD, LAYOUTS["virtual"])
    (tmp_path / "old.h5").unlink()

    for read in _readers(copy / SHARD, tmp_path / "out").values():
        with pytest.raises(InputError, match=r"reads from .*old\.h5, which is missing"):
            read()


def test_values_that_were_never_written_are_not_made_up(copy: Path, tmp_path: Path) -> None:
    """HDF5 reads them as zeros, which do not match the checksum."""
    repack(
        tmp_path / "old.h5",
        copy / SHARD,
        lambda file, name, old, _: file.create_dataset(name, old.shape, old.dtype),
    )

    with pytest.raises(InputError, match="is not what was written"):
        mbds_xsim.load_dataset(copy / FILE).check()


def test_more_values_than_a_file_can_have_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("position", (10**6, 201, 6, 3), "f8", chunks=True, compression="gzip")

    for read in _readers(tmp_path / "bomb.h5", tmp_path / "out").values():
        with pytest.raises(InputError, match=r"MB claim to unpack to 2\.89e\+04 MB"):
            read()


def test_a_file_that_was_exchanged_is_not_read_as_the_old_one(make: Make, tmp_path: Path) -> None:
    make(tmp_path / "one", trajectories=6)
    make(tmp_path / "two", trajectories=6, seed=1)
    before = mbds_xsim.load_dataset(tmp_path / "one" / FILE)
    first = before.position[0].copy()
    (tmp_path / "two" / SHARD).replace(tmp_path / "one" / SHARD)

    after = mbds_xsim.load_dataset(tmp_path / "one" / FILE)

    assert np.array_equal(before.position[0], first)  # mapped: the old file
    series._values.cache_clear()
    series._bytes_of.cache_clear()  # as if it had had to make room for others
    with pytest.raises(InputError, match="was changed since the data set was opened; open it"):
        before.position[0]
    assert not np.array_equal(after.position[0], first)
    with pytest.raises(InputError, match="was changed since the data set was opened; open it"):
        before.velocity[0]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system without named pipes")
def test_a_pipe_is_refused_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(InputError, match=r"pipe\.h5: this is no file but a folder, a pipe or"):
        verify(tmp_path / "pipe.h5")
    (report,) = verify(tmp_path).files
    assert report.problems[0].endswith("name a file")

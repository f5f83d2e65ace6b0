"""Files are written whole, packed where their name says so, and read back as they were."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import pytest

from mbds_xsim.base import files
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import put, read_file, write_whole
from mbds_xsim.studies.diff.read import read_views


def test_a_packed_result_is_read_back_and_has_the_same_bytes_each_time(tmp_path: Path) -> None:
    paths = [tmp_path / "a.json.gz", tmp_path / "b.json.gz"]
    for path in paths:
        write_whole(path, b'{"figure": 1}')

    assert gzip.decompress(paths[0].read_bytes()) == b'{"figure": 1}'
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert read_file(paths[0]) == b'{"figure": 1}'


@pytest.mark.parametrize("damage", [lambda c: c[:-9], lambda _: b"plain", lambda c: c[:20] + b"x"])
def test_a_damaged_packed_result_is_refused_in_one_line(
    damage: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    path = tmp_path / "a.json.gz"
    path.write_bytes(damage(gzip.compress(b'{"schema": "mbds-xsim/validation/1"}' * 99)))

    with pytest.raises(InputError, match=r"^cannot read .*a\.json\.gz: "):
        read_views(path)


def test_pieces_that_are_put_follow_each_other(tmp_path: Path) -> None:
    put(tmp_path / "data", b"one", memoryview(b" file"), b"")

    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert (tmp_path / "data").read_bytes() == b"one file"


@pytest.mark.parametrize("damage", [b"one fiIe", b"one fil", b"one files", b"one file "])
def test_what_does_not_read_back_is_no_file(
    damage: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_write", lambda path, _: path.write_bytes(damage))

    with pytest.raises(InputError, match="does not read back; check the disk"):
        put(tmp_path / "data", b"one", b" ", b"file")
    assert not list(tmp_path.iterdir())


def test_a_file_in_place_of_the_folder_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "data").touch()

    with pytest.raises(InputError, match=r"^cannot write .*0\.h5: Not a directory; "):
        put(tmp_path / "data" / "mujoco" / "0.h5", b"content")

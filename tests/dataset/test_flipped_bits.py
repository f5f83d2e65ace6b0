"""Every flipped bit that matters in a data file is detected."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mbds_xsim.dataset.verify import recheck

from .conftest import FILE, JOINT, SHARD, TEXTS, Make

_FOUND, _HARMLESS, _MISSED = 0, 1, 2
_CHECKS: dict[str, Callable[[Path], Any]] = {
    SHARD: lambda path: recheck(path, "shard"),
    FILE: lambda path: recheck(path, "joined"),
    JOINT: lambda path: recheck(path, "joint"),
    TEXTS[0]: lambda path: recheck(path, "card"),
    TEXTS[1]: lambda path: recheck(path, "metadata"),
}


def _everything(path: Path) -> dict[str, Any]:
    """Return all that can be read from a file."""
    if path.suffix == ".md":
        return {"text": path.read_bytes()}
    if path.suffix == ".json":
        return dict(json.loads(path.read_bytes()))
    content: dict[str, Any] = {}
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            content[name] = {key: np.asarray(value).tolist() for key, value in item.attrs.items()}
            if isinstance(item, h5py.Dataset):
                content[f"{name} values"] = (str(item.dtype), item.shape, item[()].tobytes())

        visit("/", file)
        file.visititems(visit)
    return content


Flip = tuple[int, int]


def _verdicts(
    path: Path, check: Callable[[Path], Any], whole: dict[str, Any], flips: list[Flip]
) -> list[int]:
    """Judge files with one flipped bit, in a copy of this process, which the damage may end.

    A flip that ends it counts as found; a new copy goes on with the next flip.
    """
    verdicts: list[int] = []
    content = path.read_bytes()
    while len(verdicts) < len(flips):
        read_end, write_end = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                for place, bit in flips[len(verdicts) :]:
                    damaged = bytearray(content)
                    damaged[place] ^= 1 << bit
                    path.write_bytes(damaged)
                    os.write(write_end, bytes([_verdict(path, check, whole)]))
                os._exit(0)
            finally:
                os._exit(1)
        os.close(write_end)
        with open(read_end, "rb") as answers:
            verdicts.extend(answers.read())
        if os.waitpid(child, 0)[1]:
            verdicts.append(_FOUND)
    path.write_bytes(content)
    return verdicts


def _verdict(path: Path, check: Callable[[Path], Any], whole: dict[str, Any]) -> int:
    try:
        if check(path).problems:
            return _FOUND
        return _HARMLESS if _everything(path) == whole else _MISSED
    except BaseException:
        return _FOUND


def _flipped(
    path: Path, check: Callable[[Path], Any], count: int, seed: int
) -> dict[int, list[int]]:
    whole, size = _everything(path), path.stat().st_size
    rng = np.random.default_rng(seed)
    flips = [(int(place), int(rng.integers(8))) for place in rng.integers(size, size=count)]
    places: dict[int, list[int]] = {_FOUND: [], _HARMLESS: [], _MISSED: []}
    for (place, _), verdict in zip(flips, _verdicts(path, check, whole, flips), strict=True):
        places[verdict].append(place)
    return places


@pytest.mark.parametrize("name", list(_CHECKS))
def test_flipped_bits_are_found_or_harmless(name: str, copy: Path) -> None:
    places = _flipped(copy / name, _CHECKS[name], 20, 1)
    assert places[_MISSED] == []
    assert len(places[_FOUND]) >= 2


@pytest.fixture(scope="module")
def large(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of 300 trajectories, to be copied."""
    folder = tmp_path_factory.mktemp("large")
    make(folder, trajectories=300)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "at_least"),
    [(SHARD, 170), (FILE, 30), (JOINT, 30), (TEXTS[0], 200), (TEXTS[1], 140)],
)
def test_200_flipped_bits(name: str, at_least: int, large: Path, tmp_path: Path) -> None:
    """Bits are flipped in each kind of file; in shards most bytes are numbers."""
    shutil.copytree(large, tmp_path, dirs_exist_ok=True)
    places = _flipped(tmp_path / name, _CHECKS[name], 200, 2)
    assert places[_MISSED] == []
    assert len(places[_FOUND]) >= at_least

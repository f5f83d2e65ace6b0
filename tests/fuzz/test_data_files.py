"""Campaigns: data files and foreign files of trajectories with anything in them."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from mbds_xsim.base.isolate import Silent
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from tests.fuzz.campaign import fuzz, refused, run_command

Folder = pytest.TempPathFactory

_VALUES: Any = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20),
)


@functools.cache
def _sound(folder: Path) -> bytes:
    """A data file of six swings."""
    scene = msgspec.structs.replace(load_scene("1pendulum"), clock=Clock(steps=6))
    choice = Choice.parse(engines="mujoco")
    generate(Request((scene,), choice, 6, folder), workers=0, progress=Silent())
    path = next(folder.rglob("0*.h5"))
    return path.read_bytes()


@st.composite
def _damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Draw the bytes of a file, some overwritten, or its end cut off."""
    changed = bytearray(whole[: draw(st.one_of(st.just(len(whole)), st.integers(0, len(whole))))])
    for place in draw(st.lists(st.integers(0, max(0, len(changed) - 1)), max_size=8)):
        changed[place : place + 1] = bytes([draw(st.integers(0, 255))])
    return bytes(changed)


@st.composite
def _rewritten(draw: st.DrawFn, whole: bytes) -> bytes:
    """Draw a sound HDF5 file in which an attribute or a dataset is changed or gone."""
    file = io.BytesIO(whole)
    with h5py.File(file, "r+") as data:
        names: list[str] = []
        data.visit(names.append)
        name = draw(st.sampled_from(sorted(names)))
        key = draw(st.sampled_from(sorted(data.attrs)))
        change: Callable[[], None] = draw(
            st.sampled_from(
                [
                    lambda: data.__delitem__(name),
                    lambda: data.attrs.__delitem__(key),
                    lambda: data.attrs.__setitem__(key, draw(_VALUES)),
                    lambda: _replaced(data, name, draw(_VALUES)),
                    lambda: _replaced(data, name, np.zeros(draw(st.integers(0, 9)))),
                ]
            )
        )
        change()
    return file.getvalue()


def _replaced(file: Any, name: str, value: Any) -> None:
    del file[name]
    file[name] = value


@pytest.mark.slow
@fuzz("hdf5", drawn=st.data(), way=st.sampled_from([_damaged, _rewritten]))
def test_no_data_file_makes_more_than_a_line(
    tmp_path_factory: Folder, drawn: st.DataObject, way: Any
) -> None:
    folder = tmp_path_factory.getbasetemp() / "fuzzed"
    path = folder / "fuzzed.h5"
    whole = _sound(folder / "sound")
    path.write_bytes(drawn.draw(way(whole)))

    def used() -> None:
        data = load_dataset(path)
        for name in ("position", "velocity", "state/orientation"):
            np.asarray(data[name])
        data.check()

    line = refused(used)
    assert "\n" not in line
    run_command("inspect", path)


def _arrays() -> dict[str, Any]:
    count, frames = 2, 5
    fall = -9.81 / 2 * (0.02 * np.arange(frames)) ** 2
    place = np.zeros((count, frames, 1, 3))
    place[..., 0, 2] = 2.0 + fall
    return {"position": place, "velocity": np.gradient(place, 0.02, axis=1)}


@functools.cache
def _npz() -> bytes:
    file = io.BytesIO()
    np.savez(file, **_arrays())
    return file.getvalue()


@pytest.mark.slow
@fuzz("npz", drawn=st.data(), foreign=st.booleans())
def test_no_packed_file_makes_more_than_a_line(
    tmp_path_factory: Folder, drawn: st.DataObject, foreign: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.npz"
    if foreign:
        arrays = _arrays()
        arrays[drawn.draw(st.sampled_from(["position", "velocity", "orientation", "x"]))] = (
            drawn.draw(st.one_of(_VALUES.map(np.asarray), st.just(np.zeros((0, 3)))))
        )
        np.savez(path, **arrays)
    else:
        path.write_bytes(drawn.draw(_damaged(_npz())))
    run_command("audit", path, "--scene", "balldrop", "--index", "0-1")


@pytest.mark.slow
@fuzz("csv", drawn=st.data())
def test_no_table_makes_more_than_a_line(tmp_path_factory: Folder, drawn: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.csv"
    head = b"trajectory,frame,body,position_x,position_y,position_z\n"
    rows = b"".join(b"0,%d,disc,0.0,0.0,1.0\n" % frame for frame in range(5))
    path.write_bytes(drawn.draw(_damaged(head + rows)))
    run_command("audit", path, "--scene", "balldrop", "--index", "0")

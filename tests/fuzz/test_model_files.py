"""Campaign: files of trained models with anything in them."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import strategies as st

from tests.fuzz.campaign import fuzz, refused, run_command

torch = pytest.importorskip("torch")

from mbds_xsim.learn.model import model_names  # noqa: E402
from mbds_xsim.learn.model_file import read_model  # noqa: E402
from mbds_xsim.learn.train import read_identity  # noqa: E402
from mbds_xsim.learn.trained import trained_in  # noqa: E402
from tests.learn.hostile import model_file, with_pickle  # noqa: E402

_NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 3, 10**3, 10**4, 10**6, 2**31, 10**18, 10**30, 1e308, 0.5]),
    st.integers(),
    st.floats(),
)
_ARRAYS = st.sampled_from(
    [
        torch.zeros(0),
        torch.full((3,), torch.nan),
        torch.zeros(1).expand(10**12),
        torch.zeros(3, dtype=torch.int64),
        torch.eye(2).to_sparse(),
        torch.zeros((1,) * 60),
    ]
)
_VALUES = st.one_of(
    st.none(), st.text(max_size=40), _NUMBERS, _ARRAYS, st.lists(_NUMBERS, max_size=3),
    st.dictionaries(st.text(max_size=3), st.text(max_size=3), max_size=2),
    st.sampled_from(model_names()),
)  # fmt: skip


@st.composite
def _bytes_changed(draw: st.DrawFn, path: Path) -> None:
    content = bytearray(path.read_bytes())
    for place in draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] = draw(st.integers(0, 255))
    first = draw(st.sampled_from([0, 0, 0, 1, 4]))
    last = draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path.write_bytes(content[first:last])


@st.composite
def _pickle_changed(draw: st.DrawFn, path: Path) -> None:
    """Change bytes of the pickle, which the archive's checksums do not reveal."""
    most = 10**5

    def change(content: bytes) -> bytes:
        changed = bytearray(content)
        for place in draw(st.lists(st.integers(0, most), min_size=1, max_size=3)):
            changed[place % len(changed)] = draw(st.integers(0, 255))
        return bytes(changed)

    with_pickle(path, change)


@st.composite
def _value_changed(draw: st.DrawFn, path: Path) -> None:
    whole: dict[str, Any] = torch.load(path, weights_only=True)
    holder: dict[Any, Any] = whole
    inner = draw(st.sampled_from(["", "statistics", "parameters", "facts", "settings"]))
    if inner == "settings":
        holder = msgspec.json.decode(whole["settings"])
    elif inner:
        holder = whole[inner]
    key = draw(st.sampled_from(sorted(holder)))
    if draw(st.booleans()):
        holder[key] = draw(_VALUES)
    else:
        del holder[key]
    if inner == "settings":
        try:
            whole["settings"] = msgspec.json.encode(holder).decode()
        except (TypeError, msgspec.MsgspecError):
            whole["settings"] = str(holder)
    torch.save(whole, path)


@st.composite
def _scene_changed(draw: st.DrawFn, path: Path) -> None:
    whole: dict[str, Any] = torch.load(path, weights_only=True)
    text: str = whole["scene"]
    lines = text.split("\n")
    place = draw(st.integers(0, len(lines) - 1))
    key, joined, _ = lines[place].partition("=")
    lines[place] = f"{key}={draw(_NUMBERS)}" if joined else draw(st.text(max_size=20))
    whole["scene"] = "\n".join(lines)
    torch.save(whole, path)


_WAYS = (_bytes_changed, _pickle_changed, _value_changed, _scene_changed)


@functools.cache
def _sound(folder: Path, name: str) -> bytes:
    path = folder / "sound.pt"
    model_file(path, name)
    return path.read_bytes()


@fuzz(
    "model",
    drawn=st.data(),
    model=st.sampled_from(["gns", "sgnn", "hgnn", "lgnn"]),
    way=st.sampled_from(_WAYS),
)
def test_no_file_of_a_model_makes_more_than_a_line(
    tmp_path_factory: pytest.TempPathFactory, drawn: st.DataObject, model: str, way: Any
) -> None:
    folder = tmp_path_factory.getbasetemp()
    path = folder / "gns" / "mujoco-s0.pt"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(_sound(folder, model))
    drawn.draw(way(path))
    line = refused(lambda: read_model(path))
    assert refused(lambda: read_identity(path))  # it is no checkpoint
    again = refused(lambda: trained_in([path]))
    assert "\n" not in line + again
    if line:
        ended = run_command("tradeoff", "2pendulum", "--models", path)
        assert ended.code == 2
        assert path.name in ended.err

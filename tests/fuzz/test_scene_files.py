"""Campaign: scene files with anything in them, read, shown and, where accepted, solved."""

from __future__ import annotations

import copy
import functools
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from hypothesis import strategies as st

from benchmarks.four_bars import four_bars
from mbds_xsim.reference import solve
from mbds_xsim.scene.file import read_scene, write_scene
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import load_scene
from tests.fuzz.campaign import fuzz, refused, run_command
from tests.tables import at, places

_NUMBERS = st.one_of(
    st.sampled_from((0, -1, 1, 0.1, 1e7, 1e15, 1e16, 1e300, -1e160, 2**62, 10**30)),
    st.sampled_from((1e-9, 1e-30, 1e-200, 5e-324, math.nan, math.inf, -math.inf)),
    st.floats(),
    st.integers(-(10**6), 10**6),
)
_TEXTS = st.one_of(
    st.text(max_size=8),
    st.sampled_from(["\x00", "\x1b[31m", "[/x]", "a" * 10**4, "world", "../up", "\u202e", "%s"]),
)
_VALUES = st.one_of(
    _NUMBERS,
    _TEXTS,
    st.booleans(),
    st.lists(_NUMBERS, max_size=4),
    st.lists(st.lists(_NUMBERS, max_size=3), max_size=3),
    st.dictionaries(st.text(max_size=4), _NUMBERS, max_size=3),
    st.integers(1, 60).map(lambda depth: _nested(depth)),
)
_NUMBER_OR_OTHER = st.one_of(_NUMBERS, _VALUES)


@functools.cache
def _sound(name: str) -> str:
    scene = four_bars(1, 0.1) if name == "four_bars" else load_scene(name)
    return write_scene(scene)


_SCENES = ("four_bars", "2pendulum", "1ladder", "andrews", "workbench", "balldrop", "particlecar")


def _nested(depth: int) -> Any:
    return [_nested(depth - 1)] if depth else 0


@st.composite
def changed(draw: st.DrawFn) -> dict[str, Any]:
    """Draw a sound scene with up to four of its places changed, left out or there twice."""
    data: dict[str, Any] = copy.deepcopy(tomllib.loads(_sound(draw(st.sampled_from(_SCENES)))))
    data["clock"] = {"frame": 0.02, "steps": 3}
    for _ in range(draw(st.integers(1, 4))):
        *above, key = draw(st.sampled_from(places(data)[1:]))
        container = at(data, above)
        match draw(st.sampled_from(["set", "set", "set", "drop", "twice", "add", "swap"])):
            case "set":
                container[key] = draw(_NUMBER_OR_OTHER)
            case "drop":
                del container[key]
            case "twice" if isinstance(container, list):
                container.append(copy.deepcopy(container[key]))
            case "add" if isinstance(container, dict):
                container[draw(_TEXTS)] = draw(_VALUES)
            case "swap":
                other = draw(st.sampled_from(places(data)[1:]))
                container[key] = copy.deepcopy(at(data, other))
            case _:
                continue
    return data


def _write(data: dict[str, Any], path: Path) -> None:
    path.write_bytes(tomli_w.dumps(data).encode("utf-8", "surrogatepass"))


@fuzz("scene", data=changed())
def test_a_changed_scene_is_read_or_refused(data: dict[str, Any], tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    _write(data, path)

    text = refused(lambda: read_scene(path))
    ended = run_command("show", path)

    assert "\n" not in text
    assert bool(text) == (ended.code == 2), (text, ended)
    if not text:
        scene = read_scene(path)
        if scene.clock.steps <= 3:
            batch = draw_batch(scene, [0])
            with np.errstate(all="ignore"):
                refused(lambda: solve(scene, batch, rtol=1e-6, cache=False))

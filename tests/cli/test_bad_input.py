"""Bad words and bad files give one clear line, exit code 2, and no written file."""

from __future__ import annotations

import math
import os
import random
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.file import read_scene
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from tests.command_line import CommandLine
from tests.tables import at, places

Table = dict[str, Any]

_WORDS: dict[str, tuple[str, list[str]]] = {
    "no such command": ("simulate", ["No such command 'simulate'", "mbds-xsim --help"]),
    "no such option": (
        "validate 2pendulum --engine mujoco",
        ["No such option: --engine", "--engines", "mbds-xsim validate --help"],
    ),
    "no scene": ("validate", ["Missing argument 'SCENE'", "mbds-xsim validate --help"]),
    "two scenes": ("show 2pendulum 3pendulum", ["unexpected extra argument", "3pendulum"]),
    "not a number": ("validate 2pendulum --seed one", ["--seed", "valid integer"]),
    "option without a value": ("scenes --json", ["--json", "requires an argument"]),
    "negative trajectories": ("validate 2pendulum --trajectories -1", ["--trajectories", "to 1"]),
    "trajectories for years": (
        "validate 2pendulum --trajectories 9999999999",
        ["--trajectories", "to 10000"],
    ),
    "no workers": ("validate 2pendulum --workers 0", ["--workers", "to 1"]),
    "tradeoff without an end": ("tradeoff 2pendulum --limit inf", ["--limit", "to 10000000"]),
    "stability without an end": ("stability spin --limit inf", ["--limit", "to 10000000"]),
    "match without an end": ("match 2pendulum --limit inf", ["--limit", "to 10000000"]),
    "validate without an end": ("validate 2pendulum --limit inf", ["--limit", "to 10000000"]),
    "negative seed": ("validate 2pendulum --seed -1", ["--seed", "to 0; got '-1'"]),
    "unknown scene": ("validate teapot", ["'teapot'", "3ladder", "Npendulum", ".toml"]),
    "scene of size 0": ("show 0ladder", ["'0ladder'", "Nladder"]),
    "scene of no size that ends": ("show " + "9" * 5000 + "ladder", ["no scene", "Nladder"]),
    "unknown engine": (
        "validate 2pendulum --engines mujoco,ode",
        ["'ode'", "dart, drake, exudyn, mujoco"],
    ),
    "no engine named": ("validate 2pendulum --engines=", ["--engines: got an empty text"]),
    "output without a name": ("validate 2pendulum --json ", ["--json: got an empty text"]),
    "folder without a name": ("generate 2pendulum --out=", ["--out: got an empty text"]),
    "scene without a name": ("validate ", ["an argument: got an empty text"]),
    "start of no number that is": (
        "show 2pendulum --native mujoco --start " + "9" * 20,
        ["--start", "to 1000000000000000"],
    ),
    "unknown engine to show": (
        "show 2pendulum --native ode",
        ["'ode'", "dart, drake, exudyn, mujoco"],
    ),
    "unknown method": (
        "validate 2pendulum --engines mujoco --method RK5",
        ["no method of mujoco is called 'RK5'", "RK4"],
    ),
    "a method for all": ("validate 2pendulum --method RK4", ["--method RK4", "--engines"]),
    "a method that cannot": (
        "validate 2pendulum --engines exudyn --method RK44",
        ["exudyn RK44 cannot do ball joint", "use --method trapezoidal"],
    ),
    "unknown profile": (
        "validate 2pendulum --settings fast",
        ["no settings profile is called 'fast'", "matched, native"],
    ),
    "a file of settings for a map": (
        "stability throw --settings found.toml",
        ["--settings found.toml", "of one scene", "matched, native"],
    ),
    "unknown profile to show": (
        "show 2pendulum --native mujoco --settings fast",
        ["no settings profile is called 'fast'", "matched, native"],
    ),
    "settings that nothing is given at": (
        "show 2pendulum --settings none.toml",
        ["--settings: got none.toml", "add --native"],
    ),
    "two engines to show": (
        "show 2pendulum --native mujoco,dart",
        ["one engine's model", "got --native mujoco,dart"],
    ),
    "two profiles to show": (
        "show 2pendulum --native mujoco --settings native,matched",
        ["one of its settings", "--settings native,matched"],
    ),
    "step that does not divide the frame": (
        "validate 2pendulum --engines mujoco --step 0.003",
        ["step: got 0.003 s", "0.02 s divided by a whole number"],
    ),
    "step of 0": ("validate 2pendulum --engines mujoco --step 0", ["step: got 0.0 s"]),
    "step that is no number": ("validate 2pendulum --engines mujoco --step nan", ["got nan s"]),
    "negative step": ("validate 2pendulum --engines mujoco --step=-0.01", ["got -0.01 s"]),
    "file that is not there": ("validate none.toml", ["none.toml", "No such file"]),
    "folder for a file": ("show ./", ["cannot be read (Is a directory)", "mbds-xsim scenes"]),
    "folder as output": ("validate 2pendulum --json .", ["--json", "it is a folder"]),
    "file for a folder": ("scenes --json scene.toml/x.json", ["--json", "scene.toml", "folder"]),
    "no place to write to": ("validate 2pendulum --html /proc/x", ["--html: cannot write /proc/x"]),
    "no place for figures": ("contact --figures /proc/x", ["--figures: cannot write /proc/x"]),
    "a page to standard output": ("validate 2pendulum --html -", ["--html: got -", "--json alone"]),
    "one file for two": ("validate 2pendulum --json x --html x", ["--json and --html both name x"]),
    "one file for two in other words": (
        "validate 2pendulum --json x --html sub/../x",
        ["--json and --html both name sub/../x; name two places"],
    ),
    "a folder of data as a file in other words": (
        "generate 2pendulum --out sub/../x --json ./x",
        ["--out and --json both name x; name two places"],
    ),
    "one file for two of three": (
        "validate 2pendulum --json x --html x --markdown y",
        ["mbds-xsim: --json and --html both name x; name two places"],
    ),
    "a folder of data as a file": (
        "generate 2pendulum --out x --json x",
        ["mbds-xsim: --out and --json both name x; name two places"],
    ),
    "a picture of another kind": (
        "show 2pendulum --png x.jpg",
        ["--png: got x.jpg, but pictures are PNG; name it x.png"],
    ),
    "results as data": ("validate 2pendulum --json x.h5", ["got x.h5, but", "name it x.json"]),
    "rollouts of another kind": ("shift a b --rollouts x.svg", ["got x.svg", "name it x.png"]),
    "a scene as its own picture": (
        "show scene.toml --png scene.toml",
        ["--png: the command reads scene.toml; name another"],
    ),
    "settings as results": (
        "validate 2pendulum --settings=native,scene.toml --json=./scene.toml",
        ["--json: the command reads scene.toml; name another file"],
    ),
}


@pytest.mark.parametrize(("line", "expected"), _WORDS.values(), ids=_WORDS.keys())
def test_wrong_words_get_one_line(
    line: str, expected: list[str], run: CommandLine, here: Path
) -> None:
    (here / "scene.toml").write_text("")

    ended = run(*line.split(" "))

    _assert_one_line(ended, expected)
    assert [path.name for path in here.iterdir()] == ["scene.toml"]
    assert (here / "scene.toml").read_text() == ""


@pytest.mark.parametrize(
    "line",
    [
        "train data --png data/a.h5",
        "shift . data --json=./data/a.pt",
        "tradeoff 2pendulum --models d*/[!b].pt --png data/a.pt",
    ],
)
def test_no_output_replaces_data_or_models_of_a_folder(
    line: str, run: CommandLine, here: Path
) -> None:
    files = [here / "data" / name for name in ("a.h5", "a.pt")]
    files[0].parent.mkdir()
    for file in files:
        file.write_text("kept")

    _assert_one_line(run(*line.split(" ")), ["the command reads data/a.", "name another file"])

    assert [file.read_text() for file in files] == ["kept", "kept"]


@pytest.mark.parametrize(
    "line",
    [
        "show pipe.toml",
        "validate 2pendulum --settings pipe.toml",
        "diff pipe.json pipe.json",
        "tradeoff 2pendulum --onto pipe.json --models pipe.json",
    ],
)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system without named pipes")
def test_a_named_pipe_is_not_waited_for(line: str, run: CommandLine, here: Path) -> None:
    for name in ("pipe.toml", "pipe.json"):
        os.mkfifo(here / name)

    assert "not a regular file" in run(*line.split()).refusal


def _door() -> Table:
    """Make a sound scene: a leaf on a hinge, a knob on it."""
    hinge = {"kind": "hinge", "axis": [0.0, 0.0, 1.0]}
    return {
        "name": "door",
        "length": 1.0,
        "noise": 0.1,
        "gravity": [0.0, 0.0, -9.81],
        "clock": {"frame": 0.02, "steps": 10},
        "bodies": [
            {"name": "leaf", "inertia": {"mass": 2.0, "moments": [0.3, 0.2, 0.4]}},
            {"name": "knob", "particles": [{"position": [0.5, 0.0, 0.0], "mass": 1.0}]},
        ],
        "joints": [
            hinge
            | {"name": "frame", "parent": "world", "child": "leaf", "anchor": [-0.5, 0.0, 0.0]}
            | {"rate": 1.0, "start": 0.1},
            hinge | {"name": "pin", "parent": "leaf", "child": "knob", "anchor": [0.5, 0.0, 0.0]},
        ],
        "springs": [
            {"name": "closer", "bodies": ["world", "leaf"], "points": [[0, 1, 0], [0, 0, 0]]}
            | {"stiffness": 3.0}
        ],
        "sampling": [{"kind": "hinge_rate", "joints": ["pin"], "rate": [-1.0, 1.0]}],
    }


def _set(table: Table, *path: Any, to: object) -> Table:
    at(table, path[:-1])[path[-1]] = to
    return table


def _unclosable() -> list[Table]:
    ends = {"bodies": ["world", "leaf"], "points": [[-0.5, 0.0, 1.0], [0.5, 0.0, 0.0]]}
    return [ends | {"name": "stay", "length": 9.0}]


_FILES: dict[str, tuple[Table | bytes, list[str]]] = {
    "missing body": (_set(_door(), "bodies", to=[]), ["bodies: got none", "at least one"]),
    "joint to nowhere": (
        _set(_door(), "joints", 1, "child", to="handle"),
        ["joints[1].child: no body is called 'handle'", "knob, leaf, world"],
    ),
    "two bodies of one name": (
        _set(_door(), "bodies", 1, "name", to="leaf"),
        ["bodies: got 'leaf' twice", "each name is allowed once"],
    ),
    "name of two lines": (
        _set(_door(), "name", to="front\ndoor"),
        ["name: got 'front\\ndoor'", "a line of text"],
    ),
    "negative mass": (
        _set(_door(), "bodies", 0, "inertia", "mass", to=-2.0),
        ["bodies[0].inertia.mass (in 'leaf'): got -2.0", "above 0"],
    ),
    "non-physical inertia": (
        _set(_door(), "bodies", 0, "inertia", "moments", to=[1.0, 1.0, 3.0]),
        ["bodies[0].inertia (in 'leaf')", "principal moments 1, 1, 3", "sum of the other two"],
    ),
    "velocities that break a joint": (
        _set(_door(), "bodies", 0, "velocity", to=[1.0, 1.0, 0.0]),
        ["initial velocities contradict each other", "frame"],
    ),
    "loop that cannot be closed": (
        _set(_door(), "distance_links", to=_unclosable()),
        ["distance_links['stay'] cannot be closed", "off by"],
    ),
    "unknown key": (
        _set(_door(), "bodies", 0, "colour", to="red"),
        ["bodies[0] (in 'leaf'): unknown key 'colour'", "allowed are name, particles"],
    ),
    "NaN": (
        _set(_door(), "joints", 0, "anchor", to=[0.0, math.nan, 0.0]),
        ["joints[0].anchor (in 'frame'): got [0.0, nan, 0.0]", "finite"],
    ),
    "no integer of this size": (_set(_door(), "length", to=10**400), ["length"]),
    "more steps than memory": (_set(_door(), "clock", "steps", to=10**15), ["steps"]),
    "TOML syntax": (b"name = 'door\n", ["this is not TOML", "at end of document"]),
    "no end of brackets": (b"name = " + b"[" * 100_000, ["this is not TOML"]),
    "number beyond reading": (b"length = " + b"9" * 5000, ["this is not TOML"]),
    "empty": (b"", ["the key 'name' is missing"]),
    "binary": (bytes(random.Random(0).randbytes(4096)), ["got byte", "UTF-8"]),
    "zeros": (bytes(512), ["this is not TOML"]),
}


@pytest.mark.parametrize(("content", "expected"), _FILES.values(), ids=_FILES.keys())
def test_a_wrong_scene_file_gets_one_line_that_names_it(
    content: Table | bytes, expected: list[str], run: CommandLine, here: Path
) -> None:
    text = content if isinstance(content, bytes) else tomli_w.dumps(content).encode()
    (here / "door.toml").write_bytes(text)

    ended = run("validate", "door.toml", "--json", "out.json", "--html", "out.html")

    _assert_one_line(ended, ["door.toml: ", *expected])
    assert [path.name for path in here.iterdir()] == ["door.toml"]


_ODD: tuple[object, ...] = (
    *(-1, 0, 1, 1e300, -1e300, 5e-324, 1e12, math.nan, math.inf, 2**70, 10**400, True),
    *("", "leaf", "world", "\x00", [], {}, [0, 0, 0], [1e300, 0, 0], ["leaf"], ["pin"], [[]]),
    {"a": 1},
)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("odd", _ODD, ids=lambda odd: repr(odd)[:12])
def test_no_value_anywhere_in_a_file_gets_past_the_one_line(odd: object, tmp_path: Path) -> None:
    path = tmp_path / "odd.toml"
    for place in places(_door())[1:]:
        path.write_text(tomli_w.dumps(_set(_door(), *place, to=odd)))

        scene = _read_or_told(path)

        if scene is not None:
            with np.errstate(all="ignore"):
                batch = draw_batch(scene, range(3))
            assert np.isfinite(batch.position).all(), place
            assert np.isfinite(batch.velocity).all(), place


def _read_or_told(path: Path) -> Scene | None:
    try:
        return read_scene(path)
    except SceneError as error:
        text = str(error)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert "nan" not in text or "nan" in path.read_text()
    return None


def test_one_file_for_two_through_a_link_is_refused(run: CommandLine, here: Path) -> None:
    (here / "link").symlink_to("x")

    ended = run("validate", "2pendulum", "--json", "x", "--html", "link")

    _assert_one_line(ended, ["--json and --html both name link; name two places"])


def test_a_missing_engine_is_named_with_the_line_that_installs_it(
    run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for module in [name for name in sys.modules if re.match(r"mbds_xsim_adapters\._?mujoco", name)]:
        monkeypatch.delitem(sys.modules, module)

    _assert_one_line(
        run("validate", "2pendulum", "--engines", "mujoco"),
        ["the engine mujoco is not installed", "pip install 'mbds-xsim[mujoco]'"],
    )
    listed = run("engines")
    assert listed.code == 0
    assert "not installed" in listed.out


def test_the_installed_program_says_it_too(program: CommandLine, here: Path) -> None:
    (here / "dark.toml").write_bytes(b"name = '\xff'")

    _assert_one_line(program("validate", "dark.toml"), ["dark.toml: got byte 0xff at 8", "UTF-8"])
    _assert_one_line(program("validate", b"\xff.toml"), ["\\udcff.toml", "No such file"])
    _assert_one_line(program("--frobnicate"), ["No such option: --frobnicate"])


def _assert_one_line(ended: Any, expected: list[str]) -> None:
    assert ended.code == 2, ended
    assert ended.out == ""
    assert ended.err.startswith("mbds-xsim: ")
    assert ended.err.count("\n") == 1, ended.err
    for words in expected:
        assert words in ended.err

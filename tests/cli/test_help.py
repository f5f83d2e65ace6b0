"""The command line explains itself: chapters, sentences, suggested names, shells."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Any, get_args

import pytest

from mbds_xsim.base.text import counted
from mbds_xsim.commands.shared import Chapter, app
from tests.command_line import CommandLine

_NAMES = sorted(command.name or command.callback.__name__ for command in app.registered_commands)  # type: ignore[union-attr]


def test_every_command_stands_in_a_chapter_with_its_whole_sentence(run: CommandLine) -> None:
    text = run("--help").out
    chapters = re.split(r"^(\w+):$", text, flags=re.MULTILINE)
    listed = re.findall(r"^  ([\w-]+)  +\S", "".join(chapters[4::2]), flags=re.MULTILINE)

    assert chapters[3::2] == [chapter.capitalize() for chapter in get_args(Chapter)]
    assert sorted(listed) == _NAMES
    assert "..." not in text.split("Check:")[1]


@pytest.mark.parametrize("name", _NAMES)
def test_no_help_speaks_of_types_of_python(run: CommandLine, name: str) -> None:
    text = run(name, "--help").out

    assert not re.search(r"<(list|str|int|float|path|Path)|\[\[|\{|range>", text), text


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["valdate"], "'validate'"),
        (["show", "3lader"], "did you mean '3ladder'?"),
        (["validate", "2pendulum", "--engines", "mujco"], "did you mean 'mujoco'?"),
        (
            ["validate", "2pendulum", "--engines", "mujoco", "--method", "RK5"],
            "did you mean 'RK4'?",
        ),
        (["validate", "2pendulum", "--engines", "MuJoCo"], "did you mean 'mujoco'?"),
        (["validate", "2pendulum", "--settings", "my.json"], "my.json: there is no such file"),
        (["stability", "mass-rato"], "did you mean 'mass-ratio'?"),
    ],
)
def test_a_slip_is_told_what_was_meant(run: CommandLine, words: list[str], meant: str) -> None:
    ended = run(*words)

    assert ended.code == 2
    assert meant in ended.err
    assert ended.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("mbds-xsim sta", ["stability"]),
        ("mbds-xsim validate 3", ["3ladder"]),
        ("mbds-xsim ablate 3ladder sim", ["simplecubli"]),
        ("mbds-xsim validate 3ladder --engines mujoco,d", ["mujoco,dart", "mujoco,drake"]),
        ("mbds-xsim show 3ladder --tom", ["--toml"]),
    ],
)
def test_a_shell_completes_commands_scenes_and_engines(
    program: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, words: str, offered: list[str]
) -> None:
    for key, value in {
        "_MBDS_XSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(words.count(" ")),
    }.items():
        monkeypatch.setitem(os.environ, key, value)

    assert program().out.split() == offered


def test_one_thing_is_no_things() -> None:
    assert [counted(n, "core") for n in (0, 1, 2, None)] == [
        "0 cores",
        "1 core",
        "2 cores",
        "? cores",
    ]
    assert counted(15_000, "trajectory") == "15 000 trajectories"
    assert counted(1, "process") + counted(2, "process") == "1 process2 processes"

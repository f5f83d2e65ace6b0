"""The file that `match --out` writes is what `--settings` of every command reads."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest

from mbds_xsim.base import isolate
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice, Contender, read_matched
from mbds_xsim.studies.match import search as match
from tests.command_line import CommandLine

_SCENE = """\
name = "rod"
length = 1.0
clock = { frame = 0.02, steps = 5 }
bodies = [{ name = "rod", position = [0.5, 0, 0], inertia = { mass = 1, moments = [1, 1, 1] } }]

[[joints]]
name = "pin"
kind = "hinge"
parent = "world"
child = "rod"
anchor = [0, 0, 0]
axis = [0, 1, 0]
"""
_COMMANDS = {
    "validate": ("validate", "rod.toml"),
    "show": ("show", "rod.toml", "--native", "mujoco"),
    "generate": ("generate", "rod.toml", "--out", "data", "--trajectories", "1"),
    "plan": ("plan", "rod.toml"),
    "ablate": ("ablate", "rod.toml"),
}


@pytest.fixture
def written(here: Path, run: CommandLine, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of settings for a scene of a user's own, found by `match`."""

    def run_here(tasks: list[isolate.Task], **options: object) -> list[object]:
        return isolate.run_tasks(tasks, **(options | {"workers": 0}))  # type: ignore[arg-type]

    monkeypatch.setattr(match, "run_tasks", run_here)
    (here / "rod.toml").write_text(_SCENE)
    options = ("--trajectories", "1", "--held-out", "1", "--engines", "mujoco")
    ended = run("match", "rod.toml", "--out", "found.toml", *options)
    assert ended.code == 0, ended.err
    return here / "found.toml"


def test_every_command_takes_the_settings_that_match_has_written(
    written: Path, run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    (found,) = read_matched(written).values()
    seen: list[tuple[Scene, list[Contender]]] = []
    settle = Choice.contenders

    def ended(choice: Choice, scene: Scene) -> NoReturn:
        seen.append((scene, settle(choice, scene)[0]))
        raise InputError("enough")

    monkeypatch.setattr(Choice, "contenders", ended)
    for name, words in _COMMANDS.items():
        seen.clear()
        assert run(*words, "--settings", "found.toml").err == "mbds-xsim: enough\n", name
        ((scene, (contender,)),) = seen
        assert contender.engine == "mujoco"
        assert contender.settings == found.settings(scene)


def test_studies_with_scenes_of_their_own_take_no_file(here: Path, run: CommandLine) -> None:
    (here / "found.toml").write_text('[mujoco]\nmethod = "RK4"\nsteps_per_frame = 1\n')
    for words in (("contact",), ("stability", "pace")):
        ended = run(*words, "--settings", "found.toml")
        assert ended.code == 2
        assert "matched" in ended.err
        assert "native" in ended.err

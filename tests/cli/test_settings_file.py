"""The file that `match --out` writes is what `--settings` of every command reads."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest

from mbds_xsim.base import isolate
from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.read import load_dataset
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice, Contender, read_settings
from mbds_xsim.simulate.registry import load_scene
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


def test_the_file_says_on_how_many_starts_they_were_tried(written: Path) -> None:
    assert "the scene on the only start, with which the search was made. F" in written.read_text()


def test_every_command_takes_the_settings_that_match_has_written(
    written: Path, run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    (matched,) = read_settings(written)[1].values()
    choices: list[tuple[Scene, list[Contender]]] = []
    settle = Choice.contenders

    def noted(choice: Choice, scene: Scene) -> NoReturn:
        choices.append((scene, settle(choice, scene)[0]))
        raise InputError("enough")

    monkeypatch.setattr(Choice, "contenders", noted)
    for name, words in _COMMANDS.items():
        choices.clear()
        assert run(*words, "--settings", "found.toml").err == "mbds-xsim: enough\n", name
        ((scene, (contender,)),) = choices
        assert contender.engine == "mujoco"
        assert contender.settings == matched.settings(scene)


def test_studies_with_scenes_of_their_own_take_no_file(here: Path, run: CommandLine) -> None:
    (here / "found.toml").write_text('[mujoco]\nmethod = "RK4"\nsteps_per_frame = 1\n')
    for words in (("contact",), ("stability", "pace")):
        ended = run(*words, "--settings", "found.toml")
        assert ended.code == 2
        assert "matched" in ended.err
        assert "native" in ended.err


_UNDAMPED = """\
name = "undamped"

[pybullet]
method = "semi-implicit-euler"
steps_per_frame = 20
"""


def test_settings_of_another_name_are_a_variant_beside_the_others(
    here: Path, run: CommandLine
) -> None:
    """Data of the variant are paired with the others and uncertified: no budget is expected."""
    (here / "undamped.toml").write_text(_UNDAMPED)
    words = ("--trajectories", "4", "--out", "data", "--engines", "pybullet")
    made = run("generate", "1pendulum", "--settings", "native,undamped.toml", *words)

    assert made.code == 0, made.err
    native, undamped = (
        load_dataset(here / f"data/1pendulum/pybullet-{name}.h5") for name in ("native", "undamped")
    )
    assert undamped.attributes["profile"] == "undamped"
    assert undamped.attributes["certification"] == "uncertified"
    assert undamped.attributes["step_s"] == pytest.approx(1e-3)
    assert (native.index[:] == undamped.index[:]).all()
    assert not (native.position[:] == undamped.position[:]).all()


def test_a_variant_has_the_engines_of_its_file_alone(here: Path) -> None:
    (here / "undamped.toml").write_text(_UNDAMPED)
    scene = load_scene("1pendulum")

    contenders, _ = Choice.parse(profiles="undamped.toml").contenders(scene)
    assert [(c.engine, c.profile) for c in contenders] == [("pybullet", "undamped")]

    choice = Choice.parse(engines="mujoco,pybullet", profiles=["native", "undamped.toml"])
    contenders, _ = choice.contenders(scene)
    assert [(c.engine, c.profile) for c in contenders] == [
        ("mujoco", "native"),
        ("pybullet", "native"),
        ("pybullet", "undamped"),
    ]
    with pytest.raises(InputError, match="no settings of mujoco; there are: pybullet"):
        Choice.parse(engines="mujoco", profiles="undamped.toml")


@pytest.mark.parametrize("name", ["native", "two-words", "Undamped", "3", "", "a" * 41])
def test_a_variant_has_a_name_that_files_can_have(name: str, here: Path) -> None:
    (here / "own.toml").write_text(_UNDAMPED.replace('"undamped"', f'"{name}"'))
    line = rf"^--settings own.toml: name: got '{name}', allowed are up to 40 small letters"
    with pytest.raises(InputError, match=line):
        Choice.parse(profiles="own.toml")


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        (("semi-implicit-euler", "RK5"), "no method of pybullet is called 'RK5'"),
        (("= 20", "= 20\n[pybullet.options]\ndampin = 0"), "no option of pybullet is called"),
        (("= 20", "= 20\nstep = 0.005"), "pybullet: Object contains unknown field `step`"),
        (("= 20", "= 2.5"), r"pybullet: Expected `int`, got `float` - at `\$.steps_per_frame`"),
        (("[pybullet]", "[bullet]"), "no engine is called 'bullet'"),
    ],
)
def test_wrong_settings_are_refused_with_file_and_engine(
    changed: tuple[str, str], line: str, here: Path
) -> None:
    (here / "own.toml").write_text(_UNDAMPED.replace(*changed))
    with pytest.raises(InputError, match=f"^--settings own.toml: {line}"):
        Choice.parse(profiles="own.toml")

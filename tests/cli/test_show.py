"""The commands `show`, `engines` and `scenes`, and the models that engines are given."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.isolate import Task
from mbds_xsim.report import catalogue
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.testing import CASES

CommandLine = Callable[..., Any]
_LISTED = sorted({*registry.engine_names()} - {"mujoco", "mujoco-warp"})  # these give MJCF


@pytest.mark.parametrize("name", registry.scene_names())
def test_a_scene_shown_as_toml_loads_as_the_same_scene(
    name: str, run: CommandLine, here: Path
) -> None:
    (here / "again.toml").write_text(run("show", name, "--toml").out)

    assert registry.load_scene("./again.toml") == registry.load_scene(name)


def test_a_scene_says_which_budgets_are_its_own(run: CommandLine) -> None:
    assert "budgets: error at 1 s 1.8 mm; all as usual\n" in run("show", "3ladder").out
    assert "budgets: error at 1 s 20 mm; error_1s 0.02" in run("show", "balldrop").out


@pytest.mark.parametrize(
    ("factor", "told"), [(1.0, ""), (1e3, "1000 times"), (1e-3, "0.001 times")]
)
def test_a_length_in_another_unit_is_told(
    factor: float, told: str, run: CommandLine, here: Path
) -> None:
    scene = registry.load_scene("3pendulum")
    save_scene(msgspec.structs.replace(scene, length=1.5 * factor), here / "p.toml")
    shown = run("show", "./p.toml").out

    assert ("mechanism's reach (1.5 m); errors are judged by it" in shown) == bool(told)
    assert told in shown


def test_mujocos_file_gives_the_same_motion_in_mujoco_alone(run: CommandLine, here: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    sideways = msgspec.structs.replace(
        registry.load_scene("3pendulum"), gravity=(3.0, 0.0, -9.81), sampling=(), noise=0.0
    )
    save_scene(sideways, here / "sideways.toml")
    settings = registry.load_adapter("mujoco").settings(sideways, "matched")
    count = settings.substeps(sideways.clock.frame)
    text = f'[mujoco]\nmethod = "{settings.method}"\nsteps_per_frame = {count}\n'
    (here / "preset.toml").write_text(text)
    shown = run("show", "sideways.toml", "--native", "mujoco", "--settings", "preset.toml")
    (here / "model.xml").write_text(shown.out)

    model = mujoco.MjModel.from_xml_path("model.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    bodies = [model.body(body.name).id for body in sideways.bodies]
    positions = []
    for _ in range(11):
        mujoco.mj_forward(model, data)
        positions.append(data.xipos[bodies].copy())
        mujoco.mj_step(model, data, round(sideways.clock.frame / model.opt.timestep))

    ours = simulate(sideways, draw_batch(sideways, [0]), "mujoco", settings).trajectory
    np.testing.assert_allclose(positions, ours.position[0, :11], atol=1e-14)
    assert np.abs(positions[10] - positions[0]).max() > 0.01


def test_what_an_engine_is_given_starts_as_a_trajectory_does(run: CommandLine) -> None:
    scene = registry.load_scene("3pendulum")
    adapter = registry.load_adapter("mujoco")
    with adapter.open(scene, settings_for(scene, adapter, "matched")) as engine_run:
        expected = engine_run.native(draw_batch(scene, [2]))

    started = run("show", "3pendulum", "--native", "mujoco", "--start", "2").out.strip()

    assert started == expected.strip()
    assert started != run("show", "3pendulum", "--native", "mujoco").out.strip()


@pytest.mark.parametrize("listing", _LISTED)
@pytest.mark.parametrize("name", ["3pendulum", "1ladder", "parallelogram.toml"])
def test_a_listing_names_every_body_joint_and_mass(
    listing: str, name: str, run: CommandLine, here: Path
) -> None:
    (parallelogram,) = (case.scene for case in CASES if case.name == "parallelogram")
    save_scene(parallelogram, here / "parallelogram.toml")

    ended = run("show", name, "--native", listing, "--settings", "native")

    scene = registry.load_scene(name)
    assert ended.code == 0, ended.err
    for part in [body.name for body in scene.bodies] + [joint.name for joint in scene.joints]:
        assert repr(part) in ended.out
    numbers = {float(text) for text in re.findall(r"(?<![\w.])\d+\.\d+(?:e-?\d+)?", ended.out)}
    for mass in Mechanism.of(scene).mass:
        assert np.isclose(mass, list(numbers), rtol=1e-12).any(), mass


def test_what_an_engine_crashes_on_is_one_line(
    run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue, "Task", lambda *_: Task(os.abort, ()))

    ended = run("show", "2pendulum", "--native", "mujoco", "--settings", "native")

    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith("mbds-xsim: mujoco cannot load the scene: the process crashed")


def test_engines_are_told_with_their_methods_and_limits(run: CommandLine, here: Path) -> None:
    ended = run("engines", "--json", "engines.json")

    assert ended.code == 0
    rows = json.loads((here / "engines.json").read_text())
    assert [row["engine"] for row in rows] == registry.simulator_names()
    for row in rows:
        adapter = registry.load_adapter(row["engine"])
        assert row["version"] == adapter.version()
        assert row["version"] in ended.out
        assert [method["name"] for method in row["methods"]] == list(adapter.methods)
        assert set(row["limits"]) == {feature.value for feature in adapter.limits}
        assert set(row["options"]) == set(adapter.options)


def test_scenes_are_told_with_their_sizes(run: CommandLine) -> None:
    ended = run("scenes", "--json", "-")

    rows = {row["scene"]: row for row in json.loads(ended.out)}
    assert list(rows) == registry.scene_names()
    assert rows["3ladder"]["bodies"] == 39
    assert rows["3ladder"]["degrees_of_freedom"] == 108
    assert "3ladder" in ended.err


def test_a_scene_is_told_in_json_too(run: CommandLine) -> None:
    row = json.loads(run("show", "5pendulum", "--json", "-").out)

    assert (row["scene"], row["bodies"], row["degrees_of_freedom"]) == ("5pendulum", 5, 15)
    assert "ball joint" in row["needs"]


def test_one_form_at_a_time(run: CommandLine) -> None:
    ended = run("show", "2pendulum", "--toml", "--native", "mujoco")

    assert (ended.code, ended.out) == (2, "")
    assert "choose one of --toml, --native and --json" in ended.err


def test_pictures_need_no_display_whatever_the_environment_says(
    program: Callable[..., Any], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLBACKEND", "of-another-program")
    ended = program("show", "2pendulum", "--png", "a.png")
    assert (ended.code, ended.err) == (0, "")
    assert (here / "a.png").read_bytes().startswith(b"\x89PNG")

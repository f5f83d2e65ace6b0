"""The interface of `import mbds_xsim`, and its messages about unusable values."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbds_xsim
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import frame_of
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.simulate.choice import Choice, Contender
from mbds_xsim.simulate.registry import load_scene

_MASS = Inertia(mass=1.0, moments=(0.1, 0.1, 0.1))


def test_all_that_is_exported_is_there() -> None:
    assert all(callable(getattr(mbds_xsim, name)) for name in mbds_xsim.__all__)
    assert set(mbds_xsim.__all__) <= set(dir(mbds_xsim))
    with pytest.raises(AttributeError, match="no attribute 'valid'"):
        mbds_xsim.valid  # noqa: B018


def test_lists_and_arrays_are_taken_for_tuples() -> None:
    listed = Scene(
        name="rod",
        bodies=[Body(name="rod", inertia=_MASS, position=np.array([0.0, 0.0, -0.5]))],  # type: ignore[arg-type]
        joints=[Joint("hinge", "hinge", "world", "rod", [0.0, 0.0, 0.0], axis=[0, 1, 0])],  # type: ignore[arg-type]
        length=1.0,
    )

    tupled = Scene(
        name="rod",
        bodies=(Body(name="rod", inertia=_MASS, position=(0.0, 0.0, -0.5)),),
        joints=(Joint("hinge", "hinge", "world", "rod", (0.0, 0.0, 0.0), axis=(0, 1, 0)),),
        length=1.0,
    )
    assert listed == tupled
    assert hash(listed) == hash(tupled)


@pytest.mark.parametrize("engines", ["mujoco", ["mujoco"], ("mujoco", "mujoco"), " mujoco"])
def test_one_engine_is_one_engine(engines: Any) -> None:
    assert Choice.parse(engines=engines).engines == ("mujoco",)


def test_a_validation_takes_method_step_noise_and_page(tmp_path: Path) -> None:
    page = tmp_path / "page.html"

    validation = mbds_xsim.validate(
        load_scene("2pendulum"),
        engines="mujoco",
        trajectories=np.int64(1),  # type: ignore[arg-type]
        method="Euler",
        step=0.002,
        noise=False,
        workers=0,
        page=page,
    )

    (row,) = validation.engines
    assert (row.method, row.step_s) == ("Euler", 0.002)
    assert validation.to_frame()[["engine", "method"]].values.tolist() == [["mujoco", "Euler"]]
    assert "2pendulum" in page.read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"engines": "mujoco", "method": 4}, "no method of mujoco is called '4'"),
        ({"engines": "mujoco", "method": ["RK4"]}, "no method of mujoco is called"),
        ({"trajectories": 0}, "--trajectories: got 0, allowed is a whole number, 1 to 10000"),
        ({"trajectories": 1.5}, "--trajectories: got 1.5"),
        ({"seed": -1}, "--seed: got -1"),
        ({"workers": -1}, "--workers: got -1"),
        ({"limit": 0.5}, "--limit: got 0.5, allowed is 1 or more [s]"),
        ({"limit": float("nan")}, "--limit: got nan"),
        ({"engines": "mujco"}, "no engine is called 'mujco'"),
        ({"engines": 5}, "--engines: got 5, allowed are names"),
        ({"engines": ["mujoco", 5]}, "--engines: got ['mujoco', 5], allowed are names"),
        ({"settings": 3}, "--settings: got 3, allowed are names"),
        ({"settings": Path("no.toml")}, "--settings no.toml: there is no such file"),
        ({"settings": ["matched", Path("no.toml")]}, "--settings no.toml: there is no such file"),
        ({"settings": "best"}, "no settings profile is called 'best'"),
        ({"settings": []}, "--settings: got none, allowed is"),
        ({"noise": "no"}, "--noise: got 'no', allowed is True or False"),
        ({"method": "RK4"}, "--method RK4: methods differ between engines"),
        ({"step": "fast", "engines": "mujoco"}, "step: got 'fast'"),
        ({"step": float("nan"), "engines": "mujoco"}, "step: got nan"),
        ({"scene": "2pendulums"}, "no scene is called '2pendulums'"),
        ({"scene": 2}, "scene: got 2, allowed is a Scene, a name or the path of a file"),
        ({"page": "/dev/null/page.html"}, "page: cannot write"),
        ({"page": ""}, "page: got '', allowed is the path of a file or folder"),
        ({"page": 4}, "page: got 4, allowed is the path"),
        ({"page": "arm.toml"}, "page: got arm.toml, but it writes no .toml; name it arm.html"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(arguments: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as refused:
        mbds_xsim.validate(**{"scene": "2pendulum"} | arguments)

    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("call", "given", "options", "line"),
    [
        ("generate", ["2pendulum", ""], {}, "--out: got '', allowed is the path"),
        ("generate", ["2pendulum", 5], {}, "--out: got 5"),
        ("generate", [[], "data"], {}, "scenes: got none"),
        ("generate", [5, "data"], {}, "scene: got 5, allowed is a Scene"),
        ("audit", [""], {}, "file: got ''"),
        ("audit", ["x.npz"], {"index": 1.5}, "--index: got 1.5, allowed is a whole"),
        ("audit", ["x.npz"], {"index": np.array(0)}, "x.npz: "),
        ("audit", ["x.npz"], {"index": ["a"]}, "--index: got 'a'"),
        ("audit", ["x.npz"], {"seed": "a"}, "--seed: got 'a'"),
        ("audit", ["x.npz"], {"order": 0}, "--order: got 0"),
        ("audit", ["x.npz"], {"step": "a"}, "--step: got 'a', allowed is a number [s]"),
        ("audit", ["x.npz"], {"step": 0}, "--step: got 0, allowed is 1e-12 or more [s]"),
        ("audit", ["x.npz"], {"step": -0.01}, "--step: got -0.01, allowed is 1e-12 or more"),
        ("audit", ["x.npz"], {"step": True}, "--step: got True, allowed is a number [s]"),
        ("audit", ["x.npz"], {"contact_time": -1}, "--contact-time: got -1, allowed is 0 or more"),
        ("audit", ["x.npz"], {"index": 2**70}, "allowed is a whole number, 0 to 999999999999999"),
        ("audit", ["x.npz"], {"seed": True}, "--seed: got True, allowed is a whole number"),
        ("audit", ["x.npz"], {"noise": "no"}, "--noise: got 'no', allowed is True or"),
        ("verify", [""], {}, "path: got ''"),
        ("load_dataset", [3], {}, "path: got 3, allowed is the path"),
        ("generate", ["2pendulum", "data"], {"settings": 3}, "--settings: got 3"),
        ("generate", ["2pendulum", "data"], {"settings": Path("no.toml")}, "--settings no.toml:"),
        ("load_pairs", [], {}, "paths: got none, pairing takes two or more"),
        ("load_pairs", [["a.h5", "b.h5"]], {}, "paths: got ['a.h5', 'b.h5'], allowed is the path"),
        ("save_scene", [load_scene("2pendulum"), None], {}, "path: got None"),
        ("save_scene", [load_scene("2pendulum"), "arm.usdc"], {}, "path: got arm.usdc, but"),
        ("save_scene", ["2pendulum", "it.toml"], {}, "scene: got '2pendulum', allowed is a Scene"),
    ],
)
def test_other_calls_are_refused_in_one_line_too(
    call: str, given: list[Any], options: dict[str, Any], line: str, here: Path
) -> None:
    with pytest.raises(InputError) as refused:
        getattr(mbds_xsim, call)(*given, **options)

    assert line in str(refused.value)
    assert "\n" not in str(refused.value)
    assert list(here.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"scene": None}, "scene: got None, allowed is a Scene, a name or the path of a file"),
        ({"scene": Path("no.toml")}, "no.toml"),
        ({"engines": 5}, "--engines: got 5, allowed are names"),
        *(({"starts": wrong}, f"--starts: got {wrong!r}") for wrong in (0, -1, 1.5, "1", 1001)),
        ({"seed": -1}, "--seed: got -1, allowed is a whole number, 0 or more"),
        *(
            ({"limit": wrong}, f"--limit: got {wrong!r}, allowed is 0.1 to 1e+07 [s]")
            for wrong in ("a", 0, None, float("nan"), float("inf"))
        ),
        ({"workers": -1}, "--workers: got -1, allowed is a whole number, 0 or more"),
        ({"fresh": "no"}, "--fresh: got 'no', allowed is True or False"),
    ],
)
def test_a_trade_off_refuses_what_cannot_be_used(arguments: dict[str, Any], line: str) -> None:
    usual: dict[str, Any] = {"scene": "2pendulum", "engines": "mujoco", "limit": 1.0, "workers": 0}
    with pytest.raises(InputError) as refused:
        mbds_xsim.tradeoff(**(usual | arguments))

    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_trade_off_takes_the_path_of_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []

    def run(scene: Scene, **_: object) -> tuple[str, list[object]]:
        given.append(scene)
        return "study", []

    monkeypatch.setattr("mbds_xsim.studies.tradeoff.study.tradeoff_with_rows", run)
    scene = load_scene("2pendulum")
    mbds_xsim.save_scene(scene, tmp_path / "two.toml")
    for place in (tmp_path / "two.toml", str(tmp_path / "two.toml"), scene):
        mbds_xsim.tradeoff(place, engines="mujoco")
    assert given == [scene] * 3


def test_a_settings_file_may_be_given_as_a_path(here: Path) -> None:
    path = here / "own.toml"
    path.write_text('name = "own"\n[mujoco]\nmethod = "RK4"\nsteps_per_frame = 2\n')

    for settings in (path, str(path), [path]):
        assert Choice.parse(profiles=settings).profiles == ("own",)
    assert Choice.parse(profiles=["native", path]).profiles == ("native", "own")


def test_a_time_limit_is_that_of_each_engine_s_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = []

    def asked(_: object, choice: Choice) -> tuple[list[Contender], dict[str, str]]:
        limits.append(choice.limit)
        raise InputError("enough")

    monkeypatch.setattr(Choice, "contenders", lambda choice, scene: asked(scene, choice))
    with pytest.raises(InputError, match="enough"):
        mbds_xsim.validate("2pendulum", engines="mujoco", limit=7.0)
    with pytest.raises(InputError, match="enough"):
        mbds_xsim.generate("2pendulum", tmp_path, engines="mujoco", limit=8.0)
    assert limits == [7.0, 8.0]


@pytest.mark.slow
def test_data_are_made_checked_and_audited(tmp_path: Path) -> None:
    made = mbds_xsim.generate(
        "2pendulum", tmp_path, engines="mujoco", trajectories=2, settings=["matched"], workers=1
    )
    file = tmp_path / made.variants[0].file
    checked, audited = mbds_xsim.verify(tmp_path, workers=1), mbds_xsim.audit(file)

    assert made.to_frame()["trajectories"].tolist() == [2]
    assert checked.sound
    assert checked.to_frame()["kind"].tolist() == [report.kind for report in checked.files]
    assert audited.to_frame()["check"].tolist() == [one.check for one in audited.findings]
    assert len(mbds_xsim.load_dataset(file).index) == made.variants[0].published


def test_frames_without_pandas_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)

    with pytest.raises(InputError, match=r"needs pandas.*pip install 'mbds-xsim\[frames\]'"):
        frame_of([])

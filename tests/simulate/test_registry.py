"""Scenes and engines are found by name, and engines' claims fit each other."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest

from mbds_xsim.base.errors import EngineMissing, InputError, UnknownName
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.claims import FAMILIES, Method, Sweep, check_claims, own_family
from tests.plugins import installed


def test_the_engines_are_registered() -> None:
    names = ["dart", "drake", "exudyn", "mujoco", "mujoco-warp", "pinocchio", "pybullet"]
    assert registry.engine_names() == names


@pytest.mark.parametrize(
    ("name", "bodies"), [("5pendulum", 5), ("12pendulum", 12), ("2ladder", 26)]
)
def test_a_family_name_carries_its_size(name: str, bodies: int) -> None:
    scene = registry.load_scene(name)

    assert scene.name == name
    assert len(scene.bodies) == bodies


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("7teapot", "; there are: .*3ladder.*Npendulum"),
        ("ladder", ": N of Nladder is a number from 1 to 9999"),
        ("0pendulum", ": N of Npendulum is a number from 1 to 9999"),
    ],
)
def test_an_unknown_scene_is_told_what_there_is(name: str, told: str) -> None:
    with pytest.raises(UnknownName, match=f"{name!r}{told}"):
        registry.load_scene(name)


def test_an_engine_whose_package_is_not_there_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Adapters import their engine where they need it, which may be long after."""

    def version(package: str) -> str:
        if package == "drake":
            raise PackageNotFoundError(package)
        return "1.0"

    monkeypatch.setattr(registry, "version_of", version)
    assert set(registry.engine_names()) - set(registry.installed_engines()) == {"drake"}
    with pytest.raises(EngineMissing, match=r"drake is not installed.*pip install .*\[drake\]"):
        registry.load_adapter("drake")


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (
            "raise KeyError('wheel')",
            "the writer of odd, odd_writer:write, fails: KeyError: 'wheel'",
        ),
        ("import sys; sys.exit('no licence')", "with exit code 1: no licence"),
        ("return 3", "TypeError: it gives 3, not Written"),
        ("raise InputError('odd knows no joint')", "^odd knows no joint$"),
    ],
)
def test_a_writer_of_another_package_that_goes_wrong_is_named(
    body: str, told: str, tmp_path: Path
) -> None:
    source = f"from mbds_xsim.base.errors import InputError\ndef write(scene):\n    {body}\n"
    with (
        installed(tmp_path / "odd", {"odd_writer": source}, writers={"odd": "odd_writer:write"}),
        pytest.raises(InputError, match=told),
    ):
        registry.write_model(registry.load_scene("1pendulum"), "odd")


def test_an_unknown_engine_is_told_what_there_is() -> None:
    with pytest.raises(UnknownName, match=r"'ode'.*mujoco"):
        registry.load_adapter("ode")


def test_a_family_is_a_known_one_or_said_to_be_an_engines_own() -> None:
    """A misspelt family would be a vote of its own."""
    with pytest.raises(UnknownName, match=r"family of step is called 'Rk4'.*RK4.*own_family"):
        Method("step", "Rk4", 4)

    assert Method("step", own_family("Rk4"), 4).family not in FAMILIES


@pytest.mark.parametrize(
    ("claim", "value", "told"),
    [
        ("methods", {"one": Method("other", "RK4", 4)}, "other stands under the name one"),
        ("methods", {"one": Method("one", "RK4", 4, adaptive=True)}, "adaptive.*no option rtol"),
        ("methods", {}, "no methods"),
        ("sweeps", {"turns": Sweep((1, 2))}, "sweeps turns"),
        ("cut", ("ball", "ball", "hinge", "fixed"), "allowed is each of ball, hinge"),
    ],
)
def test_claims_that_do_not_fit_each_other_are_told(claim: str, value: Any, told: str) -> None:
    adapter = registry.load_adapter("mujoco")
    claims = {key: getattr(adapter, key) for key in ("methods", "options", "sweeps", "cut")}
    check_claims(**claims)

    with pytest.raises(ValueError, match=told):
        check_claims(**claims | {claim: value})

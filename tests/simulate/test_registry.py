"""Scenes and engines are found by name."""

from __future__ import annotations

import pytest

from mbds_xsim.base.errors import UnknownName
from mbds_xsim.simulate import registry


def test_the_four_engines_are_registered() -> None:
    assert registry.engine_names() == ["dart", "exudyn", "mujoco", "pybullet"]


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


def test_an_unknown_engine_is_told_what_there_is() -> None:
    with pytest.raises(UnknownName, match=r"'ode'.*mujoco"):
        registry.load_adapter("ode")

"""Colours and lines of learning curves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.learn.curves import looks, read_curve


def test_an_engine_looks_the_same_whichever_others_there_are() -> None:
    alone = looks(["mujoco"])
    beside = looks(["all", "dart", "mujoco", "not-dart", "not-mujoco"])
    assert alone["mujoco"] == beside["mujoco"]
    assert beside["mujoco"][0] == beside["not-mujoco"][0] != beside["dart"][0]


def test_trainings_are_told_apart() -> None:
    engines = ("dart", "exudyn", "mujoco", "pybullet")
    ways = [word.format(e) for word in ("{}", "not-{}", "{}-low", "{}-high") for e in engines]
    styles = looks([*ways, "all"])
    assert len(set(styles.values())) == len(ways) + 1


def test_an_engine_whose_name_begins_as_another_s_has_its_own_colour() -> None:
    styles = looks(["mujoco", "mujoco-warp", "mujoco-warp-low", "mujoco-low"])
    assert styles["mujoco-warp"][0] == styles["mujoco-warp-low"][0] != styles["mujoco"][0]
    assert styles["mujoco-low"][0] == styles["mujoco"][0]
    assert styles["mujoco-warp"][1] == styles["mujoco"][1] == "-"


def test_a_curve_that_ends_as_no_training_does_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mujoco-s0.curve.json"
    point = {"step": 1, "loss": 1.0, "error": 1.0, "rate": 1e-3}
    curve = {"run": "a/mujoco-s0", "most_steps": 2, "ended": "soon", "points": [point]}
    path.write_text(json.dumps(curve))

    with pytest.raises(InputError, match="no learning curve, or a damaged one"):
        read_curve(path)

"""What an adapter gives back is held against what it promises."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
import pytest

from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import checked, simulate


def _sound() -> tuple[Batch, Trajectory]:
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, range(3)).truncated(4)
    whole = Trajectory.empty(0.02 * np.arange(5.0), 3, 2)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        getattr(whole, name)[:] = 0.5
    return batch, whole


def _given(trajectory: object, batch: Batch) -> Trajectory:
    return checked(cast(Trajectory, trajectory), batch)


def test_frames_from_a_failure_on_are_not_numbers() -> None:
    batch, whole = _sound()
    failures = (None, Failure(2, "joint limit"), Failure(99, "told at the end"))

    cut = _given(dataclasses.replace(whole, failures=failures), batch)

    ended = np.isnan(cut.position).all(axis=(2, 3))
    assert ended.tolist() == [[False] * 5, [False] * 2 + [True] * 3, [False] * 4 + [True]]
    for name in ("orientation", "velocity", "angular_velocity"):
        assert np.array_equal(np.isnan(getattr(cut, name)).all(axis=(2, 3)), ended)
    assert cut.failures == failures


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"position": np.zeros((3, 5, 1, 3))}, r"position as float64 \(3, 5, 1, 3\), not"),
        ({"orientation": np.zeros((3, 5, 2, 3))}, "orientation as float64"),
        ({"velocity": np.zeros((3, 5, 2, 3), dtype=np.float32)}, "velocity as float32"),
        ({"angular_velocity": [[0.0]]}, "angular_velocity as <class 'list'>"),
        ({"time": np.zeros(4)}, r"time as float64 \(4,\), not as float64 \(5,\)"),
        ({"failures": (None,)}, "failures .* for each trajectory"),
        ({"failures": ("late", None, None)}, "failures .* for each trajectory"),
    ],
)
def test_what_is_no_trajectory_is_refused(wrong: dict[str, Any], told: str) -> None:
    batch, whole = _sound()
    with pytest.raises(ValueError, match=told):
        _given(dataclasses.replace(whole, **wrong), batch)


def test_nothing_is_no_trajectory() -> None:
    batch, _ = _sound()
    with pytest.raises(ValueError, match="the adapter gave time as <class 'NoneType'>"):
        _given(None, batch)


def test_quaternions_keep_their_sign_in_every_engine(adapter: Adapter) -> None:
    """PyBullet's change it 18 times in these frames, where flywheels turn half around."""
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, [2, 5]).truncated(60)

    turn = simulate(scene, batch, adapter.name, adapter.settings(scene, "native")).trajectory

    frames = np.concatenate([batch.orientation[:, None], turn.orientation], axis=1)
    assert not (np.sum(frames[:, 1:] * frames[:, :-1], axis=-1) < 0).any()

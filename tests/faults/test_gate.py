"""Faults that `generate` must not publish: judged on the motion alone, without a reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import h5py
import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.dataset.gate import CheckTable, Making, judge_rows
from mbds_xsim.dataset.shard import make_shard
from mbds_xsim.dataset.variant import Item, Variant
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate

from .changes import force, ground, heavier, times, torque
from .faults import change_of
from .planting import Change, Faulty

pytestmark = pytest.mark.slow

_ROWS = range(20, 26)  # outside the audit sample
_DROPPED = 70
_Claim = Callable[[Scene, Batch], tuple[Scene, Batch]]


def _with_force(change: Callable[[np.ndarray], np.ndarray]) -> _Claim:
    return lambda scene, batch: (scene, dataclasses.replace(batch, force=change(batch.force)))


def _gravity(share: float) -> _Claim:
    def claim(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
        return msgspec.structs.replace(scene, gravity=(0.0, 0.0, -9.81 / share)), batch

    return claim


def _another_seed(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
    other = draw_batch(scene, batch.index.tolist(), seed=5)
    return scene, dataclasses.replace(batch, force=other.force)


CLAIMS: dict[str, _Claim] = {
    "inputs a frame late": _with_force(lambda force: np.roll(force, -1, axis=1)),
    "inputs 1 % weak": _with_force(lambda force: force / 0.99),
    "noise of another seed": _another_seed,
    "gravity 1 % strong": _gravity(1.01),
    "a body 1 % heavier": lambda scene, batch: (heavier("link3", -0.01).model(scene), batch),
}
"""False claims of scenes and batches about motions."""


@pytest.fixture(scope="module")
def pendulum() -> tuple[Scene, Batch, Making, Trajectory, Trajectory]:
    """A chain in PyBullet, with all its inputs and without those of one frame."""
    if "pybullet" not in registry.installed_engines():
        pytest.skip("not installed: pybullet")
    scene = load_scene("5pendulum")
    (contender,), _ = Choice.parse(engines="pybullet").contenders(scene)
    batch = draw_batch(scene, _ROWS)
    force = batch.force.copy()
    force[:, _DROPPED] = 0.0
    lacking = dataclasses.replace(batch, force=force)
    whole, less = (
        simulate(scene, inputs, "pybullet", contender.settings).trajectory
        for inputs in (batch, lacking)
    )
    return scene, batch, Making.of(contender), whole, less


def _published(verdict: CheckTable) -> int:
    return int(verdict.published(certified=True).sum())


def test_a_sound_chain_is_published(
    pendulum: tuple[Scene, Batch, Making, Trajectory, Trajectory],
) -> None:
    scene, batch, making, motion, _ = pendulum
    assert _published(judge_rows(scene, batch, motion, making)) == len(batch)


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS.keys())
def test_nothing_is_published_that_the_scene_does_not_say(
    pendulum: tuple[Scene, Batch, Making, Trajectory, Trajectory], claim: _Claim
) -> None:
    scene, batch, making, motion, _ = pendulum
    verdict = judge_rows(*claim(scene, batch), motion, making)

    assert _published(verdict) == 0
    assert any(line.startswith("together: ") for line in verdict.misbuilt)


def test_a_frame_twice_with_the_rest_late_is_not_published(
    pendulum: tuple[Scene, Batch, Making, Trajectory, Trajectory],
) -> None:
    scene, batch, making, motion, _ = pendulum
    twice = change_of("a frame twice, those after it late").motion(scene, batch, 0.0, motion)

    assert _published(judge_rows(scene, batch, twice, making)) == 0


def test_inputs_dropped_in_one_frame_are_named(
    pendulum: tuple[Scene, Batch, Making, Trajectory, Trajectory],
) -> None:
    scene, batch, making, _, lacking = pendulum
    verdict = judge_rows(scene, batch, lacking, making)

    assert _published(verdict) == 0
    assert any(f"inputs of step {_DROPPED}:" in line for line in verdict.misbuilt)


def _other_noise(batch: Batch) -> Batch:
    return _another_seed(load_scene("simplecubli"), batch)[1]


def _first_hinge_off(torques: Array) -> Array:
    return np.concatenate([np.zeros_like(torques[..., :1]), torques[..., 1:]], axis=-1)


@pytest.mark.parametrize(
    "change",
    [
        None,
        force(np.zeros_like),
        Change(inputs=_other_noise),
        torque(_first_hinge_off),
        torque(times(0.95)),
        ground("restitution", lambda _: 0.88),
        ground("friction", lambda _: 0.35),
        change_of("last ten frames frozen"),
    ],
)
def test_a_shard_of_thrown_cubes_is_published_as_it_is_told_alone(
    change: Change | None, tmp_path: Path
) -> None:
    if "mujoco" not in registry.installed_engines():
        pytest.skip("not installed: mujoco")
    scene = load_scene("simplecubli")
    (contender,), _ = Choice.parse(engines="mujoco").contenders(scene)
    variant = Variant(scene, contender, seed=0, noise=True)
    adapter = registry.load_adapter("mujoco")
    if change:
        adapter = Faulty(adapter, change)
    item = Item(variant, _ROWS.start, len(_ROWS))
    with mock.patch("mbds_xsim.simulate.timed.load_adapter", return_value=adapter):
        make_shard(item, tmp_path)
    with h5py.File(item.path(tmp_path)) as file:
        published = int(file.attrs["published"])

    assert published == (0 if change else len(_ROWS))

"""The read-back of every engine reveals geometry that a start at rest does not show."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.isolate import Crash
from mbds_xsim.measure.campaign import reference_of
from mbds_xsim.measure.judge import judge
from mbds_xsim.measure.outcome import Outcome
from mbds_xsim.measure.result import EngineResult
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Readback
from mbds_xsim.simulate.choice import Choice, settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.testing import CASES


def _held(adapter: Adapter, scene: Scene, other: Scene) -> tuple[Readback, list[str]]:
    """Compare the engine's model of one scene with another scene."""
    batch, settings = draw_batch(scene, [0]), settings_for(scene, adapter, "matched")
    with adapter.open(scene, settings) as run:
        read = run.readback(batch)
    method = adapter.methods[settings.method]
    return read, readback.compare(Mechanism.of(other), batch, settings, read, method)


def _with_anchor(scene: Scene, joint: str, shift: float) -> Scene:
    """Move a joint's anchor along x [m]."""
    joints = tuple(
        msgspec.structs.replace(one, anchor=(one.anchor[0] + shift, *one.anchor[1:]))
        if one.name == joint
        else one
        for one in scene.joints
    )
    return msgspec.structs.replace(scene, joints=joints)


def _with_sphere(scene: Scene, sphere: int, shift: float) -> Scene:
    """Move a contact sphere's centre along z [m]."""
    contacts = list(scene.contacts)
    x, y, z = contacts[sphere].center
    contacts[sphere] = msgspec.structs.replace(contacts[sphere], center=(x, y, z + shift))
    return msgspec.structs.replace(scene, contacts=tuple(contacts))


def test_an_anchor_a_millimetre_off_is_told(cornered: Adapter) -> None:
    """With a wrong hub, a wheel stands where it should but turns about another line."""
    car = load_scene("particlecar")

    _, lines = _held(cornered, _with_anchor(car, "front_left", 1e-3), car)

    assert len(lines) == 1, lines
    assert lines[0].startswith("anchor [m] of front_left in ")
    assert "(2 differ)" in lines[0]


def test_a_loops_anchor_is_told_where_the_engine_tells_it(adapter: Adapter) -> None:
    (scene,) = (case.scene for case in CASES if case.name == "parallelogram")

    read, lines = _held(adapter, _with_anchor(scene, "right pin", 1e-3), scene)

    assert read.anchor is not None
    (loop,) = Mechanism.of(scene).loops
    assert bool(lines) == bool(np.isfinite(read.anchor[loop.index]).all())


def test_a_contact_sphere_three_millimetres_off_is_told(cornered: Adapter) -> None:
    cubli = load_scene("simplecubli")

    _, lines = _held(cornered, _with_sphere(cubli, 5, 3e-3), cubli)

    assert len(lines) == 1, lines
    assert lines[0].startswith("centre of contact [m] of sphere 5 on ")
    assert "(1 differ)" in lines[0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"stiffness": 1.01}, "stiffness [N/m]"),
        ({"damping": 0.95}, "damping [N·s/m]"),
        ({"rest_length": 1.001}, "rest length [m]"),
        ({"points": 1.001}, "length at the start [m]"),
    ],
)
def test_a_spring_or_damper_slightly_off_is_told(
    adapter: Adapter, change: dict[str, float], told: str
) -> None:
    """Values change by a factor; a fixed rest length keeps the changed ends from changing it."""
    bench = load_scene("workbench")
    (field, factor), (first, spring) = *change.items(), bench.springs
    value = np.multiply(getattr(spring, field), factor)
    other = msgspec.structs.replace(
        spring, **{field: tuple(map(tuple, value)) if value.ndim else float(value)}
    )

    _, lines = _held(adapter, msgspec.structs.replace(bench, springs=(first, other)), bench)

    assert len(lines) == 1, lines
    assert lines[0].startswith(f"{told} of {spring.name}: got ")


@pytest.mark.parametrize("what", ["joint_axis", "anchor", "sphere", "contact"])
@pytest.mark.parametrize("given", [np.zeros(0), np.zeros((5, 2)), np.zeros((3, 11, 1, 3))])
def test_an_array_of_another_shape_is_told(what: str, given: Array) -> None:
    scene = load_scene("particlecar")
    batch, mujoco = draw_batch(scene, [0]), load_adapter("mujoco")
    settings = settings_for(scene, mujoco, "matched")
    with mujoco.open(scene, settings) as run:
        odd: Any = {what: given}
        read = dataclasses.replace(run.readback(batch), **odd)

    (line,) = readback.compare(Mechanism.of(scene), batch, settings, read)

    assert f"got shape {given.shape}" in line


@pytest.mark.parametrize("what", ["spring", "law", "armature", "friction", "coupling"])
@pytest.mark.parametrize("given", [np.zeros(0), np.zeros((0, 4)), np.zeros((5, 2))])
def test_what_a_scene_does_not_have_an_engine_must_not_have(what: str, given: Array) -> None:
    scene, mujoco = load_scene("2pendulum"), load_adapter("mujoco")
    batch, settings = draw_batch(scene, [0]), settings_for(scene, mujoco, "matched")
    with mujoco.open(scene, settings) as run:
        odd: Any = {what: given}
        read = dataclasses.replace(run.readback(batch), **odd)

    lines = readback.compare(Mechanism.of(scene), batch, settings, read)

    assert len(lines) == bool(given.size)
    assert all(": got shape (" in line for line in lines)


def test_where_a_part_crashed_the_others_are_held_against_their_own_starts() -> None:
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, range(2))
    (contender,), _ = Choice.parse(engines="mujoco", profiles="matched").contenders(scene)
    part = simulate(scene, batch[[1]], "mujoco", contender.settings)
    outcome = Outcome(contender, scene, batch, [Crash("gone"), part], [[0], [1]])

    result = judge(outcome, reference_of(scene, batch, True)).result

    assert result.reasons[0] == "crash: gone"
    assert not [line for line in result.reasons if line.startswith("read-back")]


def test_a_motion_that_ends_early_has_the_cost_of_what_there_is() -> None:
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, range(2))
    (contender,), _ = Choice.parse(engines="mujoco", profiles="matched").contenders(scene)
    whole = simulate(scene, batch, "mujoco", contender.settings)
    truth = reference_of(scene, batch, True)

    def ended(*frames: int | None) -> EngineResult:
        ends = tuple(None if frame is None else Failure(frame, "lost") for frame in frames)
        motion = dataclasses.replace(whole.trajectory[[0, 1]], failures=ends).cut_at_failures()
        part = dataclasses.replace(whole, trajectory=motion, rollout_s=1.0)
        return judge(Outcome(contender, scene, batch, [part], [[0, 1]]), truth).result

    frame = scene.clock.frame
    assert ended(None, 50).wall_per_simulated_s == pytest.approx(1.0 / (frame * (batch.steps + 50)))
    lost = ended(0, 0)
    assert (lost.wall_per_simulated_s, lost.error_max_m) == (None, None)

"""A body at rest on the ground."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mbds_xsim.checks import Record
from mbds_xsim.checks.passivity import resting
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    ContactSphere,
    Force,
    Ground,
    Inertia,
    Joint,
    Scene,
    Torque,
)
from mbds_xsim.scene.state import Trajectory

CORNERS = [(x, y) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]


BOX = Body("box", inertia=Inertia(1.0, (0.02,) * 3), position=(0.0, 0.0, 0.1))
CREEP = 1e-3


def _box(
    corners: list[tuple[float, float]] = CORNERS,
    bodies: tuple[Body, ...] = (BOX,),
    friction: float = 0.5,
    **parts: Any,
) -> Scene:
    """Lay a box on the ground, whose last body has the last sphere."""
    owners = ["box"] * (len(corners) - 1) + [parts.pop("last", "box")]
    return Scene(
        name="box",
        bodies=bodies,
        contacts=tuple(
            ContactSphere(owner, (x, y, 0.02), 0.02)
            for owner, (x, y) in zip(owners, corners, strict=True)
        ),
        ground=Ground(friction, 0.0),
        length=0.4,
        clock=Clock(0.02, 50),
        **parts,
    )


def _lying(scene: Scene, *, creep: float = 0.0, sink: float = 0.0) -> Record:
    """Record a box that lies still, or moves at a constant velocity along x or down [m/s]."""
    batch = draw_batch(scene, range(1))
    time = np.linspace(0.0, 1.0, 51)
    moved = time[:, None] * np.array([creep, 0.0, -sink])
    shape = (1, 51, len(scene.bodies), 3)
    turn = np.repeat(batch.orientation[:, None], 51, axis=1)
    place = batch.position[:, None] + moved[:, None]
    speed = np.broadcast_to([creep, 0.0, -sink], shape)
    return Record(scene, batch, Trajectory(time, place, turn, speed, np.zeros(shape), (None,)))


def test_what_lies_still_passes() -> None:
    assert resting.finding(_lying(_box())).figure.tolist() == [0.0]
    pushed = Force("box", ((1.0, 0.0, 0.0),))
    assert resting.finding(_lying(_box(forces=(pushed,)))).figure.tolist() == [0.0]


@pytest.mark.parametrize("motion", [{"creep": 1e-3}, {"sink": 1e-3}])
def test_what_creeps_or_sinks_does_not(motion: dict[str, float]) -> None:
    finding = resting.finding(_lying(_box(), **motion))
    # A millimetre a second, from the first frames on, until it has sunk too far.
    assert finding.figure == pytest.approx(1e-3 * 0.98 / 0.4, rel=0.65)
    assert not finding.passed.any()


def test_what_wakes_up_is_seen() -> None:
    record = _lying(_box())
    place, speed = record.trajectory.position.copy(), record.trajectory.velocity.copy()
    place[:, 30:, :, 0] += 0.1 * 0.02 * np.arange(21)[:, None]
    speed[:, 31:, :, 0] = 0.1
    moved = dataclasses.replace(record.trajectory, position=place, velocity=speed)
    finding = resting.finding(dataclasses.replace(record, trajectory=moved))
    assert finding.figure == pytest.approx(0.1 * 0.4 / 0.4)


def test_other_inputs_may_wake_it() -> None:
    push = Force("box", ((0.0, 0.0, 0.0), (9.0, 0.0, 0.0)), hold=25)
    record = _lying(_box(forces=(push,)))
    place, speed = record.trajectory.position.copy(), record.trajectory.velocity.copy()
    fast = 4.0 * 0.02 * np.arange(1, 26)
    speed[:, 26:, :, 0], place[:, 26:, :, 0] = fast[:, None], np.cumsum(0.02 * fast)[:, None]
    moved = dataclasses.replace(record.trajectory, position=place, velocity=speed)
    assert resting.finding(dataclasses.replace(record, trajectory=moved)).figure.tolist() == [0.0]


@pytest.mark.parametrize("corners", [CORNERS[:2], [(0.2, 0.2), (0.2, -0.2), (0.3, 0.0)]])
def test_what_is_not_carried_safely_may_fall(corners: list[tuple[float, float]]) -> None:
    assert resting(_lying(_box(corners), creep=1e-3)) is None


def test_noise_leaves_nothing_to_see() -> None:
    scene = _box(noise=0.0, forces=(Force("box", tuple((0.1 * k, 0.0, 0.0) for k in range(50))),))
    assert resting(_lying(scene)) is None


def _tilted(slope: float) -> tuple[float, float, float]:
    """Return gravity on a slope along x."""
    angle = np.arctan(slope)
    return float(9.81 * np.sin(angle)), 0.0, float(-9.81 * np.cos(angle))


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.4])
def test_what_creeps_on_a_slope_that_friction_holds_is_seen(slope: float) -> None:
    scene = _box(gravity=_tilted(slope))
    assert not resting.finding(_lying(scene, creep=CREEP)).passed.any()


@pytest.mark.parametrize(("friction", "slope"), [(0.5, 0.51), (0.5, 0.48), (0.0, 0.0)])
def test_what_friction_hardly_holds_may_slide(friction: float, slope: float) -> None:
    scene = _box(gravity=_tilted(slope), friction=friction)
    assert resting(_lying(scene, creep=CREEP)) is None


@pytest.mark.parametrize(("push", "tips"), [(15.0, False), (21.0, True)])
def test_what_a_force_tips_may_move(push: float, tips: bool) -> None:
    """The centre of mass is 0.1 m high, and 0.2 m from the edges."""
    scene = _box(friction=3.0, forces=(Force("box", ((push, 0.0, 0.0),)),))
    finding = resting(_lying(scene, creep=CREEP))
    assert (finding is None) == tips
    assert finding is None or not finding.passed.any()


def _jointed(last: str, torque: float = 0.0) -> Scene:
    """Put a wheel on the box, by a hinge; the last sphere may be its."""
    wheel = Body("wheel", inertia=Inertia(0.1, (1e-4,) * 3), position=(0.0, 0.0, 0.1))
    hinge = Joint("axle", "hinge", "box", "wheel", (0.0, 0.0, 0.1), (0.0, 1.0, 0.0))
    torques = (Torque("axle", (torque,)),) if torque else ()
    return _box(bodies=(BOX, wheel), joints=(hinge,), torques=torques, last=last)


def test_joined_bodies_are_judged_if_nothing_moves_them_on_each_other() -> None:
    """A car on its wheels may roll, and a torque may turn what lies."""
    judged = resting(_lying(_jointed("box"), creep=CREEP))
    assert judged is not None
    assert not judged.passed.any()
    assert resting(_lying(_jointed("wheel"), creep=CREEP)) is None
    assert resting(_lying(_jointed("box", 0.1), creep=CREEP)) is None


def test_what_moves_on_a_body_may_move_it() -> None:
    record = _lying(_jointed("box"))
    place = record.trajectory.position.copy()
    place[:, 20:, 1, 0] += 0.05
    place[:, 20:, 0, 0] += 0.01
    moved = dataclasses.replace(record.trajectory, position=place)
    assert resting.finding(dataclasses.replace(record, trajectory=moved)).figure.max() < 1e-3

"""Impacts that leave a sphere on the ground: right where the ground gives nothing back."""

from __future__ import annotations

import dataclasses

import msgspec
import pytest

from mbds_xsim.checks import Finding, Record
from mbds_xsim.checks.eccentric import eccentric_restitution
from mbds_xsim.checks.rebounds import restitution
from mbds_xsim.reference import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Joint, Scene
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.testing.contact_cases import ball

RK4 = load_adapter("mujoco").methods["RK4"]


def _dropped(stated: float, delivered: float, height: float = 1.0) -> Record:
    """Drop a ball on a ground whose restitution need not be the stated one."""
    scene = ball(height, ground=Ground(0.2, delivered), steps=60)
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)
    scene = msgspec.structs.replace(scene, ground=Ground(0.2, stated))
    return Record(scene, batch, motion, RK4, 1e-4, contact_time=1e-4)


def _finding(stated: float, delivered: float, height: float = 1.0) -> Finding:
    return restitution.finding(_dropped(stated, delivered, height))


@pytest.mark.parametrize("stated", [0.2, 0.5, 0.9332])
def test_a_ball_that_does_not_rebound_shows(stated: float) -> None:
    finding = _finding(stated, 0.0)

    assert not finding.passed.any()
    assert finding.figure == pytest.approx(stated, abs=0.05)
    assert "; 1 more deliver " in finding.note


@pytest.mark.parametrize("height", [0.02, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("delivered", [0.0, 0.02, 0.05, 0.1, 0.2, 0.5])
def test_a_ball_that_rebounds_as_little_as_it_should_passes(
    delivered: float, height: float
) -> None:
    assert _finding(delivered, delivered, height).figure.max() < 1e-9


def test_a_slow_ball_may_come_to_rest() -> None:
    """Below three times the speed that gravity adds in a frame no impact shows restitution."""
    assert _finding(0.5, 0.0, 0.01).passed.all()


def test_without_a_declared_time_of_contact_a_ball_may_still_be_in_contact() -> None:
    record = _dropped(0.5, 0.0)
    soft, unknown = (dataclasses.replace(record, contact_time=time) for time in (0.02, None))

    assert restitution.finding(soft).passed.all()
    assert restitution.finding(unknown).passed.all()


@pytest.mark.parametrize("delivered", [None, 0.0])
def test_a_cube_that_does_not_rebound_shows(delivered: float | None) -> None:
    pytest.importorskip("mujoco")
    scene = msgspec.structs.replace(load_scene("simplecubli"), clock=Clock(0.02, 16))
    made = scene if delivered is None else msgspec.structs.replace(scene, ground=Ground(0.43, 0.0))
    adapter, batch = load_adapter("mujoco"), draw_batch(scene, range(4))
    settings = settings_for(scene, adapter, "matched")
    run = simulate(made, batch, "mujoco", settings)
    method = adapter.methods[settings.method]
    record = Record(scene, batch, run.trajectory, method, settings.step, run.contact_time)

    finding = eccentric_restitution.finding(record)

    assert finding.passed.all() == (delivered is None)
    assert ("; 1 more deliver 0.038 at most" in finding.note) == (delivered == 0.0)


def test_a_landing_on_a_stiff_damped_joint_is_no_dull_impact() -> None:
    """What lands on the foot pushes it back within a frame, by forces that neither end shows."""
    low = 0.05
    foot = Body("foot", inertia=Inertia(1.0, (0.01,) * 3), position=(0.0, 0.0, 2 * low))
    foot = msgspec.structs.replace(foot, velocity=(0.0, 0.0, -3.0))
    top = Body("top", inertia=Inertia(1.0, (0.01,) * 3), position=(0.0, 0.0, 0.4))
    bush = Joint("bush", "slider", "foot", "top", (0.0, 0.0, 0.25), (0.0, 0.0, 1.0))
    bush = msgspec.structs.replace(bush, stiffness=3.6e5, damping=1000.0)
    scene = Scene(
        "pogo",
        (foot, top),
        1.0,
        joints=(bush,),
        contacts=(ContactSphere("foot", (0.0, 0.0, 2 * low), low),),
        ground=Ground(0.3, 0.5),
        clock=Clock(0.02, 10),
    )
    batch, engine = draw_batch(scene, [0]), load_adapter("mujoco")
    settings = engine.settings(scene, "matched")
    with engine.open(scene, settings) as run:
        motion = run.rollout(batch)
    lasts = engine.contact_scales(settings).time
    record = Record(scene, batch, motion, RK4, settings.step, contact_time=lasts)

    assert eccentric_restitution.finding(record).passed.all()

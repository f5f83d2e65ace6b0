from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.checks import Finding, Record
from mbds_xsim.checks.coefficients import coefficients
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Force, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.simulate.timed import simulate as run

RK4 = Method("RK4", "RK4", 4)
LEAPFROG = Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5)


def _found(case: Any, scene: Scene | None = None, batch: Batch | None = None) -> Finding:
    """Check a motion against a scene or inputs that may differ from its own."""
    return coefficients.finding(
        Record(scene or case.scene, batch or case.batch, case.exact, RK4, 2e-3)
    )


def test_exact_motions_of_chains_loops_and_free_bodies_pass(
    pendulum: Any, tumbling: Any, linkage: Any
) -> None:
    for case in (pendulum, tumbling, linkage):
        assert (_found(case).figure < 0.1).all()


def test_gravity_one_per_cent_off_shows_in_chains_and_loops(pendulum: Any, linkage: Any) -> None:
    for case in (pendulum, linkage):
        gravity = tuple(1.01 * pull for pull in case.scene.gravity)
        finding = _found(case, msgspec.structs.replace(case.scene, gravity=gravity))

        assert not finding.passed.any()
        assert set(finding.where) <= {"gravity", *(f"mass of {b.name}" for b in case.scene.bodies)}


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_weak_and_strong_inputs_show(pendulum: Any, linkage: Any, share: float) -> None:
    for case in (pendulum, linkage):
        batch = dataclasses.replace(
            case.batch, force=share * case.batch.force, torque=share * case.batch.torque
        )
        assert not _found(case, batch=batch).passed.any()


def test_inputs_of_another_frame_or_seed_show_by_name(pendulum: Any) -> None:
    force = pendulum.batch.force
    late = dataclasses.replace(pendulum.batch, force=np.roll(force, -1, axis=1))
    early = dataclasses.replace(pendulum.batch, force=np.roll(force, 1, axis=1))
    for batch in (late, early):
        finding = _found(pendulum, batch=batch)
        assert not finding.passed.any()
        assert all(where.startswith("inputs a frame") for where in finding.where)
    # Within 40 steps, forces of another seed are as large as the residuals they leave.
    other = draw_batch(pendulum.scene, range(len(force)), seed=77)
    foreign = dataclasses.replace(pendulum.batch, force=other.force[:, : force.shape[1]])
    assert not _found(pendulum, batch=foreign).passed.all()


def test_a_body_one_per_cent_heavier_shows(pendulum: Any) -> None:
    def heavier(body: Body) -> Body:
        (one,) = body.particles
        return msgspec.structs.replace(
            body, particles=(msgspec.structs.replace(one, mass=1.01 * one.mass),)
        )

    *others, last = pendulum.scene.bodies
    scene = msgspec.structs.replace(pendulum.scene, bodies=(*others, heavier(last)))
    finding = _found(pendulum, scene)

    assert not finding.passed.any()
    assert f"mass of {last.name}" in finding.where


def test_inputs_left_out_in_a_single_step_are_named(pendulum: Any, simulate: Any) -> None:
    batch = pendulum.batch
    force = batch.force.copy()
    force[:, 12] = 0.0
    lacking = simulate(pendulum.scene, dataclasses.replace(batch, force=force), 8)
    finding = coefficients.finding(Record(pendulum.scene, batch, lacking, RK4, 2.5e-3))

    assert not finding.passed.any()
    assert (finding.series[:, 13] > 1.0).all()


def test_lagging_velocities_are_put_in_time(
    drawn: Callable[..., Any], simulate: Callable[..., Any]
) -> None:
    scene, batch = drawn(load_scene("3pendulum"), 40)
    motion = simulate(scene, batch, 20, "euler_reduced")
    finding = coefficients.finding(Record(scene, batch, motion, LEAPFROG, 1e-3))

    assert finding.passed.all()
    unknown = coefficients.finding(Record(scene, batch, motion))
    assert unknown.passed.all()


def test_frames_after_a_failure_and_contact_are_left_out(pendulum: Any) -> None:
    velocity = pendulum.exact.velocity.copy()
    velocity[0, 30:] = np.nan
    velocity[1] = np.nan
    broken = dataclasses.replace(
        pendulum, exact=dataclasses.replace(pendulum.exact, velocity=velocity)
    )
    with np.errstate(all="raise"):
        finding = _found(broken)

    assert np.isnan(finding.series[0, 30:]).all()
    assert finding.passed.tolist() == [True, False, True]
    scene = load_scene("ballscroll")
    batch = draw_batch(scene, [0])
    assert coefficients(Record(scene, batch, reference.solve(scene, batch), RK4, 1e-3)) is None


def test_energy_that_nothing_exchanges_with_a_body_tells_nothing_of_its_mass() -> None:
    """A wheel turns alone, and loses a little energy by the method's error."""
    joint = Joint("pin", "hinge", "world", "wheel", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), rate=2.0)
    wheel = Body("wheel", inertia=Inertia(1.0, (0.1, 0.1, 0.1)))
    scene = Scene("alone", (wheel,), 1.0, joints=(joint,))
    batch = draw_batch(scene, [0])
    motion = reference.solve(scene, batch, cache=False)
    slower = 1.0 - 1e-8 * np.arange(len(motion.time))[:, None, None]
    spin = motion.angular_velocity * slower

    slowing = dataclasses.replace(motion, angular_velocity=spin)
    finding = coefficients.finding(Record(scene, batch, slowing, RK4, 2e-3))
    assert (finding.figure < 0.1).all()


def test_what_a_method_takes_late_of_gears_is_no_error_of_gravity() -> None:
    """Wheel and spider exchange a hundred times as much energy as gravity gives them."""
    hub, ring = Inertia(0.1, (4e-6,) * 3), Inertia(0.06, (0.025, 0.044, 0.025))
    bodies = (
        Body("hub", inertia=hub),
        Body("wheel", inertia=Inertia(0.34, (2.6e-4, 4.1e-4, 2.6e-4)), position=(0, 0.0225, 0)),
        Body("ring", inertia=ring),
        Body("spider", inertia=Inertia(0.06, (0.025, 0.025, 0.044))),
    )
    y, origin = (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)
    joints = (
        Joint("king", "hinge", "world", "hub", origin, (0.0, 0.0, 1.0), rate=0.46),
        Joint("axle", "hinge", "hub", "wheel", origin, (3.7e-6, 1.0, 0.0), rate=-0.47),
        Joint("pinion", "hinge", "world", "ring", origin, y, rate=-0.185),
        Joint("cross", "hinge", "ring", "spider", origin, (1.0, 0.0, 0.0), rate=0.3),
    )
    scene = Scene("gears", bodies, 1.0, joints=joints, clock=Clock(0.02, 25))
    batch, method = draw_batch(scene, [0]), load_adapter("dart").methods["semi-implicit-euler"]
    chosen = Settings(method.name, 2e-4)
    motion = run(scene, batch, "dart", chosen).trajectory

    finding = coefficients.finding(Record(scene, batch, motion, method, chosen.step))
    assert finding.passed.all()
    # A method that claims to be exact fails.
    assert not coefficients.finding(Record(scene, batch, motion, RK4, chosen.step)).passed.any()


def _arm(mass: float, moment: float, axis: tuple[float, float, float]) -> Scene:
    """An arm that turns a rotor of 1 kg·m² with a damper of 1 N·m·s/rad."""
    pin = Joint("pin", "hinge", "world", "arm", (0.0, 0.0, 0.0), axis, rate=0.1)
    pin = msgspec.structs.replace(pin, damping=1.0, armature=1.0)
    inertia = Inertia(mass, (moment,) * 3, com=(0.05, 0.0, 0.0))
    return Scene("arm", (Body("arm", inertia=inertia),), 0.1, joints=(pin,), clock=Clock(0.02, 25))


@pytest.mark.parametrize("name", ["pybullet", "dart"])
def test_what_a_method_takes_late_of_rotors_and_dampers_is_no_error_of_masses(name: str) -> None:
    method, step = load_adapter(name).methods["semi-implicit-euler"], 2e-3

    def moved(scene: Scene, claim: Method, other: Scene) -> Finding:
        batch = draw_batch(scene, [0])
        motion = run(scene, batch, name, Settings(method.name, step)).trajectory
        return coefficients.finding(Record(other, batch, motion, claim, step))

    light, heavy = _arm(0.04, 4e-5, (0.0, 0.0, 1.0)), _arm(1.0, 0.1, (0.0, 1.0, 0.0))
    assert moved(light, method, light).passed.all()
    assert moved(heavy, method, heavy).passed.all()
    # A method that claims to be exact fails, and so does a scene with other gravity.
    assert not moved(light, RK4, light).passed.any()
    pull = msgspec.structs.replace(heavy, gravity=(0.0, 0.0, -1.01 * 9.81))
    assert not moved(heavy, method, pull).passed.any()


def test_a_gap_at_a_balanced_rotor_is_no_error_of_gravity() -> None:
    rotor = Body("rotor", inertia=Inertia(2.0, (0.004, 0.004, 0.006)))
    axle = Joint("axle", "hinge", "world", "rotor", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), rate=30.0)
    scene = Scene("rotor", (rotor,), 0.6, joints=(axle,), clock=Clock(0.01, 30))
    batch = draw_batch(scene, [0])
    motion = reference.solve(scene, batch, cache=False)
    motion.position[0, :, 0, 2] += 1e-7 * np.sin(np.arange(31.0))
    assert coefficients.finding(Record(scene, batch, motion, RK4, 2e-3)).passed.all()


def test_damping_within_a_frame_is_no_missing_input() -> None:
    """A block passes the end of a damper, whose work in that frame is not resolved."""
    block = Body("block", inertia=Inertia(1.0, (0.02,) * 3))
    rail = Joint("rail", "slider", "world", "block", (0, 0, 0), (1, 0, 0), -0.52, 3.0)
    ends = ((0.0, 0.0, 0.03), (0.0, 0.0, 0.0))
    scene = Scene(
        "passing",
        (block,),
        1.0,
        gravity=(0, 0, 0),
        joints=(rail,),
        forces=(Force("block", ((0.642, 0.0, 0.0),)),),
        springs=(SpringDamper("damper", ("world", "block"), ends, damping=1.0),),
        clock=Clock(0.08, 12),
    )
    batch = draw_batch(scene, [0])

    motion = reference.solve(scene, batch, cache=False)

    assert coefficients.finding(Record(scene, batch, motion, RK4, 0.08)).passed.all()

"""DART's peculiarities, and exact answers on small scenes."""

import gc
import math
import weakref
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
    Torque,
)
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.registry import load_adapter, load_scene
from tests.adapters.exact import gimbal_followed

dartpy = pytest.importorskip("dartpy")

ENGINE = load_adapter("dart")
RK4, EULER = "forward-dynamics-RK4", "semi-implicit-euler"
SECOND = Clock(steps=50)
BRICK = Inertia(2.0, (0.05, 0.08, 0.1), (0.01, -0.005, 0.02), com=(0.15, 0.02, 0.05))


def roll(scene: Scene, method: str, substeps: int, **options: float) -> Trajectory:
    with ENGINE.open(scene, Settings(method, scene.clock.frame / substeps, options)) as run:
        return run.rollout(draw_batch(scene, [0]))


def test_semi_implicit_euler_falls_half_a_step_too_far() -> None:
    body = Body("brick", inertia=BRICK, velocity=(1.0, 0.0, 0.0))
    motion = roll(Scene("drop", (body,), length=1.0), EULER, 4)
    moved = motion.position[0, :, 0] - np.array(BRICK.com)
    drop = 0.5 * 9.81 * motion.time * (motion.time + 0.005)
    np.testing.assert_allclose(moved[:, 2], -drop, rtol=0, atol=1e-10)
    np.testing.assert_allclose(moved[:, 0], motion.time, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("method", "substeps", "near"), [(RK4, 10, 1e-6), (EULER, 400, 3e-3)])
def test_spring_and_damper_between_two_bodies(method: str, substeps: int, near: float) -> None:
    bodies = tuple(
        Body(name, inertia=Inertia(mass, (0.1, 0.2, 0.2)), position=(x, 0.0, 0.0))
        for name, mass, x in (("a", 1.0, 0.0), ("b", 3.0, 1.0))
    )
    ends = ((0.1, 0.0, 0.0), (0.8, 0.0, 0.0))
    spring = SpringDamper("s", ("a", "b"), ends, stiffness=30.0, damping=1.0, rest_length=0.5)
    still = (0.0, 0.0, 0.0)
    scene = Scene("pull", bodies, 1.0, gravity=still, springs=(spring,), clock=SECOND)
    motion = roll(scene, method, substeps)
    reduced = 1.0 * 3.0 / 4.0
    decay = 1.0 / (2.0 * reduced)
    beat = math.sqrt(30.0 / reduced - decay**2)
    phase = beat * motion.time
    exact = 0.2 * np.exp(-decay * motion.time) * (np.cos(phase) + decay / beat * np.sin(phase))
    apart = motion.position[0, :, 1, 0] - motion.position[0, :, 0, 0] - 0.8
    np.testing.assert_allclose(apart, exact, rtol=0, atol=near)


@pytest.mark.parametrize("name", ["6pendulum", "2ladder", "workbench"])
def test_the_engine_holds_the_scene(name: str) -> None:
    scene = load_scene(name)
    batch = draw_batch(scene, [2]).truncated(1)
    settings = ENGINE.settings(scene, "matched")
    with ENGINE.open(scene, settings) as run:
        read = run.readback(batch)
        motion = run.rollout(batch)
    assert compare(Mechanism.of(scene), batch, settings, read) == []
    assert read.joint_axis is not None
    assert np.isfinite(read.joint_axis).any() == any(j.axis for j in scene.joints)
    for key in ("position", "orientation", "velocity", "angular_velocity"):
        np.testing.assert_allclose(
            getattr(motion, key)[:, 0], getattr(batch, key), rtol=0, atol=1e-12
        )


def test_coordinates_are_what_the_engine_moves() -> None:
    """Body states computed from DART's coordinates agree with DART's own during a motion."""
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [2]).truncated(10)
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        motion = run.rollout(batch)
        bodies = run._model.bodies  # type: ignore[attr-defined]
        places = np.array([body.getCOM() for body in bodies])
        speeds = np.array([body.getCOMLinearVelocity() for body in bodies])
        spins = np.array([body.getAngularVelocity() for body in bodies])
    np.testing.assert_allclose(motion.position[0, -1], places, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.velocity[0, -1], speeds, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.angular_velocity[0, -1], spins, rtol=0, atol=1e-9)


def test_a_blow_up_ends_its_trajectory_only(capfd: pytest.CaptureFixture[str]) -> None:
    scene = load_scene("6pendulum")
    batch = draw_batch(scene, [2, 0]).truncated(100)
    batch.velocity[0] *= 1e3
    batch.angular_velocity[0] *= 1e3
    with ENGINE.open(scene, Settings(EULER, 0.02)) as run:
        motion = run.rollout(batch)
    failure = motion.failures[0]
    assert failure is not None
    assert np.isnan(motion.position[0, failure.frame :]).all()
    assert np.isfinite(motion.position[0, : failure.frame]).all()
    assert motion.failures[1] is None
    assert np.isfinite(motion.position[1]).all()
    assert capfd.readouterr().err == ""


def test_the_listing_runs_by_itself() -> None:
    scene = load_scene("2ladder")
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        text = run.native(draw_batch(scene, [0]))
    names: dict[str, Any] = {}
    exec(text, names)
    assert names["skeleton"].getMass() == pytest.approx(scene.particle_count)
    views = [names["bodies"][k].getShapeNode(0).getVisualAspect() for k in range(len(scene.bodies))]
    assert all(aspect is not None for aspect in views)


def _geared_wheel() -> tuple[Scene, float]:
    """Return a wheel whose rotor a torque turns against a servo, and its angle after 1 s [rad]."""
    moment, armature, stiffness, torque = 0.2, 0.3, 20.0, 0.5
    scene = Scene(
        "wheel",
        (Body("wheel", inertia=Inertia(1.0, (0.2, 0.2, moment))),),
        1.0,
        joints=(Joint("axle", "hinge", "world", "wheel", (0, 0, 0), (0, 0, 1), armature=armature),),
        torques=(Torque("axle", (torque,)),),
        servos=(Servo("axle", (0.0,), stiffness=stiffness, limit=1e3),),
        clock=SECOND,
    )
    beat = math.sqrt(stiffness / (moment + armature))
    return scene, torque / stiffness * (1.0 - math.cos(beat * SECOND.steps * SECOND.frame))


@pytest.mark.parametrize(("method", "near"), [(RK4, 1e-9), (EULER, 1e-4)])
def test_a_torque_and_a_servo_act_beside_a_rotor(method: str, near: float) -> None:
    scene, exact = _geared_wheel()

    turn = rotation.to_vector(roll(scene, method, 20).orientation[0, -1, 0])

    assert turn[2] == pytest.approx(exact, abs=near)


def test_a_listing_has_the_servo_and_the_rotor_too() -> None:
    scene = msgspec.structs.replace(_geared_wheel()[0], torques=(), clock=Clock(steps=10))
    joint = msgspec.structs.replace(scene.joints[0], rate=2.0)
    scene = msgspec.structs.replace(scene, joints=(joint,))
    with ENGINE.open(scene, Settings(EULER, 0.001)) as run:
        batch, names = draw_batch(scene, [0]), dict[str, Any]()
        exec(run.native(batch), names)
        motion = run.rollout(batch)

    spin = names["bodies"][0].getAngularVelocity()
    np.testing.assert_allclose(spin, motion.angular_velocity[0, -1, 0], rtol=0, atol=1e-12)


def test_impulses_pass_implicit_dampers_by() -> None:
    """Rotors need stops of their own: a stopped slider would turn its arm wrongly."""
    rates = []
    for damping in (0.0, 5e3):
        world, skeleton = dartpy.simulation.World(), dartpy.dynamics.Skeleton()
        world.setTimeStep(1e-3)
        world.setGravity([0.0, 0.0, 0.0])
        rail, block = skeleton.createPrismaticJointAndBodyNodePair(None)
        pin, arm = skeleton.createRevoluteJointAndBodyNodePair(block)
        for joint, axis in ((rail, [1.0, 0.0, 0.0]), (pin, [0.0, 1.0, 0.0])):
            joint.setAxis(axis)
        arm.setInertia(dartpy.dynamics.Inertia(1.0, [0.0, 0.0, -0.5], 0.1 * np.eye(3)))
        pin.setDampingCoefficient(0, damping)
        rail.setPositionUpperLimit(0, 0.0)
        rail.setLimitEnforcement(True)
        world.addSkeleton(skeleton)
        skeleton.setVelocities([1.0, 0.0])
        world.step(False)
        rates.append(pin.getVelocity(0))

    assert rates[0] == pytest.approx(rates[1], rel=1e-9)
    assert abs(rates[0]) > 1.0


def test_a_stop_turns_an_arm_by_its_inertia_and_its_rotor() -> None:
    """No impulse acts about the pin, so the block's loss and the arm's gain are known."""
    mass, moment, arm, armature, rate = 1.0, 0.1, 0.5, 5.0, 0.2
    still = (0.0, 0.0, 0.0)
    scene = Scene(
        "cart",
        (
            Body("block", inertia=Inertia(2.0, (1.0, 1.0, 1.0))),
            Body("bob", position=(0.0, 0.0, -arm), inertia=Inertia(mass, (moment,) * 3)),
        ),
        1.0,
        gravity=still,
        joints=(
            Joint("rail", "slider", "world", "block", still, (1, 0, 0), rate=1.0, limits=(-1, 0)),
            Joint("pin", "hinge", "block", "bob", still, (0, 1, 0), rate=rate, armature=armature),
        ),
        clock=Clock(frame=1e-3, steps=1),
    )

    motion = roll(scene, EULER, 1)

    kicked = rate + mass * -arm / (moment + mass * arm**2 + armature)
    assert motion.velocity[0, 1, 0, 0] == pytest.approx(0.0, abs=1e-8)
    assert motion.angular_velocity[0, 1, 1, 1] == pytest.approx(kicked, abs=1e-6)


@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_a_hinge_closes_a_loop_of_bodies_that_are_centred_on_it(off: float) -> None:
    gimbal_followed(ENGINE, off)


def test_process_wide_parameters_are_put_back() -> None:
    loop = dartpy.constraint.BallJointConstraint
    before = loop.getErrorReductionParameter()
    roll(load_scene("2ladder"), EULER, 20, error_reduction=0.7)
    assert loop.getErrorReductionParameter() == before


def test_what_it_cannot_do_is_refused() -> None:
    points = ((0.0, 0.0, 1.0), (0.15, 0.0, 0.0))
    link = DistanceLink("link", ("world", "brick"), points)
    tied = Scene("tied", (Body("brick", inertia=BRICK),), 1.0, distance_links=(link,))
    with pytest.raises(Unsupported, match="distance"):
        ENGINE.open(tied, Settings(EULER, 0.001))
    with pytest.raises(Unsupported, match="without constraints"):
        ENGINE.open(load_scene("2ladder"), Settings(RK4, 0.001))
    with pytest.raises(InputError, match="error_reduction"):
        ENGINE.open(load_scene("2ladder"), Settings(EULER, 0.001, {"error_reduction": 1.5}))


def test_closing_frees_the_engine_at_once() -> None:
    run = ENGINE.open(load_scene("2ladder"), Settings(EULER, 0.001))
    world = weakref.ref(run._model.world)  # type: ignore[attr-defined]
    gc.disable()
    try:
        run.close()
        assert world() is None
    finally:
        gc.enable()
    run.close()

"""Contact in DART: friction, impacts, rolling, rest and flight, against exact answers."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import UnknownName, Unsupported
from mbds_xsim.checks.conservation import energy_of
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Scene, Torque, Vector
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.readback import compare
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.collision_cases import Flying, balls
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball, gaps, laid_cubli, rolling
from tests.adapters.exact import balldrop_followed, ballscroll_followed
from tests.over_ground import over_ground

dartpy: Any = pytest.importorskip("dartpy")

ENGINE = load_adapter("dart")
ROUND = {"collision_detector": "ode", "friction_solver": "nsgs"}
G, MU, E = 9.81, 0.43, 0.9332
STILL = (0.0, 0.0, 0.0)
replaced = msgspec.structs.replace


def matched(scene: Scene) -> Settings:
    return settings_for(scene, ENGINE, "matched")


def careful(steps_per_frame: int, **options: str) -> Settings:
    return Settings("semi-implicit-euler", 0.02 / steps_per_frame, ROUND | options)


def rollout(scene: Scene, batch: Batch, settings: Settings | None = None) -> Trajectory:
    with ENGINE.open(scene, settings or matched(scene)) as run:
        return run.rollout(batch)


@pytest.mark.parametrize("noise", [False, True])
def test_ballscroll_follows_the_exact_solution(noise: bool) -> None:
    motion = ballscroll_followed(rollout, noise=noise, within=2e-3)

    assert not motion.position[..., 1].any()


@pytest.mark.parametrize("noise", [False, True])
def test_balldrop_follows_the_exact_solution(noise: bool) -> None:
    motion = balldrop_followed(rollout, 6, noise=noise, apex=0.02, flight=5e-4)

    assert np.abs(motion.position[..., 1]).max() < 1e-12
    assert motion.position[..., 2].min() > 5 * R - 0.01


@pytest.mark.parametrize("detector", ["ode", "fcl", "bullet", "dart"])
def test_a_ball_slides_then_rolls_alike_in_every_direction(detector: str) -> None:
    case = rolling()
    motion = rollout(case.scene, case.batch, careful(20, collision_detector=detector))

    # First order: μ g h t / 2 too far while it slides.
    off = np.abs(motion.position - case.exact.position).max(axis=(0, 2, 3))
    assert np.all(off <= 0.5 * case.drift * 1e-3 + 1e-4)
    end = motion.velocity[:, -1, 0, :2]
    np.testing.assert_allclose(end, case.exact.velocity[:, -1, 0, :2], rtol=1e-6, atol=1e-9)


def test_friction_of_an_ordinary_user_is_bounded_by_a_box() -> None:
    """Box friction at 45° is √2 times Coulomb's; along x it is Coulomb's."""
    for heading, factor in ((0.0, 1.0), (math.pi / 4, math.sqrt(2.0))):
        velocity = (7 * math.cos(heading), 7 * math.sin(heading), 0.0)
        scene = ball(velocity=velocity, steps=10)
        settings = ENGINE.settings(scene, "native")
        assert not settings.options
        motion = rollout(scene, draw_batch(scene, [0]), settings)
        slowed = 7 - np.linalg.norm(motion.velocity[0, -1, 0])
        assert slowed == pytest.approx(factor * MU * G * 0.2, rel=1e-2)


@pytest.mark.parametrize("restitution", [0.0, 0.5, E, 1.0])
@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0, 8.0])
def test_restitution_is_the_scenes_at_every_speed(restitution: float, speed: float) -> None:
    scene = ball(0.02 * speed, velocity=(0.0, 0.0, -speed), ground=Ground(MU, restitution), steps=2)
    scene = replaced(scene, gravity=STILL)
    motion = rollout(scene, draw_batch(scene, [0]), careful(100))
    assert motion.velocity[0, -1, 0, 2] == pytest.approx(restitution * speed, rel=2e-5, abs=1e-3)


def test_slow_rebounds_do_not_happen() -> None:
    """DART's own limit, compiled in: what would rebound below 0.1 m/s stays down."""
    for speed, rebound in ((0.099 / E, 0.0), (0.101 / E, 0.101)):
        scene = ball(0.005 * speed, velocity=(0.0, 0.0, -speed), steps=1)
        scene = replaced(scene, gravity=STILL)
        motion = rollout(scene, draw_batch(scene, [0]), careful(100))
        assert motion.velocity[0, -1, 0, 2] == pytest.approx(rebound, abs=1.1e-3)


def test_an_elastic_ball_gains_what_gravity_adds_in_the_step_of_an_impact() -> None:
    """DART reflects the velocity after the step's gravity, so a bounce gains the energy V g h."""
    gains = []
    for count in (50, 100):
        scene = ball(1.0, ground=Ground(MU, 1.0), steps=200)
        motion = rollout(scene, draw_batch(scene, [0]), careful(count))
        speed = motion.velocity[0, :, 0, 2]
        energy = 0.5 * speed**2 + G * (motion.position[0, :, 0, 2] - R)
        # Semi-implicit Euler conserves this energy in flight.
        conserved = energy - 0.5 * G * 0.02 / count * speed
        bounces = np.flatnonzero(np.diff(speed) > 0.5)
        gains.append((conserved[bounces[-1] + 1] - conserved[0]) / len(bounces))
        assert gains[-1] == pytest.approx(math.sqrt(2 * G) * G * 0.02 / count, rel=0.1)
    assert gains[0] / gains[1] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("offset", [(0.1, 0.0, -0.2), (0.3, 0.1, -0.1), (0.0, 0.25, -0.05)])
def test_an_eccentric_impact_is_newtons_and_coulombs(offset: Vector) -> None:
    """One impact off the centre of mass; at high restitution its law may even add energy."""
    height = 0.01 + 0.05 - offset[2]
    inertia = Inertia(2.0, (0.05, 0.08, 0.1), com=(0.0, 0.0, height))
    body = Body("brick", inertia=inertia, velocity=(0.4, 0.2, -3.0))
    centre = (offset[0], offset[1], 0.01 + 0.05)
    scene = over_ground(body, centre, 0.05, Ground(MU, E), gravity=STILL, clock=Clock(steps=1))
    arm = np.array([*offset[:2], offset[2] - 0.05])
    skew = np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
    yielding = np.eye(3) / 2.0 - skew @ np.diag([1 / 0.05, 1 / 0.08, 1 / 0.1]) @ skew
    before = np.array([0.4, 0.2, -3.0])
    impulse = newton_coulomb(yielding, before)
    motion = rollout(scene, draw_batch(scene, [0]), careful(400))
    np.testing.assert_allclose(motion.velocity[0, 1, 0], before + impulse / 2.0, rtol=0, atol=3e-3)
    spin = np.cross(arm, impulse) / [0.05, 0.08, 0.1]
    # The brick turns for half the frame after the impact, so its spin changes (Euler).
    assert np.linalg.norm(motion.angular_velocity[0, 1, 0] - spin) < 0.1 * np.linalg.norm(spin)


def newton_coulomb(yielding: Array, before: Array) -> Array:
    """Impulse of Newton's restitution with Coulomb's cone, by fixed-point projection."""
    target = np.array([0.0, 0.0, -E * before[2]])
    impulse, step = np.zeros(3), 0.5 / np.trace(yielding)
    for _ in range(20_000):
        impulse = impulse - step * (before + yielding @ impulse - target)
        impulse[2] = max(impulse[2], 0.0)
        sideways = float(np.hypot(*impulse[:2]))
        impulse[:2] *= min(1.0, MU * impulse[2] / sideways) if sideways else 1.0
    return impulse


@pytest.mark.parametrize("scene", [ball(), laid_cubli(25)], ids=["ball", "cubli"])
@pytest.mark.parametrize("options", [{}, ROUND], ids=["default", "round"])
def test_what_rests_stays_at_rest(scene: Scene, options: dict[str, str]) -> None:
    settings = Settings("semi-implicit-euler", 5e-4, options)
    motion = rollout(scene, draw_batch(scene, [0]), settings)
    assert np.abs(motion.position - motion.position[:, :1]).max() < 1e-6
    assert np.abs(motion.velocity).max() < 1e-5


def even_car(rate: float, torque: float, steps: int) -> Scene:
    """Return the car without noise, all wheels at one rate and under one torque."""
    car = load_scene("particlecar")
    wheels = tuple(joint.name for joint in car.joints)
    return replaced(
        car,
        torques=tuple(Torque(name, (torque,)) for name in wheels) if torque else (),
        sampling=(HingeRate(wheels, rate=(rate, rate), travel=(0.2, 0.0, 0.0)),),
        noise=0.0,
        clock=Clock(steps=steps),
    )


def test_the_car_drives_at_a_hundred_radians_a_second() -> None:
    scene = even_car(100.0, 0.0, 25)
    motion = rollout(scene, draw_batch(scene, [0]), careful(20))
    np.testing.assert_allclose(motion.position[0, :, 0, 0], 20.0 * motion.time, atol=1e-7)
    np.testing.assert_allclose(motion.angular_velocity[0, :, 1:, 1], 100.0, rtol=1e-9)
    assert np.abs(gaps(scene, motion)).max() < 1e-7


def test_a_car_that_takes_more_sweeps_than_darts_own_gets_them() -> None:
    """A hundred sweeps leave a contact residual of 3.2 mm/s in a step of this start."""
    scene = load_scene("particlecar")
    motion = rollout(scene, draw_batch(scene, [296], seed=4242).truncated(180))

    assert motion.failures == (None,)
    assert gaps(scene, motion).min() > -1e-3


def test_drawn_cars_converge_with_the_step() -> None:
    """The wheels' shares of the weight must not depend on where the solver stops."""
    scene = load_scene("particlecar")
    batch = draw_batch(scene, [2], seed=1).truncated(50)
    ends = [rollout(scene, batch, careful(n)).position[0, -1, 0] for n in (10, 20, 40)]
    coarse, fine = (np.linalg.norm(b - a) for a, b in pairwise(ends))
    assert fine < 2e-3
    assert coarse / fine == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("ground", [Ground(0.0, E), Ground(MU, 0.5)], ids=["smooth", "rough"])
def test_the_cubli_gains_no_energy_on_the_ground(ground: Ground) -> None:
    """Newton's law itself adds energy where rough corners rebound almost elastically."""
    scene = replaced(load_scene("simplecubli"), ground=ground)
    batch = draw_batch(scene, range(2), seed=3, noise=False, inputs=False).truncated(100)
    motion = rollout(scene, batch, careful(80))
    energy = energy_of(Record(scene, batch, motion))
    free = gaps(scene, motion).min(axis=-1) > 0
    for row in range(len(batch)):
        airborne = energy.total[row][free[row]]
        rise = (airborne - np.minimum.accumulate(airborne)).max()
        assert rise < 1e-3 * energy.scale[row]
    assert gaps(scene, motion).min() > -0.02 * scene.length


def test_a_model_with_other_coefficients_is_told_from_the_scene() -> None:
    scene = load_scene("particlecar")
    batch, settings = draw_batch(scene, [2]), matched(scene)
    with ENGINE.open(scene, settings) as run:
        shapes = run._model.shapes  # type: ignore[attr-defined]
        shapes[0].getDynamicsAspect().setFrictionCoeff(0.3)
        shapes[1].getDynamicsAspect().setRestitutionCoeff(0.5)
        differences = compare(Mechanism.of(scene), batch, settings, run.readback(batch))
    assert [line.partition(" of ")[0] for line in differences] == ["friction", "restitution"]


@pytest.mark.parametrize(
    ("height", "speed", "reason"),
    [(3.0, 120.0, "hits the ground at 120.*cuts rebounds to 100"), (1.0, 90.0, "in the ground")],
)
def test_what_contact_cannot_do_ends_the_trajectory(
    height: float, speed: float, reason: str
) -> None:
    scene = ball(height, velocity=(0.0, 0.0, -speed), steps=5)
    motion = rollout(scene, draw_batch(scene, [0]), careful(1))
    failure = motion.failures[0]
    assert failure is not None
    assert re.search(reason, failure.reason)
    assert np.isnan(motion.position[0, failure.frame :]).all()
    assert np.isfinite(motion.position[0, : failure.frame]).all()


def test_a_contact_solver_that_fails_ends_the_trajectory() -> None:
    scene = ball(0.05, steps=10)
    with ENGINE.open(scene, careful(10)) as run:
        world = run._model.world  # type: ignore[attr-defined]
        solver = world.getConstraintSolver().getBoxedLcpSolver()
        options = solver.getOptions()
        options.maxSweeps = -1
        solver.setOptions(options)
        failure = run.rollout(draw_batch(scene, [0])).failures[0]
    assert failure is not None
    # It falls for 0.101 s.
    assert failure.frame == 6
    assert "contact solver failed" in failure.reason


def test_what_dart_cannot_mean_is_refused() -> None:
    for ground, coefficient in ((Ground(5e-4, E), "friction"), (Ground(MU, 5e-4), "restitution")):
        with pytest.raises(Unsupported, match=f"ground.{coefficient}: got 0.0005"):
            ENGINE.open(replaced(ball(), ground=ground), careful(20))
    lively = balls([Flying((0.0, 0.0, 1.0)), Flying((0.3, 0.0, 1.0))], ground=Ground(MU, 0.9))
    assert lively.collisions is not None
    dull = replaced(lively, collisions=replaced(lively.collisions, restitution=0.8))
    with pytest.raises(Unsupported, match=r"at least the ground's squared, 0.81"):
        ENGINE.open(dull, careful(20))
    with pytest.raises(UnknownName, match="ode"):
        ENGINE.open(ball(), careful(20, collision_detector="eyes"))
    with pytest.raises(UnknownName, match="nsgs"):
        ENGINE.open(ball(), careful(20, friction_solver="hope"))
    with pytest.raises(Unsupported, match="without impacts"):
        ENGINE.open(ball(), Settings("forward-dynamics-RK4", 0.02))


def test_scenes_without_contact_have_no_ground() -> None:
    scene = load_scene("5pendulum")
    with ENGINE.open(scene, Settings("semi-implicit-euler", 0.02)) as run:
        assert run.size.contact_pairs == 0
        assert run._model.world.getNumSkeletons() == 1  # type: ignore[attr-defined]
        text = run.native(draw_batch(scene, [0]))
        assert "PlaneShape" not in text


def test_the_listing_alone_gives_the_same_motion() -> None:
    scene = ball(0.1, velocity=(1.0, 2.0, 0.0), steps=20)
    batch = draw_batch(scene, [0])
    with ENGINE.open(scene, careful(20)) as run:
        expected, text = run.rollout(batch), run.native(batch)
    names: dict[str, Any] = {}
    exec(text, names)
    position = names["skeleton"].getPositions()[3:]
    np.testing.assert_allclose(position, expected.position[0, -1, 0], rtol=0, atol=1e-12)

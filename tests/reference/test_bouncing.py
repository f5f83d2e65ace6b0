"""The reference for balls on the ground, against closed forms."""

from __future__ import annotations

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import sensitivity, solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Force, Ground, Inertia, Scene, Vector
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing import contact_cases

G, MU = 9.81, 0.43
MASS, MOMENT = 1.0, 6.17e-4
RADIUS = math.sqrt(2.5 * MOMENT / MASS)
CLOCK = Clock()
EAST = (1.0, 0.0)
NORTH_EAST = (math.sqrt(0.5), math.sqrt(0.5))


def ball(
    *,
    height: float = 0.0,
    velocity: Vector = (0.0, 0.0, 0.0),
    spin: Vector = (0.0, 0.0, 0.0),
    friction: float = MU,
    restitution: float = 0.9332,
    forces: tuple[Force, ...] = (),
    clock: Clock = CLOCK,
) -> Scene:
    """Make a homogeneous sphere whose lowest point starts at a height."""
    plain = contact_cases.ball(height, velocity, spin, Ground(friction, restitution))
    return msgspec.structs.replace(plain, forces=forces, clock=clock)


def run(scene: Scene) -> Trajectory:
    """Solve the scene's own start."""
    result = solve(scene, draw_batch(scene, [0]), cache=False)
    assert result.failures == (None,)
    return result


def slip(result: Trajectory, radius: float = RADIUS) -> Array:
    """Horizontal velocity of the lowest point, shape (frame, 2)."""
    spin = result.angular_velocity[0, :, 0]
    return result.velocity[0, :, 0, :2] + radius * np.stack([-spin[:, 1], spin[:, 0]], axis=-1)


def rolling_spin(velocity: Array) -> Vector:
    """Angular velocity with which a ball rolls at a velocity in the plane."""
    return (-velocity[1] / RADIUS, velocity[0] / RADIUS, 0.0)


def energy(result: Trajectory) -> Array:
    motion = np.sum(result.velocity[0, :, 0] ** 2, axis=-1)
    spin = np.sum(result.angular_velocity[0, :, 0] ** 2, axis=-1)
    return np.asarray(
        0.5 * (MASS * motion + MOMENT * spin) + MASS * G * result.position[0, :, 0, 2]
    )


@pytest.mark.parametrize("heading", [EAST, NORTH_EAST, (-0.6, 0.8)])
@pytest.mark.parametrize(("speed", "share"), [(7.0, 0.0), (9.3, 0.4), (2.0, -3.0), (1.0, 2.5)])
def test_slides_then_rolls(heading: tuple[float, float], speed: float, share: float) -> None:
    """Textbook: t = 2 (v₀ − ω₀ r) / (7 μ g), then v = (5 v₀ + 2 ω₀ r) / 7; also spun too fast."""
    along = np.array(heading)
    spin = tuple(share * np.array(rolling_spin(speed * along)))
    result = run(ball(velocity=(*(speed * along).tolist(), 0.0), spin=spin))
    time = result.time
    lag = speed * (1.0 - share)
    end = 2.0 * abs(lag) / (7.0 * MU * G)
    assert 0.02 < end < 4.0
    braking = math.copysign(MU * G, lag)
    sliding = speed * time - 0.5 * braking * time**2
    final = speed * (5.0 + 2.0 * share) / 7.0
    rolled = speed * end - 0.5 * braking * end**2 + final * (time - end)
    distance = np.where(time < end, sliding, rolled)
    expected = np.append(distance[:, None] * along, np.full((len(time), 1), RADIUS), axis=1)
    np.testing.assert_allclose(result.position[0, :, 0], expected, rtol=0, atol=1e-13)
    velocity = np.where(time < end, speed - braking * time, final)
    np.testing.assert_allclose(result.velocity[0, :, 0, :2] @ along, velocity, rtol=0, atol=1e-13)
    assert np.abs(slip(result)[time > end]).max() < 1e-13


def test_sideways_spin_bends_the_path_into_a_parabola() -> None:
    """A homogeneous ball keeps the direction of its slip, so its acceleration is constant."""
    start, spin = np.array([4.0, 1.0]), (60.0, -20.0, 35.0)
    result = run(ball(velocity=(4.0, 1.0, 0.0), spin=spin))
    slipping = start + RADIUS * np.array([-spin[1], spin[0]])
    speed = float(np.linalg.norm(slipping))
    end = 2.0 * speed / (7.0 * MU * G)
    t = result.time[:, None]
    assert 0.2 < end < 4.0
    bend = -MU * G * slipping / speed
    during = start * t + 0.5 * bend * t**2
    after = start * end + 0.5 * bend * end**2 + (start + bend * end) * (t - end)
    expected = np.where(t < end, during, after)
    np.testing.assert_allclose(result.position[0, :, 0, :2], expected, rtol=0, atol=1e-13)
    assert abs(start[0] * slipping[1] - start[1] * slipping[0]) > 1.0  # it does bend
    np.testing.assert_array_equal(result.angular_velocity[0, :, 0, 2], spin[2])


def test_orientation_under_a_turning_axis() -> None:
    """The published angular velocity, integrated as a quaternion, gives the orientation."""
    result = run(ball(velocity=(4.0, 1.0, 0.0), spin=(6.0, -2.0, 30.0), clock=Clock(0.02, 14)))
    start, spin = np.array([4.0, 1.0]), np.array([6.0, -2.0, 30.0])
    slipping = start + RADIUS * np.array([-spin[1], spin[0]])
    gain = 2.5 * MU * G / RADIUS * np.array([-slipping[1], slipping[0], 0.0])
    gain /= np.linalg.norm(slipping)

    def rate(t: float, q: Array) -> Array:
        w = spin + gain * t
        return 0.5 * np.append(-w @ q[1:], w * q[0] + np.cross(w, q[1:]))

    exact = solve_ivp(
        rate, (0, 0.28), [1, 0, 0, 0], method="DOP853", rtol=1e-13, atol=1e-13, t_eval=result.time
    )
    np.testing.assert_allclose(result.orientation[0, :, 0], exact.y.T, rtol=0, atol=1e-11)


@pytest.mark.parametrize("heading", [EAST, NORTH_EAST])
def test_rolls_under_a_held_force(heading: tuple[float, float]) -> None:
    """A force at the centre of a rolling sphere accelerates it at 5/7 of F/m."""
    force = 2.5 * np.array(heading)
    result = run(ball(forces=(Force("ball", ((*force.tolist(), 0.0),)),)))
    expected = 0.5 * 5.0 / 7.0 * force / MASS * result.time[:, None] ** 2
    np.testing.assert_allclose(result.position[0, :, 0, :2], expected, rtol=0, atol=1e-12)
    assert np.abs(slip(result)).max() < 1e-12


@pytest.mark.parametrize(("share", "slips"), [(0.999, False), (1.001, True)])
def test_static_friction_has_its_limit(share: float, slips: bool) -> None:
    """Rolling needs 2/7 of the force as friction, at most μ m g; so F = 7/2 μ m g is the limit."""
    strength = share * 3.5 * MU * MASS * G
    result = run(ball(forces=(Force("ball", ((0.0, strength, 0.0),)),)))
    braking = MU * G if slips else 2.0 / 7.0 * strength / MASS
    expected = 0.5 * (strength / MASS - braking) * result.time**2
    np.testing.assert_allclose(result.position[0, :, 0, 1], expected, rtol=0, atol=1e-11)
    assert (abs(slip(result)[-1, 1]) > 1e-3) == slips


def test_slides_on_where_a_force_overcomes_friction() -> None:
    """The force acts against the slip at first: the slip stops, turns round and grows."""
    strength = 5.0 * MU * MASS * G
    result = run(ball(velocity=(2.0, 0.0, 0.0), forces=(Force("ball", ((-strength, 0.0, 0.0),)),)))
    drive, brake = strength / MASS, 3.5 * MU * G
    end = 2.0 / (drive + brake)
    t = result.time
    slipping = np.where(t < end, 2.0 - (drive + brake) * t, -(drive - brake) * (t - end))
    np.testing.assert_allclose(slip(result)[:, 0], slipping, rtol=0, atol=1e-12)


def test_force_across_the_slip() -> None:
    """Newton–Euler equations with Coulomb friction give the path while the slip turns."""
    force, start = np.array([1.5, 6.0]), np.array([5.0, -2.0])
    scene = ball(
        velocity=(*start.tolist(), 0.0),
        spin=(0.0, 20.0, 0.0),
        forces=(Force("ball", ((*force.tolist(), 0.0),)),),
    )
    result = run(scene)

    def rate(_: float, y: Array) -> Array:
        velocity, spin = y[2:4], y[4:]
        at = velocity + RADIUS * np.array([-spin[1], spin[0]])
        friction = -MU * MASS * G * at / np.linalg.norm(at)
        gain = RADIUS / MOMENT * np.array([friction[1], -friction[0]])
        return np.concatenate([velocity, (force + friction) / MASS, gain])

    begin = np.concatenate([np.zeros(2), start, [0.0, 20.0]])
    times = result.time[:15]
    exact = solve_ivp(
        rate, (0, times[-1]), begin, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=times
    )
    np.testing.assert_allclose(result.position[0, :15, 0, :2], exact.y[:2].T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        result.angular_velocity[0, :15, 0, :2], exact.y[4:].T, rtol=0, atol=1e-10
    )
    assert np.linalg.norm(slip(result)[14]) > 0.1  # still sliding
    assert np.abs(slip(result)[-1]).max() < 1e-12  # and rolling in the end


@pytest.mark.parametrize("restitution", [0.5, 0.9332, 1.0])
def test_bounce_ladder(restitution: float) -> None:
    """Heights e²ᵏ h at the known times of the tops; e = 0 and rest are tested below."""
    drop = 1.0
    fall = math.sqrt(2.0 * drop / G)
    for bounces in (1, 2, 3):
        ups = [restitution**k for k in range(1, bounces + 1)]
        top = fall * (1.0 + 2.0 * sum(ups[:-1]) + ups[-1])
        scene = ball(height=drop, restitution=restitution, clock=Clock(top / 30, 30))
        result = run(scene)
        height = result.position[0, -1, 0, 2] - RADIUS
        assert height == pytest.approx(drop * restitution ** (2 * bounces), abs=1e-14)
        assert abs(result.velocity[0, -1, 0, 2]) < 1e-13


def test_no_restitution_stays_down() -> None:
    result = run(ball(height=0.5, restitution=0.0))
    fall = math.sqrt(2 * 0.5 / G)
    late = result.time > fall
    np.testing.assert_array_equal(result.position[0, late, 0, 2], RADIUS)
    np.testing.assert_array_equal(result.velocity[0, late, 0], 0.0)
    assert late.sum() > 100


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.8])
def test_bounces_end_in_time(restitution: float) -> None:
    """Zeno: all bounces after a fall of duration t last 2 t e / (1 − e)."""
    drop, frame = 0.2, 1e-3
    fall = math.sqrt(2.0 * drop / G)
    end = fall + 2.0 * fall * restitution / (1.0 - restitution)
    steps = math.ceil(1.2 * end / frame)
    result = run(ball(height=drop, restitution=restitution, clock=Clock(frame, steps)))
    height = result.position[0, :, 0, 2] - RADIUS
    assert (height[result.time > end] == 0.0).all()
    assert (height[(result.time > fall) & (result.time < end - 2 * frame)] > 0.0).any()
    short = run(ball(height=drop, restitution=restitution, clock=Clock((end - 1e-6) / 50, 50)))
    assert short.velocity[0, -1, 0, 2] != 0.0
    after = run(ball(height=drop, restitution=restitution, clock=Clock((end + 1e-9) / 50, 50)))
    assert after.velocity[0, -1, 0, 2] == 0.0


def test_endless_bounces_are_given_up() -> None:
    """Without loss, a ball at 1e-9 m/s would have ten million impacts in a frame."""
    scene = ball(velocity=(0.0, 0.0, 1e-9), restitution=1.0, clock=Clock(0.02, 3))
    (failure,) = solve(scene, draw_batch(scene, [0]), cache=False).failures
    assert failure is not None
    assert failure.frame == 1
    assert "cannot be continued between 0 and 0.02 s: more than 20000 impacts" in failure.reason


def test_start_on_the_ground_does_not_bounce() -> None:
    result = run(ball(velocity=(3.0, 0.0, 0.0)))
    np.testing.assert_array_equal(result.position[0, :, 0, 2], RADIUS)
    np.testing.assert_array_equal(result.velocity[0, :, 0, 2], 0.0)


@pytest.mark.parametrize(("across", "sticks"), [(3.0, True), (12.0, False)])
@pytest.mark.parametrize("heading", [EAST, NORTH_EAST])
def test_oblique_impact(across: float, sticks: bool, heading: tuple[float, float]) -> None:
    """Sticking takes 2/7 of the slip from the velocity, sliding μ (1 + e) of the normal speed."""
    along, drop, e = np.array(heading), 0.5, 0.8
    spin = tuple(0.25 * np.array(rolling_spin(across * along)))
    scene = ball(height=drop, velocity=(*(across * along).tolist(), 0.0), spin=spin, restitution=e)
    result = run(scene)
    down = math.sqrt(2 * G * drop)
    after = math.ceil(down / G / 0.02)
    lag = 0.75 * across
    change = min(2.0 / 7.0 * lag, MU * (1 + e) * down)
    assert (change < 2.0 / 7.0 * lag) != sticks
    velocity = result.velocity[0, after, 0]
    np.testing.assert_allclose(velocity[:2], (across - change) * along, rtol=0, atol=1e-13)
    assert velocity[2] == pytest.approx(e * down - G * (result.time[after] - down / G), abs=1e-13)
    residual = lag - 3.5 * change
    np.testing.assert_allclose(slip(result)[after], residual * along, rtol=0, atol=1e-12)


def test_forces_lift_a_ball_and_load_its_contact() -> None:
    """A force lifts a ball at 2 g for 0.2 s; another presses it down, with twice the friction."""
    up = Force("ball", ((0.0, 0.0, 3 * MASS * G), (0.0, 0.0, 0.0)), hold=10)
    result = run(ball(forces=(up,), restitution=0.0))
    top = 0.5 * 2 * G * 0.2**2
    rise = 2 * G * 0.2
    landing = 0.2 + (rise + math.sqrt(rise**2 + 2 * G * top)) / G
    height = result.position[0, :, 0, 2] - RADIUS
    np.testing.assert_allclose(height[:11], G * result.time[:11] ** 2, rtol=0, atol=1e-14)
    assert ((height > 0.0) == ((result.time > 0.0) & (result.time < landing))).all()
    down = Force("ball", ((0.0, 0.0, -MASS * G),))
    pressed = run(ball(velocity=(7.0, 0.0, 0.0), forces=(down,)))
    assert pressed.velocity[0, 5, 0, 0] == pytest.approx(7.0 - 2 * MU * G * 0.1, abs=1e-13)


@pytest.mark.parametrize("name", ["ballscroll", "balldrop"])
def test_energy_never_rises(name: str) -> None:
    """Without noise, no frame has more energy than the one before it."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(6), noise=False)
    result = solve(scene, batch, cache=False)
    mechanism = Mechanism.of(scene)
    spin = result.angular_velocity[:, :, 0, 1]
    # Both move in the x–z plane; y is the axis of the disc.
    kinetic = mechanism.mass[0] * np.sum(result.velocity[:, :, 0] ** 2, axis=-1)
    kinetic += mechanism.inertia[0, 1, 1] * spin**2
    total = 0.5 * kinetic + mechanism.mass[0] * G * result.position[:, :, 0, 2]
    assert np.diff(total, axis=1).max() < 1e-13 * total.max()
    assert (total[:, -1] < total[:, 0]).all()


def test_energy_with_every_kind_of_contact() -> None:
    result = run(ball(height=0.3, velocity=(2.0, -1.0, 0.0), spin=(50.0, 90.0, 40.0)))
    assert np.diff(energy(result)).max() < 1e-13 * energy(result)[0]


@pytest.mark.parametrize("name", ["ballscroll", "balldrop"])
def test_frames_only_cut_the_motion(name: str) -> None:
    """Four times as many frames under the same held forces give the same states."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(3))
    coarse = solve(scene, batch, cache=False)
    fields = {field.name: getattr(batch, field.name) for field in dataclasses.fields(batch)}
    fields |= {key: np.repeat(fields[key], 4, axis=1) for key in ("force", "torque")}
    finer = Scene(
        **{
            key: getattr(scene, key)
            for key in scene.__struct_fields__
            if key not in ("clock", "sampling", "noise")
        },
        clock=Clock(scene.clock.frame / 4, 4 * scene.clock.steps),
    )
    fine = solve(finer, type(batch)(**fields), cache=False)
    for key in ("position", "velocity", "angular_velocity", "orientation"):
        np.testing.assert_allclose(
            getattr(fine, key)[:, ::4], getattr(coarse, key), rtol=1e-11, atol=1e-11
        )


def test_growth_of_a_ball_is_that_of_the_closed_form() -> None:
    """Rolling, the distance of two balls grows by the difference of (5 v₀ + 2 ω₀ r) / 7."""
    scene = load_scene("ballscroll")
    batch = draw_batch(scene, [0, 3, 6], noise=False)
    growth = sensitivity(scene, batch, cache=False)
    assert np.isfinite(growth).all()
    np.testing.assert_allclose(growth[:, 0], 1.0, rtol=0, atol=1e-6)
    late = growth[:, 150:]
    # Balls that move apart in one direction keep doing so.
    np.testing.assert_allclose(np.diff(late, 2, axis=1), 0.0, rtol=0, atol=1e-5)
    assert (np.diff(late, axis=1) > 1e-3 * scene.clock.frame).all()


def test_growth_in_the_plane() -> None:
    scene = load_scene("balldrop")
    growth = sensitivity(scene, draw_batch(scene, range(3)), cache=False)
    assert np.isfinite(growth).all()
    assert 1.0 < growth.max() < 100.0


def test_planar_scenes_stay_planar() -> None:
    scene = load_scene("balldrop")
    result = solve(scene, draw_batch(scene, range(3)), cache=False)
    assert not result.position[..., 1].any()
    assert not result.velocity[..., 1].any()
    assert not result.angular_velocity[..., ::2].any()


def test_several_balls_do_not_mind_each_other() -> None:
    one, two = ball(height=0.4, restitution=0.7), ball(velocity=(3.0, 1.0, 0.0), restitution=0.7)
    other = Body("other", particles=two.bodies[0].particles, velocity=two.bodies[0].velocity)
    sphere = ContactSphere("other", two.contacts[0].center, RADIUS)
    parts = {"bodies": (other, *one.bodies), "contacts": (*one.contacts, sphere)}
    both = msgspec.structs.replace(one, **parts)
    together = run(both)
    np.testing.assert_array_equal(together.position[0, :, 1], run(one).position[0, :, 0])
    np.testing.assert_array_equal(together.position[0, :, 0], run(two).position[0, :, 0])


def test_start_in_the_ground() -> None:
    with pytest.raises(InputError, match=r"'ball' starts 0\.01 m below the ground"):
        run(ball(height=-0.01))


def test_several_free_bodies_fly() -> None:
    """Free bodies without joints and ground fly on parabolas, each as if alone."""
    bodies = tuple(
        Body(
            name,
            inertia=Inertia(1.0, (0.3, 0.2, 0.1), com=(float(k), 0.0, 0.0)),
            velocity=(0.0, float(k), 1.0),
            angular_velocity=(1.0, 2.0, 3.0 * k),
        )
        for k, name in enumerate("abc")
    )
    scene = Scene("free", bodies, 1.0, clock=Clock(0.02, 20))
    result = run(scene)
    t = result.time
    for k in range(3):
        expected = np.stack([k + 0 * t, k * t, t - 0.5 * G * t**2], axis=-1)
        np.testing.assert_allclose(result.position[0, :, k], expected, rtol=0, atol=1e-12)
        alone = run(Scene("one", bodies[k : k + 1], 1.0, clock=scene.clock))
        own = alone.orientation[0, :, 0]
        np.testing.assert_allclose(own, result.orientation[0, :, k], rtol=0, atol=1e-10)

"""Balls with unequal moments of inertia, against equations written down another way."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import sensitivity, solve
from mbds_xsim.reference.ball import BallContact, BallState, EvenBall, Load
from mbds_xsim.reference.tumbling_ball import TumblingBall
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Force, Ground, Inertia, Scene, Vector
from mbds_xsim.scene.state import Trajectory
from tests.over_ground import over_ground

G, MU, MASS, RADIUS = 9.81, 0.43, 1.5, 0.1
MOMENTS = (0.004, 0.007, 0.009)
TILT = (0.8, 0.36, -0.48, 0.0)
CONTACT = BallContact(MASS, RADIUS, MU, 0.8)
DOWN = np.array([0.0, 0.0, -RADIUS])


def ball(
    velocity: Vector,
    spin: Vector,
    *,
    height: float = 0.0,
    forces: tuple[Force, ...] = (),
    friction: float = MU,
    steps: int = 20,
) -> Scene:
    """Make a ball whose principal axes are tilted."""
    body = Body(
        "ball",
        inertia=Inertia(MASS, MOMENTS),
        position=(0.0, 0.0, RADIUS + height),
        orientation=TILT,
        velocity=velocity,
        angular_velocity=spin,
    )
    more = {"forces": forces, "clock": Clock(0.02, steps)}
    return over_ground(body, body.position, RADIUS, Ground(friction, 0.8), **more)


def run(scene: Scene) -> Trajectory:
    result = solve(scene, draw_batch(scene, [0]), cache=False)
    assert result.failures == (None,)
    return result


def tensors(scene: Scene, result: Trajectory) -> Array:
    """Inertia in W, shape (frame, 3, 3)."""
    mechanism = Mechanism.of(scene)
    turn = rotation.matrix(mechanism.native_rotation(result.orientation))[0, :, 0]
    return np.asarray(turn @ mechanism.inertia[0] @ np.swapaxes(turn, -1, -2))


def spins(scene: Scene, result: Trajectory) -> tuple[Array, Array]:
    """Angular momentum about the centre of mass [N·m·s], (frame, 3), and kinetic energy [J]."""
    rate = result.angular_velocity[0, :, 0]
    own = np.einsum("fij,fj->fi", tensors(scene, result), rate)
    return own, 0.5 * np.sum(own * rate + MASS * result.velocity[0, :, 0] ** 2, axis=-1)


def rolling(spin: Array, friction: float, steps: int) -> tuple[Scene, Trajectory]:
    """Let a ball begin without slip."""
    velocity = np.cross(DOWN, spin)
    scene = ball((*velocity.tolist(),), tuple(spin), friction=friction, steps=steps)
    return scene, run(scene)


def slips(result: Trajectory) -> Array:
    return result.velocity[0, :, 0] + np.cross(result.angular_velocity[0, :, 0], DOWN)


def test_slides_by_newton_and_euler() -> None:
    """An independent integration has the tensor in W and the momenta as variables."""
    velocity, spin = (6.0, -2.0, 0.0), (12.0, 5.0, -9.0)
    scene = ball(velocity, spin, forces=(Force("ball", ((0.5, 1.5, 0.0),)),), steps=12)
    result = run(scene)
    start = np.concatenate(
        [np.zeros(3), velocity, result.orientation[0, 0, 0], tensors(scene, result)[0] @ spin]
    )

    def rate(_: float, y: Array) -> Array:
        velocity, q, momentum = y[3:6], y[6:10], y[10:]
        turn = rotation.matrix(q / np.linalg.norm(q))
        spin = turn @ ((turn.T @ momentum) / MOMENTS)
        slip = velocity + np.cross(spin, DOWN)
        friction = -MU * MASS * G * slip / np.linalg.norm(slip)
        force = friction + np.array([0.5, 1.5, 0.0])
        turning = 0.5 * rotation.multiply(np.append(0.0, spin), q)
        return np.concatenate([velocity, force / MASS, turning, np.cross(DOWN, friction)])

    exact = solve_ivp(
        rate,
        (0, result.time[-1]),
        start,
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        t_eval=result.time,
    )
    assert np.linalg.norm(slips(result), axis=-1).min() > 0.1
    np.testing.assert_allclose(result.position[0, :, 0, :2], exact.y[:2].T, rtol=0, atol=1e-10)
    np.testing.assert_allclose(result.orientation[0, :, 0], exact.y[6:10].T, rtol=0, atol=1e-9)


def test_rolls_as_chaplygins_ball() -> None:
    """The ball's angular momentum about its contact is constant in space, as is its energy."""
    scene, result = rolling(np.array([8.0, 5.0, 3.0]), friction=5.0, steps=40)
    own, energy = spins(scene, result)
    momentum = own + MASS * np.cross(-DOWN, result.velocity[0, :, 0])
    assert np.abs(slips(result)).max() < 1e-11
    assert np.ptp(result.angular_velocity[0, :, 0], axis=0).min() > 0.5  # it does tumble
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=1e-10)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)


def test_tumbling_breaks_the_grip() -> None:
    """The ball slips where rolling would need more friction; its energy only falls."""
    scene, result = rolling(np.array([30.0, 18.0, 12.0]), friction=0.05, steps=15)
    _, energy = spins(scene, result)
    assert np.linalg.norm(slips(result), axis=-1).max() > 1e-2
    assert np.diff(energy).max() < 1e-12 * energy[0]
    force = MASS * np.diff(result.velocity[0, :, 0, :2], axis=0) / 0.02
    assert np.linalg.norm(force, axis=-1).max() <= 0.05 * MASS * G * (1 + 1e-10)


@pytest.mark.parametrize(("speed", "sticks"), [(0.7, True), (15.0, False)])
def test_impact_with_a_turning_slip(speed: float, sticks: bool) -> None:
    """The test steps ds/dp = −μ K s/|s| through the impact, with a matrix K of its own."""
    uneven = TumblingBall(CONTACT, np.array([0.001, 0.004, 0.0049]))
    turn = np.array([0.8, 0.36, -0.48, 0.0])
    motion = BallState(0j, 0.0, complex(speed, 0.4 * speed), -2.0, 3 - 2j, 1.5, turn)
    after = uneven.hit(motion)
    axes = rotation.matrix(turn)
    inverse = axes @ np.diag(1.0 / uneven.moments) @ axes.T
    velocity = np.array([motion.velocity.real, motion.velocity.imag, 0.0])
    spin = np.array([3.0, -2.0, 1.5])
    most, count = MASS * 1.8 * 2.0, 40_000
    for _ in range(count):
        slip = (velocity + np.cross(spin, DOWN))[:2]
        size = np.linalg.norm(slip)
        if size < 2e-4:
            break
        part = np.append(-MU * most / count * slip / size, 0.0)
        velocity = velocity + part / MASS
        spin = spin + inverse @ np.cross(DOWN, part)
    assert after.climb == 1.6
    assert (abs(CONTACT.slip(after)) < 1e-12) == sticks
    assert after.velocity == pytest.approx(complex(*velocity[:2]), abs=2e-4)
    assert [after.spin.real, after.spin.imag, after.twist] == pytest.approx(spin, abs=1e-2)
    assert abs(after.twist - 1.5) > 0.05  # the tensor turns some of it about the vertical


@pytest.mark.parametrize(
    ("spin", "push"), [(9 - 3j, 0j), (2 + 1j, 3 - 4j), (0j, 40 + 0j), (0j, 3 + 1j)]
)
def test_equal_moments_are_the_closed_form(spin: complex, push: complex) -> None:
    """Sums of exponentials and integration solve the same problem."""
    moment = 0.006
    even, uneven = EvenBall(CONTACT, moment), TumblingBall(CONTACT, np.full(3, moment))
    velocity = 0j if spin == 0 else 2 + 1j
    motion = BallState(0j, 0.0, velocity, 0.0, spin, 2.0, rotation.IDENTITY.copy())
    load = Load(push, -G)
    (used, one), (also, other) = (each.keep_contact(motion, load, 0.05) for each in (even, uneven))
    assert also == pytest.approx(used, abs=1e-12)
    for field in dataclasses.fields(BallState):
        expected, actual = getattr(one, field.name), getattr(other, field.name)
        assert actual == pytest.approx(expected, abs=1e-10), field.name


def test_bounces_and_tumbles() -> None:
    """Energy never rises in flight, impacts and contact, and the ball ends on the ground."""
    scene = ball((2.0, 1.0, 0.0), (3.0, -6.0, 9.0), height=0.02, steps=60)
    result = run(scene)
    _, energy = spins(scene, result)
    energy += MASS * G * result.position[0, :, 0, 2]
    assert np.diff(energy).max() < 1e-12 * energy[0]
    assert (result.velocity[0, -1, 0, 2], result.position[0, -1, 0, 2]) == (0.0, RADIUS)
    assert result.position[0, 1:, 0, 2].max() > RADIUS


def test_growth_of_a_tumbling_ball() -> None:
    scene = ball((2.0, 1.0, 0.0), (3.0, -6.0, 9.0), height=0.02, steps=5)
    growth = sensitivity(scene, draw_batch(scene, [0]), cache=False)
    assert growth[0, 0] == pytest.approx(1.0, abs=1e-6)
    assert 0.1 < growth.min() <= growth.max() < 10.0

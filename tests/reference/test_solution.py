"""The reference solution, against solutions found in other ways."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.measure import campaign
from mbds_xsim.reference import sensitivity, solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Pose
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene
from tests.adapters.exact import worst_gap


def run(scene: Scene) -> Trajectory:
    """Solve the scene's own start."""
    return solve(scene, draw_batch(scene, [0]), cache=False)


def rod(name: str, ends: tuple[tuple[float, float], tuple[float, float]], mass: float) -> Body:
    """Make a uniform rod in the x–z plane."""
    (x1, z1), (x2, z2) = ends
    dx, dz = x2 - x1, z2 - z1
    factor = mass / 12.0
    inertia = Inertia(
        mass,
        (factor * dz * dz + 1e-3, factor * (dx * dx + dz * dz), factor * dx * dx + 1e-3),
        (0.0, -factor * dx * dz, 0.0),
        ((x1 + x2) / 2, 0.0, (z1 + z2) / 2),
    )
    return Body(name, inertia=inertia)


def energies(mechanism: Mechanism, trajectory: Trajectory) -> tuple[Array, Array]:
    """Kinetic and gravitational energy [J], shape (trajectory, frame)."""
    turn = rotation.matrix(mechanism.native_rotation(trajectory.orientation))
    spin = np.einsum("...ji,...j->...i", turn, trajectory.angular_velocity)
    kinetic = 0.5 * np.einsum(
        "tfni,tfni,n->tf", trajectory.velocity, trajectory.velocity, mechanism.mass
    )
    kinetic += 0.5 * np.einsum("tfni,nij,tfnj->tf", spin, mechanism.inertia, spin)
    gravity = np.array(mechanism.scene.gravity)
    return kinetic, -np.einsum("tfni,i,n->tf", trajectory.position, gravity, mechanism.mass)


def energy_residual(scene: Scene, trajectory: Trajectory, batch: Batch) -> float:
    """Energy balance over the energy scale, as docs/checks.md defines it (no torques)."""
    mechanism = Mechanism.of(scene)
    kinetic, potential = energies(mechanism, trajectory)
    work = np.einsum("tfni,tfni->tf", batch.force, np.diff(trajectory.position, axis=1))
    balance = np.diff(kinetic + potential, axis=1) - work
    scale = kinetic.max(axis=1) + np.ptp(potential, axis=1)
    return float((np.abs(np.cumsum(balance, axis=1)).max(axis=1) / scale).max())


def test_tumbling_body_keeps_energy_and_angular_momentum() -> None:
    """Spin about the middle axis turns over (Dzhanibekov) and keeps both."""
    body = Body(
        "wing nut",
        inertia=Inertia(1.3, (0.3, 0.2, 0.1), com=(0.1, 0.0, 0.2)),
        orientation=tuple(rotation.from_vector(np.array([0.3, -0.4, 0.5])).tolist()),
        velocity=(1.0, 2.0, 3.0),
        angular_velocity=(0.5, 7.0, -0.4),
    )
    scene = Scene("free", (body,), 1.0, gravity=(0.0, 0.0, 0.0))
    mechanism, result = Mechanism.of(scene), run(scene)
    kinetic, _ = energies(mechanism, result)
    np.testing.assert_allclose(kinetic, kinetic[0, 0], rtol=1e-10)
    turn = rotation.matrix(mechanism.native_rotation(result.orientation[0]))
    tensor = turn @ mechanism.inertia @ np.swapaxes(turn, -1, -2)
    momentum = np.einsum("fnij,fnj->fi", tensor, result.angular_velocity[0])
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-10)
    in_body = np.einsum("fnji,fnj->fi", turn, result.angular_velocity[0])
    assert in_body.min() < -3.0  # it did turn over
    np.testing.assert_allclose(
        result.position[0, :, 0],
        mechanism.com[0] + result.time[:, None] * np.array([1.0, 2.0, 3.0]),
        atol=1e-11,
    )


def test_pendulum_is_the_elliptic_function() -> None:
    amplitude, length, inertia = 2.5, 0.7, 0.04
    scene = Scene(
        "pendulum",
        (Body("bob", inertia=Inertia(2.0, (inertia, inertia, 0.01), com=(0.0, 0.0, -length))),),
        length,
        joints=(Joint("pivot", "hinge", "world", "bob", (0.0,) * 3, (0.0, 1.0, 0.0), amplitude),),
    )
    result = run(scene)
    frequency = math.sqrt(2.0 * 9.81 * length / (2.0 * length**2 + inertia))
    modulus = math.sin(amplitude / 2) ** 2
    sine, *_ = ellipj(ellipk(modulus) - frequency * result.time, modulus)
    angle = 2.0 * np.arcsin(math.sqrt(modulus) * sine)
    expected = length * np.stack([-np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    np.testing.assert_allclose(result.position[0, :, 0], expected, rtol=0, atol=1e-9)


def double_pendulum(a: float, b: float, mass: float, inertia: float) -> Scene:
    bodies = tuple(
        Body(name, inertia=Inertia(mass, (inertia,) * 3, com=(0.0, 0.0, z)))
        for name, z in (("upper", -a), ("lower", -a - b))
    )
    joints = (
        Joint("top", "hinge", "world", "upper", (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), 1.2, 0.5),
        Joint("knee", "hinge", "upper", "lower", (0.0, 0.0, -a), (0.0, -1.0, 0.0), 0.9, -1.0),
    )
    return Scene("double", bodies, a + b, joints=joints, clock=Clock(0.02, 100))


def test_double_pendulum_against_its_lagrangian() -> None:
    a, b, mass, inertia = 0.6, 0.4, 1.5, 0.02
    result = run(double_pendulum(a, b, mass, inertia))

    def rate(_: float, y: Array) -> list[float]:
        p, q, dp, dq = y
        cosine, sine = math.cos(p - q), math.sin(p - q)
        matrix = [
            [2 * mass * a * a + inertia, mass * a * b * cosine],
            [mass * a * b * cosine, mass * b * b + inertia],
        ]
        load = [
            -mass * a * b * sine * dq**2 - 2 * mass * 9.81 * a * math.sin(p),
            mass * a * b * sine * dp**2 - mass * 9.81 * b * math.sin(q),
        ]
        return [dp, dq, *np.linalg.solve(matrix, load)]

    start = [1.2, 2.1, 0.5, -0.5]
    exact = solve_ivp(
        rate, (0, 2), start, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=result.time
    )
    p, q = exact.y[:2]
    upper = a * np.stack([np.sin(p), -np.cos(p)], axis=-1)
    lower = upper + b * np.stack([np.sin(q), -np.cos(q)], axis=-1)
    np.testing.assert_allclose(result.position[0, :, 0, ::2], upper, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.position[0, :, 1, ::2], lower, rtol=0, atol=1e-9)


def test_fast_top_precesses_steadily() -> None:
    """Exact: a symmetric top at a right angle to gravity with Ω = m g l / (I₃ ω₃), ω₃ ⊥ Ω."""
    mass, arm, axial, across, spin = 1.0, 0.5, 0.02, 0.03, 40.0
    precession = mass * 9.81 * arm / (axial * spin)
    top = Body(
        "top",
        inertia=Inertia(mass, (axial, across, across), com=(arm, 0.0, 0.0)),
        angular_velocity=(spin, 0.0, precession),
    )
    joint = Joint("tip", "ball", "world", "top", (0.0, 0.0, 0.0))
    result = run(Scene("top", (top,), arm, joints=(joint,), clock=Clock(0.02, 50)))
    angle = precession * result.time
    expected = arm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    np.testing.assert_allclose(result.position[0, :, 0], expected, rtol=0, atol=1e-9)


def test_spring_on_a_slider_is_a_damped_oscillator() -> None:
    mass, stiffness, damping = 2.0, 50.0, 3.0
    scene = Scene(
        "spring",
        (Body("mass", inertia=Inertia(mass, (0.1, 0.1, 0.1))),),
        1.0,
        gravity=(0.0, 0.0, -9.81),
        joints=(Joint("rail", "slider", "world", "mass", (0.0,) * 3, (1.0, 0.0, 0.0), 0.3, 0.2),),
        springs=(
            SpringDamper(
                "spring", ("world", "mass"), ((-1.0, 0.0, 0.0), (0.0,) * 3), stiffness, damping
            ),
        ),
    )
    result = run(scene)
    decay = damping / (2 * mass)
    frequency = math.sqrt(stiffness / mass - decay**2)
    t = result.time
    expected = np.exp(-decay * t) * (
        0.3 * np.cos(frequency * t) + (0.2 + decay * 0.3) / frequency * np.sin(frequency * t)
    )
    np.testing.assert_allclose(result.position[0, :, 0, 0], expected, rtol=0, atol=1e-10)


LENGTHS = (0.4, 1.0, 0.8, 0.9)  # crank, coupler, rocker, ground


def four_bar() -> Scene:
    """A crank–rocker of hinges in space: three of its twenty rows are redundant."""
    crank, coupler, rocker, ground = LENGTHS
    a = (0.0, crank)
    span = math.hypot(ground, crank)
    inner = math.acos((span**2 + coupler**2 - rocker**2) / (2 * span * coupler))
    heading = math.atan2(-crank, ground) + inner
    b = (a[0] + coupler * math.cos(heading), a[1] + coupler * math.sin(heading))
    bodies = (
        rod("crank", ((0.0, 0.0), a), 1.0),
        rod("coupler", (a, b), 2.0),
        rod("rocker", ((ground, 0.0), b), 1.5),
    )
    axis = (0.0, -1.0, 0.0)
    joints = (
        Joint("j1", "hinge", "world", "crank", (0.0, 0.0, 0.0), axis, rate=6.0),
        Joint("j2", "hinge", "crank", "coupler", (a[0], 0.0, a[1]), axis),
        Joint("j3", "hinge", "world", "rocker", (ground, 0.0, 0.0), axis),
        Joint("j4", "hinge", "rocker", "coupler", (b[0], 0.0, b[1]), axis),
    )
    return Scene("four-bar", bodies, 1.0, joints=joints, clock=Clock(0.02, 100))


def four_bar_centres(angle: float) -> tuple[Array, Array]:
    """Centres of mass (body, 2) and body angles (body,) of the assembled linkage."""
    crank, coupler, rocker, ground = LENGTHS
    a = crank * np.array([math.cos(angle), math.sin(angle)])
    o = np.array([ground, 0.0])
    d = o - a
    span = float(np.linalg.norm(d))
    inner = math.acos((span**2 + coupler**2 - rocker**2) / (2 * span * coupler))
    heading = math.atan2(d[1], d[0]) + inner
    b = a + coupler * np.array([math.cos(heading), math.sin(heading)])
    rocking = math.atan2(b[1], b[0] - ground)
    return np.array([a / 2, (a + b) / 2, (o + b) / 2]), np.array([angle, heading, rocking])


def test_redundant_four_bar_against_its_single_coordinate() -> None:
    """Energy conservation in the crank angle alone is an independent solution."""
    result = run(four_bar())
    masses = np.array([1.0, 2.0, 1.5])
    inertias = masses * np.array([LENGTHS[0], LENGTHS[1], LENGTHS[2]]) ** 2 / 12.0

    def slopes(angle: float) -> tuple[Array, Array]:
        """First derivatives by the crank angle, from the loop's velocity equations."""
        _, (p, q, r) = four_bar_centres(angle)
        crank, coupler, rocker, _ = LENGTHS
        matrix = np.array(
            [
                [-coupler * math.sin(q), rocker * math.sin(r)],
                [coupler * math.cos(q), -rocker * math.cos(r)],
            ]
        )
        dq, dr = np.linalg.solve(matrix, [crank * math.sin(p), -crank * math.cos(p)])
        da = crank * np.array([-math.sin(p), math.cos(p)])
        db = rocker * dr * np.array([-math.sin(r), math.cos(r)])
        return np.array([da / 2, (da + db) / 2, db / 2]), np.array([1.0, dq, dr])

    def effective(angle: float) -> float:
        centre, turn = slopes(angle)
        return float(masses @ np.sum(centre**2, axis=1) + inertias @ turn**2)

    # The crank never stops, so its energy gives its rate.
    def potential(angle: float) -> float:
        return float(9.81 * masses @ four_bar_centres(angle)[0][:, 1])

    start = math.pi / 2
    energy = 0.5 * effective(start) * 6.0**2 + potential(start)

    def rate(_: float, y: Array) -> list[float]:
        return [math.sqrt(2.0 * (energy - potential(y[0])) / effective(y[0]))]

    exact = solve_ivp(
        rate, (0, 2), [start], method="DOP853", rtol=1e-13, atol=1e-13, t_eval=result.time
    )
    expected = np.array([four_bar_centres(angle)[0] for angle in exact.y[0]])
    np.testing.assert_allclose(result.position[0, :, :, ::2], expected, rtol=0, atol=1e-9)
    assert np.abs(result.position[0, :, :, 1]).max() < 1e-12
    assert exact.y[0, -1] > start + 2 * math.pi  # more than one turn
    assert worst_gap(four_bar(), result) < 1e-12


@pytest.mark.parametrize("name", ["5pendulum", "2ladder"])
def test_tolerance_gap_and_energy(name: str) -> None:
    """A low and a medium trajectory, with noise and inputs, keep tolerance, gap and energy."""
    scene = load_scene(name)
    batch = draw_batch(scene, [0, 1]).truncated(20)
    coarse, fine = (solve(scene, batch, rtol=rtol, cache=False) for rtol in (1e-11, 1e-12))
    moved = np.linalg.norm(coarse.position - fine.position, axis=-1).max()
    assert 0.0 < moved < 1e-10
    assert worst_gap(scene, coarse) < 1e-13
    assert energy_residual(scene, coarse, batch) < 1e-11


def test_start_is_the_batch() -> None:
    scene = load_scene("6pendulum")
    batch = draw_batch(scene, [2, 5]).truncated(1)
    result = solve(scene, batch, cache=False)
    for field in dataclasses.fields(batch)[1:5]:
        np.testing.assert_array_equal(getattr(result, field.name)[:, 0], getattr(batch, field.name))


def test_together_or_alone_is_the_same() -> None:
    scene = load_scene("5pendulum")
    batch = draw_batch(scene, range(3)).truncated(10)
    together = solve(scene, batch, cache=False)
    alone = solve(scene, batch[[1]], cache=False)
    np.testing.assert_allclose(together.position[1], alone.position[0], rtol=0, atol=1e-13)


def test_who_is_solved_together_does_not_decide_who_has_a_solution() -> None:
    """The nearer the block is to its pivot, the faster the damper stops the crank."""
    crank, block, wheel = (
        Body(name, inertia=Inertia(mass, (moment,) * 3), position=(place, 0.0, 0.0))
        for name, mass, moment, place in (
            ("crank", 0.01, 1e-4, 0.0),
            ("block", 1.0, 1e-3, 0.5),
            ("wheel", 1.0, 0.1, 3.0),
        )
    )
    up, along = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    joints = (
        Joint("j1", "hinge", "world", "crank", (0.0,) * 3, up, start=0.0, rate=0.0, damping=20.0),
        Joint("j2", "slider", "crank", "block", (0.5, 0.0, 0.0), along, start=0.0, rate=0.1),
        Joint(
            "j3", "hinge", "world", "wheel", (3.0, 0.0, 0.0), up, start=0.0, rate=10.0,
            stiffness=0.01,
        ),
    )  # fmt: skip
    scene = Scene(
        "two",
        (crank, block, wheel),
        1.0,
        gravity=(0.0,) * 3,
        joints=joints,
        clock=Clock(steps=30),
        sampling=(Pose(joints=("j2",), coordinate=(-0.4, 0.5)),),
    )
    batch, rows = draw_batch(scene, range(6)), [2, 0, 1]
    together = solve(scene, batch[rows], cache=False)
    alone = [solve(scene, batch[[row]], cache=False) for row in rows]

    assert together.failures == tuple(each.failures[0] for each in alone)
    for row, each in enumerate(alone):
        np.testing.assert_allclose(together.position[row], each.position[0], rtol=0, atol=1e-12)


def test_whole_numbers_are_numbers() -> None:
    def swing(number: Callable[[int], float]) -> Array:
        zero, one, two = map(number, (0, 1, 2))
        body = Body("a", inertia=Inertia(two, (one,) * 3, com=(zero, zero, -one)))
        ends, axis = ("world", "a"), (zero, one, zero)
        joint = Joint(
            "j", "hinge", *ends, (zero,) * 3, axis, start=one, stiffness=number(5), damping=one,
            armature=one, limits=(-two, two),
        )  # fmt: skip
        gravity = (zero, zero, number(-10))
        return run(Scene("s", (body,), one, gravity=gravity, joints=(joint,))).position

    np.testing.assert_array_equal(swing(int), swing(float))


@pytest.mark.parametrize("rtol", [0.0, 1.0, math.nan])
def test_tolerance_out_of_range(rtol: float) -> None:
    scene = load_scene("5pendulum")
    with pytest.raises(InputError, match="rtol: got"):
        solve(scene, draw_batch(scene, [0]), rtol=rtol, cache=False)


def test_sensitivity_of_free_flight_is_exact() -> None:
    """Without rotation the distance is |δx + δv t|, at most 1 + t times its start."""
    body = Body("stone", inertia=Inertia(1.0, (1.0, 1.0, 1.0)))
    scene = Scene("stone", (body,), 1.0, clock=Clock(0.1, 20))
    growth = sensitivity(scene, draw_batch(scene, range(3)), cache=False)
    assert growth.shape == (3, 21)
    np.testing.assert_allclose(growth[:, 0], 1.0, rtol=0, atol=1e-12)
    second = np.diff(growth**2, 2, axis=1)  # |δx + δv t|² is a parabola, δv = δx in size
    np.testing.assert_allclose(second, 2 * 0.1**2, rtol=1e-3)


def test_sensitivity_does_not_hang_on_the_tolerance() -> None:
    scene = load_scene("5pendulum")
    batch = draw_batch(scene, [2]).truncated(50)
    loose = sensitivity(scene, batch, cache=False)
    tight = sensitivity(scene, batch, cache=False, rtol=1e-11)
    np.testing.assert_allclose(loose, tight, rtol=1e-3)
    assert loose.max() > 1.5


def test_a_solution_that_opens_joints_is_no_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding once lost the rows of the joint of a particle of 1e9 kg, which came apart."""
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, [0]).truncated(3)
    exact = solve(scene, batch, cache=False)
    apart = dataclasses.replace(exact, position=exact.position + 2e-3)
    monkeypatch.setattr("mbds_xsim.reference.solve", lambda *_, **__: apart)
    with pytest.raises(
        InputError, match=r"opens joint joint1 by 0\.00346 m, so nothing can be judged"
    ):
        campaign.reference_of(scene, batch, cache=False)

"""Two mechanisms with closed loops of hinges meet the solutions that others published."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.timed import simulate

ANDREWS = registry.load_scene("andrews")
BRICARD = registry.load_scene("bricard")

SEVEN_ANGLES_AT_START = np.array(
    [
        -0.0617138900142764496358948458001,
        0.0,
        0.455279819163070380255912382449,
        0.222668390165885884674473185609,
        0.487364979543842550225598953530,
        -0.222668390165885884674473185609,
        1.23054744454982119249735015568,
    ]
)
"""beta, Theta, gamma, Phi, delta, Omega, epsilon [rad]: Hairer & Wanner, VII.7, and the Test Set
for IVP Solvers."""

SEVEN_ANGLES_AT_END = np.array(
    [
        0.1581077119629904e2,
        -0.1575637105984298e2,
        0.4082224013073101e-1,
        -0.5347301163226948,
        0.5244099658805304,
        0.5347301163226948,
        0.1048080741042263e1,
    ]
)
"""The same angles at 0.03 s: Test Set for IVP Solvers, problem ANDREWS, by PSIDE with tolerances of
1e-14."""

SEVEN_RATES_AT_END = np.array(
    [
        0.1139920302151208e4,
        -0.1424379294994111e4,
        0.1103291221937134e2,
        0.1929337464421385e2,
        0.5735699284790808,
        -0.1929337464421385e2,
        0.3231791658026955,
    ]
)
"""Rates of the angles at 0.03 s [rad/s], from the same table."""

ANDREWS_ACCURACY = {
    "mujoco": 1e-5,
    "exudyn": 2e-4,
    "dart": 1e-3,
    "pybullet": 1e-3,
    "pinocchio": 1e-6,
    "mujoco-warp": 2e-5,
    "drake": 3e-3,
}
"""Largest errors of angles at matched settings; the crank turns by 15.8 rad [rad]."""

EXUDYN_TEST_MODEL = 4.172189649307425 - 2.0
"""Norm of the coordinates at 1 s: TestModels/bricardMechanism.py of Exudyn, stepped by 1 ms, gives
the sum of this norm, one degree of freedom, one redundant constraint, and an eigenvalue of 0."""

BRICARD_CURVE = np.array(
    [
        [0.5, 0.76, -0.97, -0.21],
        [1.0, 0.26, -0.88, -0.46],
        [1.5, -0.28, -0.88, -0.46],
        [2.0, -0.78, -0.98, -0.20],
    ]
)
"""Time [s] and x, y, z [m] of P3, read to 0.02 m from the plot of the benchmark's reference
solution in Tagliapietra et al., MBS benchmarks in OpenSim, A04."""

BRICARD_ACCURACY = {
    "mujoco": 2e-6,
    "exudyn": 5e-6,
    "dart": 5e-4,
    "pybullet": 5e-4,
    "pinocchio": 1e-7,
    "mujoco-warp": 1e-4,
    "drake": 2e-3,
}
"""Largest errors of the path of P3 at matched settings [m]."""

SWING = 150
"""Number of frames in 3 s: Bricard's mechanism swings over and starts on its way back."""


@functools.cache
def only_start(scene: Scene, steps: int) -> Batch:
    return draw_batch(scene, range(1)).truncated(steps)


@functools.cache
def reference(scene: Scene, steps: int) -> Trajectory:
    return solve(scene, only_start(scene, steps), cache=False)


def matched(scene: Scene, adapter: Adapter, steps: int) -> Trajectory:
    settings = settings_for(scene, adapter, "matched")
    trajectory = simulate(scene, only_start(scene, steps), adapter.name, settings).trajectory
    assert trajectory.failures == (None,)
    return trajectory


def seven(bodies: Array) -> Array:
    """Turn angles or rates of K1 to K7 into the book's, which are partly relative, shape (7,)."""
    k1, k2, k3, k4, k5, k6, k7 = bodies
    return np.array([k1, k2 - k1, k3, k4 - k5, k5, k6 - k7, k7])


def seven_angles(trajectory: Trajectory) -> Array:
    """Follow the turns about −y, which are counter-clockwise in the book, to the last frame."""
    w, _, y, _ = np.moveaxis(trajectory.orientation[0], -1, 0)
    turns = np.unwrap(2.0 * np.arctan2(-y, w), axis=0)
    return SEVEN_ANGLES_AT_START + seven(turns[-1] - turns[0])


def test_andrews_reference_meets_the_published_digits() -> None:
    trajectory = reference(ANDREWS, 300)

    assert seven_angles(trajectory) == pytest.approx(SEVEN_ANGLES_AT_END, abs=5e-9)
    rates = seven(-trajectory.angular_velocity[0, -1, :, 1])
    assert rates == pytest.approx(SEVEN_RATES_AT_END, abs=2e-6)


def test_andrews_engines_meet_the_published_solution(adapter: Adapter) -> None:
    trajectory = matched(ANDREWS, adapter, 300)

    error = np.abs(seven_angles(trajectory) - SEVEN_ANGLES_AT_END).max()

    assert error < ANDREWS_ACCURACY[adapter.name]


def turn(axis: Array, angle: float) -> Array:
    """Rodrigues' formula, shape (3, 3)."""
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


RODS = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0]], dtype=float)
AXES = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
"""Rods and hinges one after the other, as the benchmark draws them: y up, the first hinge at 0."""


def second_hinge(first: float) -> tuple[float, float]:
    """Angle of every other hinge, and its derivative.

    A threefold-symmetric Bricard linkage with twists of 90° closes where cos α + cos β +
    cos α cos β = 0 (Chen, You & Tarnai, Int. J. Solids Struct. 42 (2005) 2287); both are 90° here
    at the start.
    """
    cos_first = np.sin(first)
    beta = np.arccos(-cos_first / (1.0 + cos_first))
    slope = np.cos(first) / (1.0 + cos_first) ** 2 / np.sin(beta)
    return np.pi / 2 - beta, -slope


class Rod(NamedTuple):
    """Pose of a rod, and its velocities where the first hinge turns at a rate of 1."""

    start: Array
    end: Array
    rotation: Array
    spin: Array
    velocity: Array


def rods(first: float) -> list[Rod]:
    """Return all five rods at an angle of the first hinge."""
    second, slope = second_hinge(first)
    rotation, end, spin, velocity = np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3)
    chain = []
    for index, (rod, axis) in enumerate(zip(RODS, AXES, strict=True)):
        angle, rate = (second, slope) if index % 2 else (first, 1.0)
        rotation = rotation @ turn(axis, angle)
        start, spin = end, spin + rotation @ axis * rate
        along = rotation @ rod
        end = start + along
        chain.append(Rod(start, end, rotation, spin, velocity + np.cross(spin, along / 2)))
        velocity = velocity + np.cross(spin, along)
    return chain


def mass_and_height(first: float) -> tuple[float, float]:
    """Twice the kinetic energy for a rate of 1 of the first hinge, and the potential over m g."""
    mass = height = 0.0
    for rod in rods(first):
        roll = float(rod.spin @ (rod.end - rod.start)) ** 2
        mass += float(rod.velocity @ rod.velocity)
        mass += (1.01 * (float(rod.spin @ rod.spin) - roll) + 0.02 * roll) / 12
        height += float(rod.start[1] + rod.end[1]) / 2
    return mass, height


@functools.cache
def bricard_clock() -> Callable[[float], float]:
    """Return the first hinge's angle as a function of time, from energy conservation alone.

    The hinge swings over 180° and back: with the angle 90° (1 − cos φ) the rate of φ is smooth and
    nowhere 0, so that time is a sine series in φ whose coefficients fall exponentially.
    """
    count = 64
    phase = (np.arange(count) + 0.5) * np.pi / count
    angle = np.pi / 2 * (1.0 - np.cos(phase))
    masses, heights = np.array([mass_and_height(each) for each in angle]).T
    fall = 2.0 * 9.81 * (mass_and_height(0.0)[1] - heights)
    pace = np.pi / 2 * np.sin(phase) * np.sqrt(masses / fall)
    order = np.arange(1, count)
    series = 2.0 / count * np.cos(np.outer(order, phase)) @ pace

    def time(at: float) -> float:
        return float(pace.mean() * at + series / order @ np.sin(order * at))

    def angle_at(when: float) -> float:
        guess = when / pace.mean()
        root = brentq(lambda at: time(at) - when, guess - 1.0, guess + 1.0, xtol=1e-14)
        return float(np.pi / 2 * (1.0 - np.cos(root)))

    return angle_at


def third_point(time: float) -> Array:
    """P3, between the second and the third rod, in the benchmark's frame [m]."""
    return rods(bricard_clock()(time))[1].end


def third_path(trajectory: Trajectory) -> Array:
    """P3 in the benchmark's frame, from the pose of the second rod, shape (frames, 3)."""
    rotation = Rotation.from_quat(trajectory.orientation[0, :, 1], scalar_first=True)
    x, y, z = (trajectory.position[0, :, 1] + rotation.apply([0.0, 0.0, -0.5])).T
    return np.stack([x, z, -y], axis=-1)


def exudyn_coordinates(time: float) -> Array:
    """Displacements of the rods' first ends, and of Euler parameters from Exudyn's body frames."""
    turns = [[0, 0, 0], [-90, 0, 0], [0, -90, 0], [180, 0, 0], [90, 0, 0]]
    frames = Rotation.from_euler("ZYX", turns, degrees=True)
    changes = []
    for now, start, frame in zip(rods(bricard_clock()(time)), rods(0.0), frames, strict=True):
        then = frame.as_quat()
        parameters = (Rotation.from_matrix(now.rotation) * frame).as_quat()
        changes += [now.start - start.start, parameters * np.sign(parameters @ then) - then]
    return np.concatenate(changes)


def test_bricard_quadrature_meets_the_published_figures() -> None:
    """The quadrature meets the benchmark's curve, as read from its plot, and Exudyn's test."""
    read = np.array([third_point(time) for time in BRICARD_CURVE[:, 0]])

    assert read == pytest.approx(BRICARD_CURVE[:, 1:], abs=0.02)
    assert np.linalg.norm(exudyn_coordinates(1.0)) == pytest.approx(EXUDYN_TEST_MODEL, abs=3e-6)


def test_bricard_reference_meets_the_quadrature() -> None:
    trajectory = reference(BRICARD, SWING)
    exact = np.array([third_point(time) for time in trajectory.time])

    assert third_path(trajectory) == pytest.approx(exact, abs=1e-9)


def test_bricard_engines_meet_the_quadrature(adapter: Adapter) -> None:
    trajectory = matched(BRICARD, adapter, SWING)
    exact = np.array([third_point(time) for time in trajectory.time])

    assert np.abs(third_path(trajectory) - exact).max() < BRICARD_ACCURACY[adapter.name]

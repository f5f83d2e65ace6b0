"""The reference passes singular poses, says where it cannot, and always comes to an end."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from benchmarks.four_bars import angle_and_rate, energy, four_bars
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.reference import marching, solve, stiff
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, SpringDamper, Torque
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.registry import load_scene

AXIS = (0.0, -1.0, 0.0)
CRANK, ROD = 0.5, 1.0


def moved(scene: Scene) -> Trajectory:
    motion = solve(scene, draw_batch(scene, [0]), cache=False)
    assert motion.failures == (None,)
    return motion


@pytest.mark.parametrize(
    ("loops", "duration"),
    [(2, 4.0), (10, 1.5), pytest.param(40, 0.9, marks=pytest.mark.slow)],
)
def test_four_bars_pass_singular_poses_as_one_pendulum(loops: int, duration: float) -> None:
    """All loops pass 2 to 6 times; the benchmark library allows an energy error of 0.1 J."""
    scene = four_bars(loops, duration)

    motion = moved(scene)

    angle, rate = angle_and_rate(loops, motion.time)
    turns = np.abs(np.floor(angle / np.pi + 0.5)[-1])
    assert turns >= 1
    cranks = motion.position[0, :, : loops + 1]
    assert np.abs(cranks[..., 2] - 0.5 * np.cos(angle)[:, None]).max() < 2e-8
    spin = motion.angular_velocity[0, :, : loops + 1, 1]
    np.testing.assert_allclose(spin, np.tile(rate[:, None], loops + 1), rtol=0, atol=2e-7)
    assert np.ptp(energy(motion)) < 1e-7


def flat(rates: tuple[float | None, float | None], torques: tuple[Torque, ...] = ()) -> Scene:
    """Two cranks of 0.5 m, level, whose rod of 1 m lies in line with them; no gravity."""
    inertia = {
        length: Inertia(length, (1e-4, length**3 / 12, length**3 / 12)) for length in (CRANK, ROD)
    }
    bodies = (
        Body("left", inertia=inertia[CRANK], position=(CRANK / 2, 0.0, 0.0)),
        Body("right", inertia=inertia[CRANK], position=(ROD + CRANK / 2, 0.0, 0.0)),
        Body("rod", inertia=inertia[ROD], position=(CRANK + ROD / 2, 0.0, 0.0)),
    )
    joints = (
        Joint("foot0", "hinge", "world", "left", (0.0, 0.0, 0.0), AXIS, rate=rates[0]),
        Joint("foot1", "hinge", "world", "right", (ROD, 0.0, 0.0), AXIS, rate=rates[1]),
        Joint("pin0", "hinge", "left", "rod", (CRANK, 0.0, 0.0), AXIS),
        Joint("pin1", "hinge", "rod", "right", (ROD + CRANK, 0.0, 0.0), AXIS),
    )
    return Scene(
        "flat", bodies, 1.0, joints=joints, dimension=2, gravity=(0.0, 0.0, 0.0),
        clock=Clock(0.02, 100), torques=torques,
    )  # fmt: skip


def angles(motion: Trajectory) -> Array:
    """Angles of both cranks [rad], shape (frame, 2)."""
    w, _, y, _ = np.moveaxis(motion.orientation[0, :, :2], -1, 0)
    return np.unwrap(2.0 * np.arctan2(-y, w), axis=0)


def test_a_torque_on_one_crank_turns_both_through_singular_poses() -> None:
    """In line with the cranks, the rod cannot pass the torque: its force grows beyond bounds."""
    torque, rate = 0.7, 2.0
    scene = flat((rate, rate), (Torque("foot0", (torque,)),))

    motion = moved(scene)

    inertia = 2.0 * CRANK**3 / 3 + ROD * CRANK**2
    exact = rate * motion.time + torque / inertia * motion.time**2 / 2
    assert exact[-1] > 2 * np.pi
    np.testing.assert_allclose(angles(motion), np.stack([exact] * 2, axis=-1), rtol=0, atol=1e-8)


def test_opposite_rates_lead_into_the_antiparallelogram() -> None:
    """The branch has tan(β/2) = −(b + a)/(b − a) tan(α/2), with cranks of a and a rod of b."""
    ratio = -(ROD + CRANK) / (ROD - CRANK)
    motion = moved(flat((2.0, 2.0 * ratio)))

    left, right = angles(motion).T / 2
    assert left[-1] > np.pi / 2
    off = np.sin(right) * np.cos(left) - ratio * np.sin(left) * np.cos(right)
    assert np.abs(off).max() < 1e-8
    rates = CRANK**3 / 3 * np.sum(motion.angular_velocity[0, :, :2, 1] ** 2, axis=-1)
    rod = ROD * np.sum(motion.velocity[0, :, 2] ** 2, axis=-1)
    rod += ROD**3 / 12 * motion.angular_velocity[0, :, 2, 1] ** 2
    assert np.ptp(rates + rod) < 1e-8


@pytest.mark.parametrize("rates", [(2.0, 2.1), (2.0, -2.0)])
def test_a_start_at_a_bifurcation_that_chooses_no_branch_is_told_so(
    rates: tuple[float, float],
) -> None:
    sound = flat((2.0, 2.0))
    batch = draw_batch(sound, [0])
    spin, velocity = batch.angular_velocity.copy(), batch.velocity.copy()
    spin[0, 1], velocity[0, 1] = spin[0, 0] * rates[1] / 2, velocity[0, 0] * rates[1] / 2
    # The rod's ends move with the cranks.
    velocity[0, 2, 2] = CRANK * sum(rates) / 2
    spin[0, 2, 1] = -CRANK * (rates[1] - rates[0]) / ROD
    start = dataclasses.replace(batch, angular_velocity=spin, velocity=velocity)

    (failure,) = solve(sound, start, cache=False).failures

    assert failure is not None
    assert failure.frame == 1
    assert failure.reason.startswith("the start is a bifurcation")


def test_rates_of_least_energy_that_belong_to_no_branch_are_refused() -> None:
    with pytest.raises(SceneError, match=r"bifurcation at joints.*rate of one more joint"):
        draw_batch(flat((2.0, None)), [0])


def test_at_rest_forces_choose_the_branch_or_the_start_is_told() -> None:
    """Equal torques on both cranks choose the parallelogram; one alone chooses no branch."""
    both = moved(flat((None, None), (Torque("foot0", (0.2,)), Torque("foot1", (0.2,)))))
    inertia = 2.0 * CRANK**3 / 3 + ROD * CRANK**2
    exact = 0.2 / inertia * both.time**2
    np.testing.assert_allclose(angles(both), np.stack([exact] * 2, axis=-1), rtol=0, atol=1e-8)

    alone = flat((None, None), (Torque("foot0", (0.4,)),))
    (failure,) = solve(alone, draw_batch(alone, [0]), cache=False).failures
    assert failure is not None
    assert "bifurcation" in failure.reason


def test_a_loop_that_shakes_where_constraints_depend_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A hinge askew in a plane loop locks it: the squeezer shakes where it stands."""
    monkeypatch.setattr(marching, "_USUAL_STEPS", 2)
    monkeypatch.setattr(marching, "_SINGULAR_STEPS", 3)
    squeezer = load_scene("andrews")
    joints = tuple(
        msgspec.structs.replace(joint, axis=(0.0, -1.0, 1.0)) if joint.name == "A5" else joint
        for joint in squeezer.joints
    )
    locked = msgspec.structs.replace(squeezer, joints=joints, clock=Clock(0.02, 2))
    (failure,) = solve(locked, draw_batch(locked, [0]), rtol=1e-6, cache=False).failures
    assert failure is not None
    assert "3 steps begin at nearly dependent constraints: check axes in loops" in failure.reason


def stiff_pendulum() -> Scene:
    body = Body("ball", inertia=Inertia(1e-3, (1e-5, 1e-5, 1e-5)), position=(1.0, 0.0, 0.0))
    spring = SpringDamper("s", ("world", "ball"), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 1e3, 10.0)
    return Scene("spring", (body,), 1.0, springs=(spring,), clock=Clock(0.02, 2))


@pytest.mark.parametrize(
    ("method", "scene"), [(marching, four_bars(1, 0.04)), (stiff, stiff_pendulum())]
)
def test_a_solution_that_needs_too_many_steps_is_given_up(
    method: object, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(method, "MOST_STEPS", 2)
    (failure,) = solve(scene, draw_batch(scene, [0]), rtol=1e-14, cache=False).failures
    assert failure is not None
    assert failure.frame == 1
    assert "cannot be continued at 0.0" in failure.reason
    assert "2 steps do not reach the end of a frame; something moves too fast" in failure.reason

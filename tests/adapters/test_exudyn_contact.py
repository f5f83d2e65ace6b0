"""Contact in Exudyn: the impact law, friction, rolling, rest and flight, against exact answers."""

from __future__ import annotations

import importlib
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Joint, Scene, Torque
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball
from tests.adapters.exact import (
    Runs,
    balldrop_followed,
    ballscroll_followed,
    car_slips_on_the_ground,
    cubli_loses_energy,
    elastic_ball_keeps_its_energy,
    ends_in_the_ground,
)

pytest.importorskip("exudyn")
impact: Any = importlib.import_module("mbds_xsim_adapters.exudyn.contact")

ENGINE = load_adapter("exudyn")
G, MU, E = 9.81, 0.43, 0.9332
replaced = msgspec.structs.replace


def careful(
    substeps: int, impact_steps: int, slip_speed: float = 1e-2, step: float = 0.005
) -> Settings:
    options = {
        "contact_substeps": substeps,
        "impact_steps": impact_steps,
        "slip_speed": slip_speed,
    }
    return Settings("trapezoidal", step, options)


STIFF = careful(400, 32)
CAREFUL = {
    "ballscroll": careful(25, 6),
    "balldrop": careful(400, 32, slip_speed=0.1),
    "simplecubli": careful(5, 12, step=0.02 / 32),
    "particlecar": careful(3, 6, slip_speed=1e-3, step=0.02 / 16),
}
"""Settings finer than the matched ones, for tests of the contact laws."""


_RUNS = Runs(ENGINE, CAREFUL)
rollout, alone = _RUNS.rollout, _RUNS.alone


@pytest.mark.parametrize("noise", [True, False])
def test_ballscroll_follows_the_exact_solution(noise: bool) -> None:
    motion = ballscroll_followed(rollout, noise=noise)

    assert np.abs(motion.position[..., 1]).max() < 1e-9


@pytest.mark.parametrize("noise", [True, False])
def test_balldrop_follows_the_exact_solution(noise: bool) -> None:
    motion = balldrop_followed(rollout, 6, noise=noise, apex=3e-3)

    assert motion.position[..., 2].min() > 5 * R - 5e-3
    assert np.abs(motion.position[..., 1]).max() < 1e-8


@pytest.mark.parametrize("restitution", [0.3, 0.5, E, 1.0])
@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0, 8.0])
def test_restitution_is_the_scenes_at_every_speed(restitution: float, speed: float) -> None:
    """The energy at the first frame after the impact, still in flight, gives the rebound speed."""
    # Gravity changes the speed during an impact of 4e-4 s.
    within = 1e-3 + G * 4e-4 / speed
    assert rebound(restitution, speed) == pytest.approx(restitution, abs=within)


@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0, 8.0])
def test_without_restitution_nothing_comes_back(speed: float) -> None:
    """A damper critical for the ball lets it creep back to the surface, not off it."""
    assert rebound(0.0, speed) < 1e-3


def test_a_restitution_that_the_law_cannot_have_is_refused() -> None:
    scene = ball(ground=Ground(MU, 0.5 * impact._LEAST))
    with pytest.raises(Unsupported, match=r"restitution: got 0.005, allowed is 0, or 0.01 to 1"):
        ENGINE.open(scene, ENGINE.settings(scene, "matched"))


def test_without_restitution_is_what_reads_back() -> None:
    scene = ball(ground=Ground(MU, 0.0))
    _, differences = _RUNS.read_back(scene, scene)
    assert differences == []


def rebound(restitution: float, speed: float) -> float:
    """Return the speed after an impact over that before it."""
    scene = ball(0.01 * speed, (0.0, 0.0, -speed), ground=Ground(MU, restitution), steps=1)
    motion = alone(scene, STIFF)
    height, velocity = motion.position[0, 1, 0, 2] - R, motion.velocity[0, 1, 0, 2]
    squared = max(0.0, velocity**2 + 2 * G * height)
    return math.sqrt(squared / (speed**2 + 2 * G * 0.01 * speed))


@pytest.mark.parametrize("impact_steps", [6, 12, 24])
def test_impacts_of_few_steps_still_give_the_restitution(impact_steps: int) -> None:
    """Drop heights spread the impact over the phases of a step."""
    rebounds = []
    for k in range(8):
        drop = 0.03 + k / 8 * 3e-4
        motion = alone(ball(drop, (0.0, 0.0, -3.0), steps=1), careful(50, impact_steps))
        height, velocity = motion.position[0, 1, 0, 2] - R, motion.velocity[0, 1, 0, 2]
        rebounds.append(math.sqrt((velocity**2 + 2 * G * height) / (9.0 + 2 * G * drop)))

    assert np.mean(rebounds) == pytest.approx(E, abs=0.3 / impact_steps**2 + 1e-3)
    assert np.ptp(rebounds) < 1e-3  # steps end where the ball touches down and leaves


@pytest.mark.parametrize("restitution", [0.05, 0.2, 0.5, E, 0.99])
def test_laws_of_impact_give_what_they_are_asked_for(restitution: float) -> None:
    """The test integrates the law as Exudyn documents it."""
    value = impact.coefficient(restitution)
    damping = (
        1.5 * (1 - value) * (11 - value) / (1 + 9 * value)
        if value > 1 / 3
        else (1 - value**2) / value
    )

    def rate(_: float, y: Array) -> Array:
        return np.array([y[1], -y[0] * (1 + damping * y[1])])

    def leaves(_: float, y: Array) -> float:
        return float(y[0])

    leaves.terminal, leaves.direction = True, -1.0  # type: ignore[attr-defined]
    out = solve_ivp(rate, (0, 1e3), [1e-12, 1.0], "DOP853", events=leaves, rtol=1e-11, atol=1e-13)

    assert -out.y[1, -1] == pytest.approx(restitution, rel=1e-6)
    assert impact.delivered_restitution(value) == pytest.approx(restitution, rel=1e-9)


@pytest.mark.parametrize("restitution", [0.010106926732922168, 0.0125, 0.02503843997195001])
def test_the_least_restitutions_have_a_law_though_it_ends_within_rounding(
    restitution: float,
) -> None:
    value = impact.coefficient(restitution)

    assert impact.delivered_restitution(value) == pytest.approx(restitution, rel=1e-9)


def test_balls_grip_and_roll_up_a_slope_as_the_closed_form_says() -> None:
    """One ball rolls, one has backspin, and one spins on the spot, all at preset settings."""
    slope, frames = 0.2, 25
    gravity = (-G * math.sin(slope), 0.0, -G * math.cos(slope))
    scene = ball(gravity=gravity, ground=Ground(MU, 0.0), steps=frames)
    speed, spin = np.array([2.0, 2.0, 0.0]), np.array([2.0, -1.0, 1.5]) / R
    batch = draw_batch(scene, range(3), noise=False)
    batch.velocity[:, 0, 0], batch.angular_velocity[:, 0, 1] = speed, spin
    motion = rollout(scene, batch)

    # Friction reduces the slip at a constant rate; then the ball rolls.
    slip, push = speed - R * spin, MU * G * math.cos(slope)
    way = np.sign(slip)
    pull, end = G * math.sin(slope), slip / (3.5 * push * way + G * math.sin(slope))
    end = np.where(way, end, 0.0)
    slides = np.minimum(motion.time, end[:, None])
    rolls = motion.time - slides
    slowing = (pull + push * way)[:, None]
    rolling = speed[:, None] - slowing * slides
    exact = speed[:, None] * slides - slowing * slides**2 / 2
    exact += rolling * rolls - 5 / 7 * pull * rolls**2 / 2
    assert np.abs(motion.position[:, :, 0, 0] - exact).max() < 1e-4
    assert np.abs(motion.position[0, :, 0, 0] - exact[0]).max() < 1e-5  # it creeps by no more


def test_what_is_read_back_is_the_engines_own() -> None:
    other = replaced(
        ball(),
        ground=Ground(0.185, 0.88),
        contacts=(ContactSphere("ball", (0.0, 0.0, R), 1.01 * R),),
    )
    _, differences = _RUNS.read_back(ball(), other)
    assert [line.split()[0] for line in differences] == ["radius", "friction", "restitution"]


def test_an_elastic_ball_keeps_its_energy_over_many_bounces() -> None:
    elastic_ball_keeps_its_energy(lambda scene: alone(scene, STIFF), within=1e-3)


def test_the_cubli_gains_no_energy_on_the_ground_and_stays_above_it() -> None:
    cubli_loses_energy(rollout, 3, depth=0.02, rise=1e-4)


def test_the_car_drives_at_full_speed_without_hopping_or_clamps() -> None:
    car_slips_on_the_ground(alone, 25)


def test_fine_steps_do_not_shake_a_car_whose_wheels_slip() -> None:
    """Stiffer contact springs let friction excite trembling faster, so damping must be faster."""
    car = load_scene("particlecar")
    batch = draw_batch(car, [1], noise=False).truncated(2)
    motion = rollout(car, batch, careful(5, 6, slip_speed=1e-3, step=0.02 / 200))

    assert np.abs(motion.velocity[0, 1:, 0, 2]).max() < 5e-5


def test_the_native_text_alone_gives_the_same_motion() -> None:
    scene = ball(velocity=(4.0, 0.0, 0.0), steps=3)
    settings = careful(25, 6)
    with ENGINE.open(scene, settings) as run:
        batch = draw_batch(scene, [0])
        ours, text = run.rollout(batch), run.native(batch)
    names: dict[str, Any] = {}
    exec(text, names)
    coordinate = names["mbs"].systemData.GetODE2Coordinates()[0]
    np.testing.assert_allclose(ours.position[0, -1, 0, 0], coordinate, atol=1e-12)


def test_a_sphere_that_sinks_into_soft_ground_is_a_failure() -> None:
    """Once past the ground's triangle, a sphere would be pushed further down."""
    scene = ball(0.5, (0.0, 0.0, -20.0))
    ends_in_the_ground(rollout(scene, draw_batch(scene, [0]), careful(2, 12)))
    alone(scene, STIFF)  # with stiff contact it bounces


def test_only_contact_scenes_get_a_ground() -> None:
    for name, expected in (("balldrop", True), ("5pendulum", False)):
        text = _RUNS.native(load_scene(name))
        assert ("SphereTriangle" in text) == ("near_ground" in text) == expected


def test_wrong_requests_are_one_clear_line() -> None:
    scene = ball()
    with pytest.raises(Unsupported, match="RK67 cannot do sphere on the ground: friction"):
        ENGINE.open(scene, Settings("RK67", 0.002))
    for option, value in (("contact_substeps", 0), ("impact_steps", 2), ("slip_speed", 0.0)):
        with pytest.raises(InputError, match=f"option {option} of exudyn: got {value}"):
            ENGINE.open(scene, Settings("trapezoidal", 0.002, {option: value}))


@pytest.mark.parametrize("torque", [-10.0, -40.0])
def test_a_torque_may_drive_an_arm_to_the_ground_within_a_frame(torque: float) -> None:
    """Nothing else pulls. The first impact takes 1 - e² of what the torque has done by then."""
    gap = 0.01 if torque < -20.0 else 0.004
    height, moment = R + gap, 0.01 + 0.4**2
    pin = Joint(
        "pin", "hinge", "world", "arm", (0.0, 0.0, height), (0.0, -1.0, 0.0), start=0.0, rate=0.0
    )
    scene = Scene(
        "slap",
        (Body("arm", inertia=Inertia(1.0, (0.01,) * 3), position=(0.4, 0.0, height)),),
        0.4,
        gravity=(0.0, 0.0, 0.0),
        joints=(pin,),
        torques=(Torque("pin", (torque,)),),
        contacts=(ContactSphere("arm", (0.4, 0.0, height), R),),
        ground=Ground(0.0, 0.8),
        clock=Clock(0.02, 6),
    )
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(draw_batch(scene, [0]))
    assert motion.failures == (None,)
    angle = np.arcsin((motion.position[0, :, 0, 2] - height) / 0.4)
    energy = 0.5 * moment * motion.angular_velocity[0, :, 0, 1] ** 2 - torque * angle
    ground = -torque * math.asin(-gap / 0.4)
    assert energy[1] == pytest.approx((1.0 - 0.8**2) * ground, rel=0.05)
    assert (energy[1:] < 0.35 * ground).all()
    assert energy.min() > 1.05 * ground

"""Contact in MuJoCo: the impact law, friction, rolling, rest and flight, against exact answers."""

from __future__ import annotations

import contextlib
import importlib
import math
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.checks import audit
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Ground, Particle
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import settings_for
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

mujoco: Any = pytest.importorskip("mujoco")
impact_law: Any = importlib.import_module("mbds_xsim_adapters.mujoco.contact").impact_law

ENGINE = load_adapter("mujoco")
G, MU = 9.81, 0.43


def careful(contact_substeps: int, impact_steps: int) -> Settings:
    options = {"contact_substeps": contact_substeps, "impact_steps": impact_steps}
    return Settings("RK4", 0.005, options)


CAREFUL = {
    "ballscroll": careful(10, 1),
    "balldrop": careful(50, 1),
    "simplecubli": careful(50, 12),
    "particlecar": careful(10, 12),
}
"""Settings finer than the matched ones, for tests of the contact laws."""


_RUNS = Runs(ENGINE, CAREFUL)
rollout, alone = _RUNS.rollout, _RUNS.alone


@pytest.mark.parametrize("noise", [True, False])
def test_ballscroll_follows_the_exact_solution(noise: bool) -> None:
    ballscroll_followed(rollout, noise=noise)


@pytest.mark.parametrize("noise", [True, False])
def test_balldrop_follows_the_exact_solution(noise: bool) -> None:
    motion = balldrop_followed(rollout, 3, noise=noise, apex=1e-3)

    assert motion.position[..., 2].min() > 5 * R - 1e-3


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.9332, 1.0])
@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0, 8.0])
def test_restitution_is_the_scenes_at_every_speed(restitution: float, speed: float) -> None:
    """The energy at the first frame after the impact, still in flight, gives the rebound speed."""
    scene = ball(0.01 * speed, (0.0, 0.0, -speed), ground=Ground(MU, restitution), steps=1)
    motion = alone(scene)

    impact = math.sqrt(speed**2 + 2 * G * 0.01 * speed)
    height, velocity = motion.position[0, 1, 0, 2] - R, motion.velocity[0, 1, 0, 2]
    rebound = math.sqrt(max(0.0, velocity**2 + 2 * G * height))
    # An impact may miss the gravity of one step of 1e-4 s.
    assert rebound / impact == pytest.approx(restitution, abs=2e-4 + G * 1e-4 / speed)


def test_what_is_read_back_is_the_engines_own() -> None:
    other = msgspec.structs.replace(ball(), ground=Ground(0.185, 0.88))
    native, differences = _RUNS.read_back(ball(), other)

    assert native.contact is not None
    assert np.isnan(native.contact[:, 2]).all()  # MuJoCo has no restitution
    assert [line.split()[0] for line in differences] == ["friction"]


def test_an_elastic_ball_keeps_its_energy_over_many_bounces() -> None:
    elastic_ball_keeps_its_energy(alone, within=3e-4)


@pytest.mark.parametrize("speed", [0.3, 3.0, 8.0])
def test_an_impact_of_several_steps_gives_the_restitution_in_the_mean(speed: float) -> None:
    """Drop heights spread the impact over the phases of a step."""
    rebounds = []
    for k in range(12):
        drop = 0.01 * speed + k / 12 * 1e-4 * speed
        scene = ball(drop, (0.0, 0.0, -speed), steps=1)
        motion = alone(scene, careful(50, 12))
        height, velocity = motion.position[0, 1, 0, 2] - R, motion.velocity[0, 1, 0, 2]
        impact = speed**2 + 2 * G * drop
        rebounds.append(math.sqrt((velocity**2 + 2 * G * height) / impact))

    assert np.mean(rebounds) == pytest.approx(0.9332, abs=3e-3)
    assert max(rebounds) - min(rebounds) < 0.03


@pytest.mark.parametrize("impact_steps", [4, 12, 30])
def test_laws_of_impact_give_what_they_are_asked_for(impact_steps: int) -> None:
    """The test follows the law in the textbook form of semi-implicit Euler."""
    law = impact_law(0.8, impact_steps)
    speeds = []
    for phase in np.linspace(0.0, 1.0, 500, endpoint=False):
        height, speed = -phase - 1e-9, -1.0
        while height < 0.0:
            speed += max(0.0, -law.damping * speed - law.stiffness * height)
            height += speed
        speeds.append(speed)

    assert np.mean(speeds) == pytest.approx(0.8, abs=3e-3)


def test_the_cubli_gains_no_energy_on_the_ground_and_stays_above_it() -> None:
    cubli_loses_energy(rollout, 6, depth=0.01, rise=1e-3)


def test_the_car_drives_at_full_speed_without_hopping_or_clamps() -> None:
    car_slips_on_the_ground(alone, 50)


def test_a_car_whose_wheels_rattle_by_nanometres_is_not_recorded_as_in_flight() -> None:
    """All four wheels are at least 39 nm above the ground at frame 47, and slip throughout."""
    scene = load_scene("particlecar")
    batch = draw_batch(scene, [190], seed=7001).truncated(50)
    settings = settings_for(scene, ENGINE, "matched")
    motion = rollout(scene, batch, settings)

    findings = audit(scene, batch, motion, ENGINE.methods[settings.method], step=settings.step)

    cone = next(finding for finding in findings if finding.check == "cones")
    assert cone.figure[0] < 0.2 * scene.budget.balance


def test_a_cars_loads_come_to_a_limit_where_contacts_leave_half_to_the_spring() -> None:
    """Hard contacts bear all or nothing by rounding, so the car's path depends on the step."""
    scene = load_scene("particlecar")
    batch = draw_batch(scene, [0, 4, 8]).truncated(50)

    def moved(hardness: float) -> float:
        options = {"contact_substeps": 10, "impact_steps": 12, "contact_hardness": hardness}
        coarse, fine = (
            rollout(scene, batch, Settings("RK4", 0.02 / steps, options)).position
            for steps in (6, 12)
        )
        return float(np.linalg.norm(fine - coarse, axis=-1).max())

    assert moved(0.5) < 2e-4
    assert moved(0.9999) > 5e-3
    assert settings_for(scene, ENGINE, "matched").options["contact_hardness"] == 0.5
    own = msgspec.structs.replace(scene, name="my car")
    assert ENGINE.settings(own, "matched").options == {"contact_hardness": 0.5}
    with pytest.raises(
        InputError, match=r"contact_hardness of mujoco: got 1, allowed .* more than 0 and at most"
    ):
        ENGINE.open(scene, Settings("RK4", 0.005, {"contact_hardness": 1}))


def test_the_native_text_alone_gives_the_same_motion() -> None:
    """The text has the model of the finer steps, which are the only steps on the ground."""
    scene = msgspec.structs.replace(load_scene("ballscroll"), sampling=(), noise=0.0)
    pushed = msgspec.structs.replace(scene.bodies[0], velocity=(4.0, 0.0, 0.0))
    scene = msgspec.structs.replace(scene, bodies=(pushed,))
    with ENGINE.open(scene, CAREFUL["ballscroll"]) as run:
        ours = run.rollout(draw_batch(scene, [0]).truncated(5))
        text = run.native(draw_batch(scene, [0]))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_step(model, data, round(0.1 / model.opt.timestep))
    np.testing.assert_allclose(ours.position[0, -1, 0], data.qpos[:3], rtol=0, atol=1e-13)
    assert "integrator RK4 and timestep 0.005" in text


def test_a_sphere_that_sinks_into_soft_ground_is_a_failure() -> None:
    """MuJoCo's default contact lets a fast sphere sink in; its ground has no bottom."""
    scene = ball(0.5, (0.0, 0.0, -20.0))
    ends_in_the_ground(rollout(scene, draw_batch(scene, [0]), ENGINE.settings(scene, "native")))
    alone(scene)  # matched, it bounces


def test_only_contact_scenes_get_a_ground() -> None:
    for name, expected in (("balldrop", True), ("5pendulum", False)):
        text = _RUNS.native(load_scene(name))
        assert ("geom" in text) == ("elliptic" in text) == ("noslip" in text) == expected


def test_friction_of_bodies_so_heavy_that_the_solver_loses_it_is_refused() -> None:
    """The solver finds no friction if μ² times a sphere's compliance is below 1e-5 [1/kg]."""
    scene, settings = ball(ground=Ground(0.1, 0.5)), ENGINE.settings(ball(), "matched")
    for mass, lost in ((3000.0, False), (5000.0, True)):
        body = Body("ball", (Particle((0.0, 0.0, R), mass, 0.4 * mass * R**2),))
        heavy = msgspec.structs.replace(scene, bodies=(body,))
        refused = pytest.raises(Unsupported, match=r"at least 0\.12 for bodies this heavy")
        with refused if lost else contextlib.nullcontext():
            ENGINE.open(heavy, settings).close()

"""Checks of collisions between bodies: exact motions pass, and each wrong one shows."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.checks.audit import audit
from mbds_xsim.checks.finding import Finding
from mbds_xsim.reference import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing.collision_cases import RADIUS, TWO, Flying, balls, collided, cradle

_METHOD = load_adapter("mujoco").methods["RK4"]


def _findings(scene: Scene, motion: Trajectory) -> dict[str, Finding]:
    batch = draw_batch(scene, [0])
    findings = audit(scene, batch, motion, _METHOD, step=1e-4, contact_time=1e-4)
    return {one.check: one for one in findings}


def _over(findings: dict[str, Finding]) -> set[str]:
    return {
        name
        for name, one in findings.items()
        if one.budget is not None and (one.figure > one.budget + one.uncertainty).any()
    }


def _exact(name: str, friction: float = 0.3, restitution: float = 0.8) -> Trajectory:
    """Return the exact collision of two balls under the given coefficients."""
    scene: Any = SimpleNamespace(
        collisions=SimpleNamespace(friction=friction, restitution=restitution),
        clock=Clock(steps=25),
    )
    motion, _ = collided(scene, TWO[name])
    return _turned(motion)


def _turned(motion: Trajectory) -> Trajectory:
    """Integrate the balls' spins, which jump once, at the impact that positions show."""
    spin = motion.angular_velocity[0]
    before, after = spin[0], spin[-1]
    way = motion.position[0, -1] - motion.position[0, 0]
    gained = motion.velocity[0, -1] - motion.velocity[0, 0]
    one = int(np.abs(gained).max(axis=1).argmax())
    axis = int(np.abs(gained[one]).argmax())
    span = motion.time[-1]
    since = (way[one, axis] - span * motion.velocity[0, 0, one, axis]) / gained[one, axis]
    touch = span - since
    angle = before * np.minimum(motion.time, touch)[:, None, None]
    rest = after * np.maximum(motion.time - touch, 0.0)[:, None, None]
    turn = rotation.multiply(rotation.from_vector(rest), rotation.from_vector(angle))
    return dataclasses.replace(motion, orientation=turn[None])


@pytest.mark.parametrize("name", TWO)
def test_exact_collisions_pass_every_check(name: str) -> None:
    scene = balls(TWO[name])
    findings = _findings(scene, _exact(name))
    assert _over(findings) == set()
    assert findings["collision restitution"].figure < 1e-12
    assert findings["collision friction"].figure < 1e-9
    assert findings["collision gap"].figure < 1e-12
    assert "0.8000 to 0.8000 delivered" in findings["collision restitution"].note


@pytest.mark.parametrize("apart", [0.0, 1e-12, 1e-9, 1e-7])
def test_balls_that_pass_within_rounding_are_no_collision(apart: float) -> None:
    passing = Flying((-0.3, 2.0 * RADIUS + apart, 1.0), (1.3, 0.0, 0.0))
    scene = balls([passing, Flying((0.0, 0.0, 1.0))])
    findings = _findings(scene, solve(scene, draw_batch(scene, [0]), cache=False))
    assert _over(findings) == set()


@pytest.mark.parametrize("share", [0.3, 0.03, 1e-2, 1e-3])
@pytest.mark.parametrize("restitution", [0.8, 1.0])
def test_glances_are_judged_by_what_they_change(share: float, restitution: float) -> None:
    """Balls approach at a share of their speed; below a tenth, an error counts less."""
    passing = Flying((-0.3, 2.0 * RADIUS * math.sqrt(1.0 - share**2), 1.0), (1.3, 0.0, 0.0))
    pair = [passing, Flying((0.0, 0.0, 1.0))]
    motion, _ = collided(balls(pair, restitution=restitution), pair)
    finding = _findings(balls(pair), _turned(motion))["collision restitution"]
    error = abs(restitution - 0.8) * min(1.0, share / 0.1)
    assert finding.figure == pytest.approx(error, abs=1e-9)


@pytest.mark.parametrize("restitution", [0.78, 0.82, 1.0, 0.0])
def test_another_restitution_shows(restitution: float) -> None:
    findings = _findings(balls(TWO["head on"]), _exact("head on", restitution=restitution))
    assert "collision restitution" in _over(findings)
    assert findings["collision restitution"].figure == pytest.approx(abs(restitution - 0.8))
    assert findings["collision restitution"].where == ("ball 0 and ball 1",)


@pytest.mark.parametrize("friction", [0.0, 0.27, 0.33])
def test_another_friction_shows_where_balls_slide(friction: float) -> None:
    judged = _findings(balls(TWO["slides"]), _exact("slides", friction=friction))
    assert _over(judged) == {"collision friction"}
    assert judged["collision friction"].figure == pytest.approx(abs(friction / 0.3 - 1.0), abs=1e-6)


@pytest.mark.parametrize(("friction", "off"), [(0.3, 0.0), (0.27, 0.1), (0.33, 0.1)])
def test_balls_of_uneven_inertia_are_judged_by_the_moments_that_turn_them(
    friction: float, off: float
) -> None:
    """Both turn about z alone, about which their moments are those of the other tests."""
    starts = (
        Flying((0.0, 0.0, 1.0), (2.0, 0.3, 0.0), (0.0, 0.0, 150.0)),
        Flying((0.4, 0.07, 1.0), mass=2.0),
    )
    bodies = tuple(
        Body(
            f"ball {k}",
            inertia=Inertia(ball.mass, (1.8 * ball.moment, 0.9 * ball.moment, ball.moment)),
            position=ball.place, velocity=ball.velocity, angular_velocity=ball.spin,
        )
        for k, ball in enumerate(starts)
    )  # fmt: skip
    law: Any = SimpleNamespace(
        collisions=SimpleNamespace(friction=friction, restitution=0.8), clock=Clock(steps=25)
    )
    scene = msgspec.structs.replace(balls(starts), bodies=bodies)
    findings = _findings(scene, _turned(collided(law, starts)[0]))
    assert findings["collision friction"].figure == pytest.approx(off, abs=1e-6)


def test_energy_out_of_nothing_shows() -> None:
    findings = _findings(balls(TWO["head on"]), _exact("head on", restitution=1.05))
    assert {"passivity", "collision restitution"} <= _over(findings)


def test_balls_that_go_through_each_other_show() -> None:
    motion = _exact("head on")
    motion.velocity[:] = motion.velocity[:, :1]
    motion.position[:] = motion.position[:, :1] + motion.time[:, None, None] * motion.velocity
    failed = _over(_findings(balls(TWO["head on"]), motion))
    assert {"penetration", "collision restitution"} == failed


def test_an_impulse_on_one_ball_alone_shows() -> None:
    """The contact pushes one body and not the other."""
    motion = _exact("head on")
    after = motion.velocity[0, :, 1, 0] > 0.0
    first = int(after.argmax())
    motion.velocity[0, first:, 1] = motion.velocity[0, 0, 1]
    late = motion.time[first:] - motion.time[first]
    motion.position[0, first:, 1] = (
        motion.position[0, first, 1] + late[:, None] * motion.velocity[0, 0, 1]
    )
    assert "momentum" in _over(_findings(balls(TWO["head on"]), motion))


def test_balls_that_meet_at_a_distance_show() -> None:
    """The engine simulates spheres that are 5 % too large."""
    scene = balls(TWO["head on"])
    spheres = (msgspec.structs.replace(one, radius=1.05 * RADIUS) for one in scene.contacts)
    wrong = msgspec.structs.replace(scene, contacts=tuple(spheres))
    adapter = load_adapter("mujoco")
    with adapter.open(wrong, adapter.settings(wrong, "matched")) as run:
        motion = run.rollout(draw_batch(wrong, [0]))
    findings = _findings(scene, motion)
    assert "collision gap" in _over(findings)
    assert findings["collision gap"].figure == pytest.approx(0.1 * RADIUS, rel=0.05)


def test_momentum_of_one_ball_changes_in_collisions_alone() -> None:
    """A push in flight, far from any other ball, is no collision."""
    scene = balls([Flying((0.0, 0.0, 1.0), (1.5, 0.0, 0.0)), Flying((3.0, 0.0, 1.0))])
    motion = solve(scene, draw_batch(scene, [0]), cache=False)
    motion.velocity[0, 10:, 0] += 0.1
    motion.position[0, 10:, 0] += 0.1 * (motion.time[10:, None] - motion.time[10])
    assert {"momentum", "energy"} <= _over(_findings(scene, motion))


def test_joined_bodies_that_collide_are_judged_between_their_impacts() -> None:
    """Energy is constant except where bodies may touch; friction there is not known to add any."""
    scene = cradle(0.5)
    adapter = load_adapter("mujoco")
    settings = adapter.settings(scene, "matched")
    with adapter.open(scene, settings) as run:
        motion = run.rollout(draw_batch(scene, [0]))
    assert _over(_findings(scene, motion)) == set()
    motion.velocity[0, 45:] *= 1.05
    assert "energy" in _over(_findings(scene, motion))

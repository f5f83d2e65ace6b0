"""The end of the reference at the first impact, in scenes with several contact points."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.integrate import quad

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import FirstImpact, sensitivity, solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    ContactSphere,
    Ground,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
)
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.registry import load_scene
from tests.over_ground import over_ground

RADIUS = 0.05
ANGLE = math.asin(0.8)


def dumbbell(
    *,
    height: float,
    speed: float = 1.0,
    spin: float = 0.0,
    springs: tuple[SpringDamper, ...] = (),
) -> Scene:
    """Make a bar along x with a sphere at each end, 0.5 m from its centre."""
    bar = Body(
        "bar",
        inertia=Inertia(1.0, (0.01, 0.2, 0.2), com=(0.0, 0.0, height)),
        velocity=(speed, 0.0, 0.0),
        angular_velocity=(0.0, spin, 0.0),
    )
    spheres = tuple(ContactSphere("bar", (x, 0.0, height), RADIUS) for x in (-0.5, 0.5))
    return Scene(
        "dumbbell",
        (bar,),
        1.0,
        springs=springs,
        contacts=spheres,
        ground=Ground(0.4, 0.9),
        clock=Clock(0.02, 60),
    )


def run(scene: Scene) -> Trajectory:
    return solve(scene, draw_batch(scene, [0]), cache=False)


def impact(result: Trajectory) -> FirstImpact:
    (failure,) = result.failures
    assert isinstance(failure, FirstImpact)
    assert "no unique solution" in failure.reason
    assert failure.frame == math.floor(failure.time / 0.02) + 1
    assert np.isfinite(result.position[0, : failure.frame]).all()
    assert np.isnan(result.position[0, failure.frame :]).all()
    return failure


def test_falls_flat() -> None:
    result = run(dumbbell(height=1.0))
    assert impact(result).time == pytest.approx(math.sqrt(2 * (1.0 - RADIUS) / 9.81), abs=1e-13)
    frames = result.failures[0].frame if result.failures[0] else 0
    height = 1.0 - 0.5 * 9.81 * result.time[:frames] ** 2
    np.testing.assert_allclose(result.position[0, :frames, 0, 2], height, rtol=0, atol=1e-12)


@pytest.mark.parametrize("spin", [5.0, 20.0, 100.0])
def test_spinning_tip_touches_first(spin: float) -> None:
    """The first tip touches at 1 − g t²/2 − |sin(ω t)|/2 = r, which bisection solves."""
    touch = impact(run(dumbbell(height=1.0, spin=spin))).time

    def height(t: Array) -> Array:
        return np.asarray(1.0 - 0.5 * 9.81 * t**2 - 0.5 * np.abs(np.sin(spin * t)) - RADIUS)

    times = np.linspace(0.0, 0.5, 1_000_001)
    first = int(np.argmax(height(times) <= 0.0))
    low, high = times[first - 1], times[first]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if height(middle) > 0.0 else (low, middle)
    assert touch == pytest.approx(low, abs=1e-12)


def test_a_graze_between_steps_is_seen() -> None:
    """The tips of a bar that turns in place dip below the ground for a short while only."""
    spin, height = 3.0, 0.5 + RADIUS - 1e-5
    still = (0.0, 0.0, 0.0)
    scene = msgspec.structs.replace(dumbbell(height=height, spin=spin), gravity=still)
    expected = math.asin((height - RADIUS) / 0.5) / spin
    assert impact(run(scene)).time == pytest.approx(expected, abs=1e-11)
    lifted = msgspec.structs.replace(dumbbell(height=height + 2e-5, spin=spin), gravity=still)
    assert run(lifted).failures == (None,)


def test_stiff_scenes_end_alike() -> None:
    """Only the implicit method gets through the damper; m v' = −m g − c v is known exactly."""
    damping, height = 150.0, 0.1
    damper = SpringDamper(
        "damper", ("world", "bar"), ((0.0, 0.0, 9.0), (0.0, 0.0, height)), damping=damping
    )
    touch = impact(run(dumbbell(height=height, speed=0.0, springs=(damper,)))).time
    fallen = 9.81 / damping * (touch - (1.0 - math.exp(-damping * touch)) / damping)
    assert touch > 0.5
    assert fallen == pytest.approx(height - RADIUS, rel=1e-7)


def test_starts_in_contact() -> None:
    scene = load_scene("particlecar")
    result = solve(scene, draw_batch(scene, [0]), cache=False)
    failure = impact(result)
    assert (failure.frame, failure.time) == (1, 0.0)


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_what_is_fixed_to_the_world_does_not_hit_the_ground(friction: float) -> None:
    """A post stands in the ground, and a body that is fixed on it carries a pendulum."""
    inertia = Inertia(1.0, (0.01,) * 3)
    scene = Scene(
        "posts",
        (
            Body("foot", inertia=inertia, position=(0.0, 0.0, 0.04)),
            Body("post", inertia=inertia, position=(0.0, 0.0, 1.0)),
            Body("bob", inertia=inertia, position=(0.5, 0.0, 2.0)),
        ),
        1.0,
        joints=(
            Joint("weld", "fixed", "foot", "post", (0.0, 0.0, 0.5)),
            Joint("floor", "fixed", "world", "foot", (0.0, 0.0, 0.0)),
            Joint(
                "pin", "hinge", "post", "bob", (0.0, 0.0, 2.0), (0.0, 1.0, 0.0), friction=friction
            ),
        ),
        contacts=(ContactSphere("foot", (0.0, 0.0, 0.04), RADIUS),),
        ground=Ground(0.4, 0.9),
        clock=Clock(0.02, 20),
    )

    assert run(scene).failures == (None,)


def test_starts_in_the_ground() -> None:
    with pytest.raises(InputError, match=r"contacts\[0\] on 'bar' starts 0\.03 m below"):
        run(dumbbell(height=0.02))


def test_cubli_flies_as_its_momenta_say() -> None:
    """The cubli's centre of mass falls freely, and its first impact does not depend on rtol."""
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, range(3), noise=False)
    result = solve(scene, batch, cache=False)
    mechanism = Mechanism.of(scene)
    finer = solve(scene, batch, rtol=1e-13, cache=False)
    share = mechanism.mass / mechanism.mass.sum()
    for row, (failure, other) in enumerate(zip(result.failures, finer.failures, strict=True)):
        assert isinstance(failure, FirstImpact)
        assert isinstance(other, FirstImpact)
        assert failure.time == pytest.approx(other.time, abs=1e-12)
        t = result.time[: failure.frame, None]
        centre = np.einsum("fnk,n->fk", result.position[row, : failure.frame], share)
        speed = share @ result.velocity[row, 0]
        expected = centre[0] + speed * t + 0.5 * np.array(scene.gravity) * t**2
        np.testing.assert_allclose(centre, expected, rtol=0, atol=1e-12)
        assert np.isnan(result.position[row, failure.frame :]).all()


def test_impact_survives_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    scene = dumbbell(height=1.0)
    batch = draw_batch(scene, [0])
    first = solve(scene, batch)
    assert list(tmp_path.rglob("*.npz"))
    assert solve(scene, batch).failures == first.failures
    assert impact(first).time > 0.0


def test_growth_ends_with_the_first_of_the_pair() -> None:
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, range(3))
    growth = sensitivity(scene, batch, cache=False)
    result = solve(scene, batch, cache=False)
    for row, failure in enumerate(result.failures):
        assert failure is not None
        assert abs(int(np.isfinite(growth[row]).sum()) - failure.frame) <= 1
        assert np.isnan(growth[row, failure.frame + 1 :]).all()


def test_a_hanging_sphere_reaches_the_ground() -> None:
    """A pendulum with one sphere is no free ball; its energy gives its speed at the impact."""
    moment, radius = 0.1, 0.2
    bob = Body("bob", inertia=Inertia(1.0, (moment,) * 3, com=(1.0, 0.0, 1.0)))
    pivot = Joint("pivot", "hinge", "world", "bob", (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    more = {"joints": (pivot,), "clock": Clock(0.02, 60)}
    scene = over_ground(bob, (1.0, 0.0, 1.0), radius, Ground(0.4, 0.9), **more)
    touch = impact(run(scene)).time
    # From the horizontal: φ' = √(2 g sin φ / (1 + I)), down to 1 − sin φ = r; φ = x².
    rate = math.sqrt(2.0 * 9.81 / (1.0 + moment))
    time, _ = quad(lambda x: 2.0 * x / (rate * math.sqrt(math.sin(x * x))), 0.0, math.sqrt(ANGLE))
    assert touch == pytest.approx(time, abs=1e-10)

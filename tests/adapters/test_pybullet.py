"""PyBullet: exact answers on small scenes, loops, splits, clamps and the listing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError, Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Force,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
)
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from tests.adapters.exact import gimbal_followed, worst_gap

pytest.importorskip("pybullet")

ENGINE = load_adapter("pybullet")
METHOD = "semi-implicit-euler"
NO_GRAVITY = (0.0, 0.0, 0.0)


def body(name: str, at: tuple[float, float, float] = (0.0, 0.0, 0.0), **extra: Any) -> Body:
    """Make a body with principal axes along none of W's, and a mass that is no round number."""
    full = Inertia(mass=1.3, moments=(0.03, 0.05, 0.06), products=(0.01, -0.004, 0.008), com=at)
    return Body(name, inertia=extra.pop("inertia", full), **extra)


def scene(*bodies: Body, frame: float = 0.02, steps: int = 10, **parts: Any) -> Scene:
    return Scene("probe", bodies, length=1.0, clock=Clock(frame, steps), **parts)


def simulate(probe: Scene, substeps: int = 10, **options: float) -> Trajectory:
    batch = draw_batch(probe, [0], noise=False)
    with ENGINE.open(probe, Settings(METHOD, probe.clock.frame / substeps, options)) as run:
        return run.rollout(batch)


def extrapolated(probe: Scene, substeps: int, **options: float) -> Trajectory:
    """Extrapolate the first-order error away, so that a wrong model shows at once."""
    coarse, fine = (simulate(probe, n, **options) for n in (substeps, 2 * substeps))
    assert coarse.failures == fine.failures == (None,)
    return Trajectory(
        fine.time,
        2 * fine.position - coarse.position,
        2 * fine.orientation - coarse.orientation,
        2 * fine.velocity - coarse.velocity,
        2 * fine.angular_velocity - coarse.angular_velocity,
        fine.failures,
    )


@pytest.mark.parametrize("substeps", [1, 7, 49, 103])
def test_a_constant_force_is_held_in_the_world_over_all_sub_steps(substeps: int) -> None:
    force = (0.7, -0.4, 5.0)
    spun = body("a", velocity=(1.0, 2.0, 0.0), angular_velocity=(3.0, -2.0, 4.0))
    pushed = scene(spun, forces=(Force("a", (force,)),))
    motion, free = simulate(pushed, substeps), simulate(scene(spun), substeps)
    # Semi-implicit Euler's own answer, exact in every digit if no step is missing or doubled.
    h = 0.02 / substeps
    n = substeps * np.arange(11)[:, None]
    acceleration = np.array(force) / 1.3 + [0.0, 0.0, -9.81]
    exact = h * n * [1.0, 2.0, 0.0] + acceleration * h**2 * n * (n + 1) / 2
    np.testing.assert_allclose(motion.position[0, :, 0], exact, rtol=0, atol=1e-12)
    # The force acts at the centre of mass, fixed in W, and leaves the rotation alone.
    np.testing.assert_allclose(motion.orientation, free.orientation, rtol=0, atol=1e-12)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_slider_carries_a_mass_down_an_incline(reverse: bool) -> None:
    down = np.array([0.8, 0.0, -0.6])
    ends = ("a", "world") if reverse else ("world", "a")
    probe = scene(
        body("a", (0.3, 0.2, -0.1)),
        joints=(Joint("rail", "slider", *ends, (0.1, 0.0, 0.0), tuple(down), rate=0.5),),
    )
    motion = simulate(probe, 10)
    n = 10 * np.arange(11)[:, None]
    sign = -1.0 if reverse else 1.0
    along = sign * 0.5 * 0.002 * n + 9.81 * 0.6 * 0.002**2 * n * (n + 1) / 2
    exact = np.array([0.3, 0.2, -0.1]) + along * down
    np.testing.assert_allclose(motion.position[0, :, 0], exact, rtol=0, atol=1e-11)


def test_a_fixed_joint_makes_one_body_of_two() -> None:
    spin = (2.0, 1.0, -3.0)
    pair = scene(
        body("a", angular_velocity=spin),
        body("b", (0.4, 0.1, 0.2)),
        joints=(Joint("weld", "fixed", "a", "b", (0.3, 0.0, 0.0)),),
        gravity=NO_GRAVITY,
    )
    mechanism = Mechanism.of(pair)
    center = mechanism.mass @ mechanism.com / mechanism.mass.sum()
    arms = mechanism.com - center
    total = mechanism.inertia.sum(axis=0) + sum(
        m * (np.eye(3) * (r @ r) - np.outer(r, r))
        for m, r in zip(mechanism.mass, arms, strict=True)
    )
    xx, yy, zz = np.diag(total)
    whole = Inertia(
        mass=float(mechanism.mass.sum()),
        moments=(xx, yy, zz),
        products=(total[0, 1], total[0, 2], total[1, 2]),
        com=tuple(center),
    )
    drawn = draw_batch(pair, [0])
    momentum = mechanism.mass @ drawn.velocity[0] / mechanism.mass.sum()
    one = scene(
        Body(
            "whole",
            inertia=whole,
            velocity=tuple(momentum),
            angular_velocity=tuple(drawn.angular_velocity[0, 0]),
        ),
        gravity=NO_GRAVITY,
    )
    two_motion, one_motion = extrapolated(pair, 40), extrapolated(one, 40)
    np.testing.assert_allclose(
        two_motion.orientation[0, :, 1], one_motion.orientation[0, :, 0], rtol=0, atol=2e-6
    )


def test_a_spring_off_centre_turns_both_bodies() -> None:
    probe = scene(
        body("a"),
        body("b", (0.6, 0.0, 0.0)),
        springs=(SpringDamper("s", ("a", "b"), ((0, 0.1, 0), (0.6, -0.2, 0.1)), 50.0, 1.0, 0.3),),
        gravity=NO_GRAVITY,
    )
    mechanism, motion = Mechanism.of(probe), extrapolated(probe, 20)
    turn = rotation.matrix(mechanism.native_rotation(motion.orientation[0, -1]))
    spin = np.einsum(
        "bij,bjk,blk,bl->bi", turn, mechanism.inertia, turn, motion.angular_velocity[0, -1]
    )
    linear = mechanism.mass[:, None] * motion.velocity[0, -1]
    assert np.abs(spin).max() > 0.01
    np.testing.assert_allclose(linear.sum(axis=0), 0.0, atol=1e-12)
    momentum = spin.sum(axis=0) + np.cross(motion.position[0, -1], linear).sum(axis=0)
    np.testing.assert_allclose(momentum, 0.0, atol=2e-4)


def test_a_fixed_loop_of_moving_bodies_holds() -> None:
    """Two arms on ball joints, welded at their ends, swing about the line between the joints."""
    probe = scene(
        body("a", (0.0, 0.2, -0.3)),
        body("b", (0.0, 0.8, -0.3)),
        joints=(
            Joint("left", "ball", "world", "a", (0.0, 0.0, 0.0)),
            Joint("right", "ball", "world", "b", (0.0, 1.0, 0.0)),
            Joint("weld", "fixed", "a", "b", (0.0, 0.5, -0.3)),
        ),
        gravity=(3.0, 0.0, -9.81),
    )
    assert worst_gap(probe, simulate(probe, 50)) < 1e-5


@pytest.mark.parametrize("start_rate", [0.0, 12.0])
def test_ball_joints_in_line_make_a_hinge(start_rate: float) -> None:
    """The door hangs once on a hinge and once on two ball joints, one of which closes a loop."""
    door = body("door", (0.3, 0.1, 0.0), angular_velocity=(0.0, 0.0, start_rate))
    top, foot = (0.0, 0.0, 0.4), (0.0, 0.0, -0.4)
    hinged = scene(
        door, joints=(Joint("h", "hinge", "world", "door", foot, (0, 0, 1)),), gravity=(0, 5, -9)
    )
    balls = scene(
        door,
        joints=(
            Joint("top", "ball", "world", "door", top),
            Joint("foot", "ball", "door", "world", foot),
        ),
        gravity=(0, 5, -9),
    )
    one, two = extrapolated(hinged, 100), extrapolated(balls, 100)
    np.testing.assert_allclose(one.position, two.position, rtol=0, atol=2e-5)


@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_a_hinge_closes_a_loop_of_bodies_that_are_centred_on_it(off: float) -> None:
    gimbal_followed(ENGINE, off)


@pytest.mark.parametrize("kind", ["slider", "hinge"])
def test_a_stop_holds_a_body_however_heavy(kind: Literal["slider", "hinge"]) -> None:
    ends = []
    for mass in (1.0, 1e12):
        block = body("block", inertia=Inertia(mass, (mass,) * 3, com=(0.5, 0.0, 0.0)))
        axis = (0.0, 0.0, 1.0) if kind == "slider" else (0.0, -1.0, 0.0)
        joint = Joint("j", kind, "world", "block", (0, 0, 0), axis, limits=(-0.01, 1.0))
        ends.append(simulate(scene(block, joints=(joint,))).position[0, -1, 0, 2])
    assert ends[1] == pytest.approx(ends[0], abs=1e-9)


@pytest.mark.parametrize("limit", [8, 9, 12])
def test_a_split_tree_moves_as_the_whole(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    probe = load_scene("6pendulum")
    batch = draw_batch(probe, [1], noise=False).truncated(15)
    settings = Settings(METHOD, 1e-4, {"solver_iterations": 200})
    with ENGINE.open(probe, settings) as run:
        whole = run.rollout(batch)
        assert run.size.constraints == 0
    parts = sys.modules["mbds_xsim_adapters.pybullet.parts"]
    monkeypatch.setattr(parts, "COORDINATE_LIMIT", limit)
    with ENGINE.open(probe, settings) as run:
        split = run.rollout(batch)
        assert run.size.constraints >= 3
        assert not readback.compare(Mechanism.of(probe), batch, settings, run.readback(batch))
    np.testing.assert_allclose(split.position, whole.position, rtol=0, atol=1e-3)
    assert worst_gap(probe, split) < 1e-5


def test_a_long_chain_is_split_and_stays_whole() -> None:
    probe = load_scene("40pendulum")
    batch = draw_batch(probe, [0]).truncated(5)
    settings = Settings(METHOD, 1e-4)
    with ENGINE.open(probe, settings) as run:
        assert run.size.constraints == 3
        assert not readback.compare(Mechanism.of(probe), batch, settings, run.readback(batch))
        motion = run.rollout(batch)
    assert motion.failures == (None,)
    assert worst_gap(probe, motion) < 1e-4


def test_the_model_is_read_back_as_the_scene_has_it() -> None:
    probe = scene(
        body("a"),
        body("b", (0.4, 0.1, 0.2)),
        body("c", (0.1, 0.5, -0.2)),
        joints=(
            Joint("ab", "hinge", "b", "a", (0.3, 0.0, 0.0), (1.0, 2.0, 3.0), start=0.4, rate=2.0),
            Joint("bc", "slider", "b", "c", (0.2, 0.3, 0.0), (0.0, 1.0, 1.0), start=0.1),
        ),
    )
    batch, settings = draw_batch(probe, [0]), Settings(METHOD, 0.001)
    with ENGINE.open(probe, settings) as run:
        model = run.readback(batch)
    assert readback.compare(Mechanism.of(probe), batch, settings, model) == []


def test_too_fast_a_spin_ends_the_trajectory() -> None:
    probe = scene(body("a", angular_velocity=(0.0, 0.0, 500.0)))
    motion = simulate(probe, 10)
    failure = motion.failures[0]
    assert failure is not None
    assert failure.frame == 1
    assert "π/4" in failure.reason
    assert np.isfinite(motion.position[0, 0]).all()
    assert np.isnan(motion.position[0, 1:]).all()


def test_a_blow_up_ends_the_trajectory_and_leaves_the_next_alone() -> None:
    stiff = SpringDamper("s", ("world", "a"), ((0, 0, 1), (0, 0, 0.1)), 1e9)
    probe = scene(body("a", velocity=(0.0, 0.0, 1.0)), springs=(stiff,), steps=200)
    batch = draw_batch(probe, [0, 1])
    with ENGINE.open(probe, Settings(METHOD, 0.02)) as run:
        motion = run.rollout(batch)
    assert all(failure is not None for failure in motion.failures)
    assert motion.failures[0] == motion.failures[1]
    assert np.array_equal(motion.position[0], motion.position[1], equal_nan=True)


def test_an_ordinary_user_gets_damping() -> None:
    probe = scene(body("a", velocity=(1.0, 0.0, 0.0)), gravity=NO_GRAVITY, steps=50)
    settings = ENGINE.settings(probe, "native")
    assert settings.step == pytest.approx(0.004)
    with ENGINE.open(probe, settings) as run:
        speed = run.rollout(draw_batch(probe, [0])).velocity[0, -1, 0, 0]
    assert 0.9 < speed < 0.97


def test_what_bullet_cannot_do_is_refused() -> None:
    rod = DistanceLink("rod", ("world", "a"), ((0, 0, 1), (0, 0, 0)))
    rails = tuple(Joint(f"rail{k}", "slider", "world", "a", (k, 0, 0), (0, 0, 1)) for k in (0, 1))
    for probe in (scene(body("a"), distance_links=(rod,)), scene(body("a"), joints=rails)):
        with pytest.raises(Unsupported):
            ENGINE.open(probe, Settings(METHOD, 0.001))
    for options in ({"erp": 2.0}, {"solver_iterations": 0}, {"linear_damping": -1.0}):
        with pytest.raises(InputError):
            ENGINE.open(scene(body("a")), Settings(METHOD, 0.001, options))


def test_the_listing_runs_without_the_toolkit_and_nothing_is_printed(tmp_path: Path) -> None:
    code = (
        "from mbds_xsim.simulate.registry import load_adapter, load_scene\n"
        "from mbds_xsim.scene.sampling import draw_batch\n"
        "engine, scene = load_adapter('pybullet'), load_scene('2ladder')\n"
        "batch = draw_batch(scene, [0], noise=False, inputs=False)\n"
        "with engine.open(scene, engine.settings(scene, 'native')) as run:\n"
        "    end = run.rollout(batch).position[0, -1, [0, 25]].ravel()\n"
        f"    open({str(tmp_path / 'model.py')!r}, 'w').write(run.native(batch))\n"
        f"end.tofile({str(tmp_path / 'end')!r})\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert (done.stdout, done.stderr) == ("", "")
    listing = subprocess.run(
        [sys.executable, tmp_path / "model.py"], capture_output=True, check=True, text=True
    )
    first, last = np.fromfile(tmp_path / "end").reshape(2, 3).tolist()
    assert str(tuple(first)) in listing.stdout
    assert str(tuple(last)) in listing.stdout

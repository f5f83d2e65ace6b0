from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.checks import Record
from mbds_xsim.checks.balances import balances_of
from mbds_xsim.checks.conservation import momentum
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    Body,
    Clock,
    DistanceLink,
    Ground,
    Inertia,
    Joint,
    Scene,
    SpringDamper,
    Torque,
)
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_scene
from tests.over_ground import over_ground

RK4 = Method("RK4", "RK4", 4)
LEAPFROG = Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5)
BALL = Inertia(1.0, (0.1, 0.1, 0.1))
Z, X = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


def test_an_exact_motion_balances_within_what_quadrature_resolves(
    pendulum: Any, tumbling: Any
) -> None:
    for case in (pendulum, tumbling):
        finding = momentum.finding(Record(case.scene, case.batch, case.exact, RK4, 2e-3))
        assert finding.passed.all()
        assert (finding.figure < 1e-5).all()
        assert (finding.uncertainty < 1e-4).all()
        assert "impulses known to" in finding.note


def test_two_pivots_on_parallel_axes_leave_nothing(linkage: Any) -> None:
    assert momentum(Record(linkage.scene, linkage.batch, linkage.exact)) is None


@pytest.mark.parametrize(("wrong", "share"), [("gravity", 1e-3), ("force", 0.05)])
def test_another_gravity_or_other_forces_show(pendulum: Any, wrong: str, share: float) -> None:
    """The check assumes 9.82 m/s², or forces that are 5 % larger, for 40 frames."""
    scene, batch = pendulum.scene, pendulum.batch
    if wrong == "gravity":
        scene = msgspec.structs.replace(scene, gravity=(0.0, 0.0, -9.81 * (1 + share)))
    else:
        batch = dataclasses.replace(batch, force=(1 + share) * batch.force)
    right = momentum.finding(Record(pendulum.scene, pendulum.batch, pendulum.exact, RK4, 2e-3))
    finding = momentum.finding(Record(scene, batch, pendulum.exact, RK4, 2e-3))

    assert (finding.figure > 100 * right.figure).all()
    assert (finding.figure > 2 * finding.uncertainty).all()


def test_free_fall_shows_gravity_exactly(tumbling: Any) -> None:
    other = msgspec.structs.replace(tumbling.scene, gravity=(0.0, 0.0, -9.80))
    finding = momentum.finding(Record(other, tumbling.batch, tumbling.exact, RK4, 2e-3))
    assert finding.where[0] == "linear momentum, hull"
    # 2.5 kg that gain 0.01 m/s² for 0.8 s, over the largest momentum.
    speed = np.linalg.norm(tumbling.exact.velocity, axis=-1)
    largest = np.max(speed @ np.array([2.0, 0.5]), axis=1)
    assert np.allclose(finding.figure, 2.5 * 0.01 * 0.8 / largest, rtol=1e-4)


def test_a_spin_that_decays_is_named(tumbling: Any) -> None:
    """Drag of 0.04 per second on angular velocities, as an engine has by default."""
    decay = np.exp(-0.04 * tumbling.exact.time)[:, None, None]
    braked = dataclasses.replace(
        tumbling.exact, angular_velocity=tumbling.exact.angular_velocity * decay
    )
    finding = momentum.finding(Record(tumbling.scene, tumbling.batch, braked, RK4, 2e-3))
    assert not finding.passed.any()
    assert set(finding.where) == {"angular momentum, hull"}


def test_lagging_velocities_are_accounted_for(
    drawn: Callable[..., Any], simulate: Callable[..., Any]
) -> None:
    """The error is the lag's alone in a single link; in chains the method adds its own."""
    scene, batch = drawn(load_scene("1pendulum"), 20)
    motion = simulate(scene, batch, 20, "euler_reduced")
    silent = dataclasses.replace(LEAPFROG, velocity_lag=0.0)
    known, unknown = (
        momentum.finding(Record(scene, batch, motion, method, 1e-3))
        for method in (LEAPFROG, silent)
    )

    assert (known.figure < 0.1 * unknown.figure).all()


def _scene(*joints: Joint, count: int = 1, **parts: Any) -> Scene:
    bodies = tuple(Body(f"b{k}", inertia=BALL, position=(k, 0.0, -1.0)) for k in range(count))
    return Scene(name="rig", bodies=bodies, joints=joints, length=1.0, **parts)


def _joint(kind: Any, child: str, x: float, z: float = 0.0, axis: Any = None) -> Joint:
    return Joint(f"{kind}{x}{z}", kind, "world", child, (x, 0.0, z), axis)


def _pull(x: float) -> SpringDamper:
    return SpringDamper("pull", ("world", "b0"), ((x, 0.0, 0.0), (0.0, 0.0, -1.0)), 10.0)


@pytest.mark.parametrize(
    ("scene", "left"),
    [
        (_scene(), ["linear 3", "angular 3"]),
        (_scene(count=2), ["linear 3", "angular 3"] * 2),
        (_scene(Joint("pin", "ball", "b0", "b1", (0.5, 0, 0)), count=2), ["linear 3", "angular 3"]),
        (_scene(_joint("ball", "b0", 0.0)), ["angular 3"]),
        (_scene(springs=(_pull(0.0),)), ["angular 3"]),
        (
            _scene(
                distance_links=(DistanceLink("rope", ("world", "b0"), ((0, 0, 0), (0, 0, -1))),)
            ),
            ["angular 3"],
        ),
        # Through two points there is one line.
        (_scene(_joint("ball", "b0", 0.0), springs=(_pull(0.7),)), ["angular 1"]),
        (_scene(_joint("hinge", "b0", 0.0, axis=Z)), ["angular 1"]),
        (_scene(_joint("hinge", "b0", 0.0, axis=Z), _joint("ball", "b0", 0.0, 1.0)), ["angular 1"]),
        (_scene(_joint("hinge", "b0", 0.0, axis=Z), _joint("ball", "b0", 0.5)), []),
        (_scene(_joint("hinge", "b0", 0.0, axis=Z), springs=(_pull(0.5),)), []),
        (_scene(_joint("fixed", "b0", 0.0)), []),
        (_scene(_joint("slider", "b0", 0.0, axis=X)), ["linear 1"]),
        (_scene(_joint("slider", "b0", 0.0, axis=X), springs=(_pull(0.5),)), []),
        (_scene(_joint("fixed", "b0", 0.0), count=2), ["linear 3", "angular 3"]),
    ],
)
def test_what_supports_leave(scene: Scene, left: list[str]) -> None:
    balances = balances_of(Mechanism.of(scene))
    assert [f"{each.name.split()[0]} {len(each.directions)}" for each in balances] == left


def test_pendulums_have_their_anchor_and_ladders_the_line_of_two() -> None:
    (chain,) = balances_of(Mechanism.of(load_scene("6pendulum")))
    assert chain.about is not None
    assert chain.about.tolist() == [0.0, 0.0, 0.0]
    assert np.array_equal(chain.directions, np.eye(3))
    (ladder,) = balances_of(Mechanism.of(load_scene("3ladder")))
    assert np.abs(ladder.directions).tolist() == [[0.0, 1.0, 0.0]]


def test_driven_hinges_to_the_world_count_and_others_do_not() -> None:
    """A wheel on a carrier, both driven about z, has angles in closed form."""
    bodies = (Body("carrier", inertia=BALL), Body("wheel", inertia=BALL))
    scene = Scene(
        name="drive",
        gravity=(0.0, 0.0, 0.0),
        bodies=bodies,
        joints=(
            Joint("mount", "hinge", "carrier", "world", (0.0, 0.0, 0.0), Z),
            Joint("axle", "hinge", "carrier", "wheel", (0.0, 0.0, 0.0), Z),
        ),
        torques=(Torque("mount", (0.2, -0.1), hold=5), Torque("axle", (0.3,))),
        length=1.0,
        clock=Clock(0.02, 10),
    )
    batch = draw_batch(scene, [0])
    own, between = batch.torque[0, :, 0], batch.torque[0, :, 1]
    # The mount's child is the world: its torque acts on the carrier the other way round.
    pushes = np.stack([-own - between, between], axis=-1) / 0.1
    speed = np.concatenate([np.zeros((1, 2)), np.cumsum(0.02 * pushes, axis=0)])
    angle = np.concatenate([np.zeros((1, 2)), np.cumsum(0.01 * (speed[1:] + speed[:-1]), axis=0)])
    zero = np.zeros((1, 11, 2, 3))
    vector, spin = zero.copy(), zero.copy()
    vector[..., 2], spin[..., 2] = angle, speed
    motion = Trajectory(
        0.02 * np.arange(11.0), zero, rotation.from_vector(vector), zero, spin, (None,)
    )
    finding = momentum.finding(Record(scene, batch, motion, RK4, 1e-3))
    assert finding.figure[0] < 1e-13
    opposite = dataclasses.replace(batch, torque=-batch.torque)
    wrong = momentum.finding(Record(scene, opposite, motion, RK4, 1e-3))
    assert not wrong.passed.any()


def _bouncing(gravity: float) -> tuple[Scene, Trajectory]:
    """A sphere that falls from 1.1 m, bounces fully at 0.1 m, and drifts along x."""
    ball = Body("ball", inertia=BALL, position=(0.0, 0.0, 1.1), velocity=(1.0, 0.0, 0.0))
    more = {"gravity": (0.0, 0.0, -gravity), "clock": Clock(0.02, 80)}
    scene = over_ground(ball, ball.position, 0.1, Ground(0.0, 1.0), **more)
    time = 0.02 * np.arange(81.0)
    fall = np.sqrt(2 / 9.81)
    since = (time + fall) % (2 * fall) - fall
    position, velocity = np.zeros((2, 1, 81, 1, 3))
    position[0, :, 0, 0], velocity[..., 0] = time, 1.0
    position[0, :, 0, 2], velocity[0, :, 0, 2] = 1.1 - 0.5 * 9.81 * since**2, -9.81 * since
    facing = np.broadcast_to(rotation.IDENTITY, (1, 81, 1, 4))
    return scene, Trajectory(time, position, facing, velocity, np.zeros((1, 81, 1, 3)), (None,))


def test_flights_between_contacts_are_looked_at_one_by_one() -> None:
    scene, motion = _bouncing(9.81)
    finding = momentum.finding(Record(scene, draw_batch(scene, [0]), motion, RK4, 1e-3))
    assert finding.figure[0] < 1e-12
    # Two bounces; frames near them are left out.
    assert 4 <= np.isnan(finding.series[0]).sum() <= 16
    scene, motion = _bouncing(9.80)
    finding = momentum.finding(Record(scene, draw_batch(scene, [0]), motion, RK4, 1e-3))
    assert finding.figure[0] > 1e-3


def test_frames_after_a_failure_are_left_out(pendulum: Any) -> None:
    position = pendulum.exact.position.copy()
    position[0, 7:] = np.nan
    broken = dataclasses.replace(pendulum.exact, position=position)
    finding = momentum.finding(Record(pendulum.scene, pendulum.batch, broken, RK4, 2e-3))
    assert np.isnan(finding.series[0, 7:]).all()
    assert finding.passed.all()
    assert np.isfinite(finding.uncertainty).all()


def test_what_never_flies_has_no_balance() -> None:
    scene, motion = _bouncing(9.81)
    lying = dataclasses.replace(motion, position=motion.position * [1.0, 1.0, 0.0])
    assert momentum(Record(scene, draw_batch(scene, [0]), lying, RK4, 1e-3)) is None

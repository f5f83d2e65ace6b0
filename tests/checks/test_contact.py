"""Checks of contact: exact motions pass all of them, and those of a wrong contact do not."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks import Finding, Record, audit
from mbds_xsim.checks.ground import pushes_of
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Roll, Throw
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing.straight_car import straight_run

RK4 = load_adapter("mujoco").methods["RK4"]
SLOPES = {"along x": (4.0, 0.0), "at 45°": (3.0, 3.0), "at 20°": (4.0, 1.456)}


def _short(name: str, steps: int, **ground: float) -> Scene:
    """Cut a scene short, and give its ground other coefficients."""
    scene = load_scene(name)
    scene = msgspec.structs.replace(scene, clock=Clock(scene.clock.frame, steps))
    return _with_ground(scene, **ground)


def _with_ground(scene: Scene, **ground: float) -> Scene:
    assert scene.ground is not None
    return msgspec.structs.replace(scene, ground=msgspec.structs.replace(scene.ground, **ground))


def _slope(direction: str, steps: int = 60) -> Scene:
    """Throw the ball of `ballscroll` along a direction of the plane, without spin."""
    x, y = SLOPES[direction]
    throw = Throw("ball", velocity=((x, x), (y, y), (0.0, 0.0)))
    scene = msgspec.structs.replace(_short("ballscroll", steps), dimension=3, noise=0.0)
    return msgspec.structs.replace(scene, sampling=(throw, Roll("ball", share=(0.0, 0.0))))


def _uneven() -> Scene:
    """A ball of unequal moments on a slope, whose slip turns to and fro within a frame."""
    centre, turn = (0.0, 0.0, 0.1811), np.array([0.370181, 0.815283, 0.340672, 0.286743])
    ball = Body(
        "ball", inertia=Inertia(1.8472, (1.0177e-3, 1.3569e-3, 1.6961e-3)), position=centre,
        orientation=tuple((turn / np.linalg.norm(turn)).tolist()),
        velocity=(0.50152, -0.70009, 1.16791), angular_velocity=(1.2664, -12.3481, 4.1772),
    )  # fmt: skip
    return Scene(
        "uneven", (ball,), 1.0, gravity=(2.36709, -1.79237, -9.0), clock=Clock(0.02, 25),
        contacts=(ContactSphere("ball", centre, 0.042853),), ground=Ground(0.263415, 0.0),
    )  # fmt: skip


@functools.cache
def _exact(
    scene: Scene, drawn_from: Scene | None = None, rows: int = 3
) -> tuple[Batch, Trajectory]:
    """Return the exact motion of a scene, from the starts of `drawn_from` if given."""
    batch = draw_batch(drawn_from or scene, range(rows))
    return batch, reference.solve(scene, batch, cache=False)


def _findings(scene: Scene, batch: Batch, motion: Trajectory) -> dict[str, Finding]:
    return {f.check: f for f in audit(scene, batch, motion, RK4, step=1e-3)}


def _faulty(scene: Scene, wrong: Scene) -> dict[str, Finding]:
    """Check the exact motion of a wrong scene as if it were the right one's."""
    return _findings(scene, *_exact(wrong, scene))


def _failed(findings: dict[str, Finding]) -> set[str]:
    return {name for name, finding in findings.items() if not finding.passed.all()}


@pytest.mark.parametrize(
    "scene",
    [
        _short("ballscroll", 200),
        _short("balldrop", 200),
        *(_slope(direction) for direction in SLOPES),
        *(_short("balldrop", 100, restitution=e) for e in (0.0, 0.5, 1.0)),
        _short("balldrop", 100, friction=0.0),
        _uneven(),
    ],
    ids=lambda scene: f"{scene.name} {scene.ground}",
)
def test_exact_motions_pass_every_check(scene: Scene) -> None:
    findings = _findings(scene, *_exact(scene))

    assert _failed(findings) == set()
    assert {"penetration", "contact gap", "passivity", "friction", "hop"} <= set(findings)
    for name in ("balance", "contact gap", "passivity", "friction", "restitution", "hop"):
        assert findings[name].figure.max() < 1e-9, name


def test_hops_that_a_frame_sees_at_their_turns_alone_are_no_rest() -> None:
    """At the top and bottom of a hop nothing moves up or down; MuJoCo's cubli hops like this."""
    scene = _short("ballscroll", 60)
    batch, motion = _exact(scene)
    hops = motion.position.copy()
    hops[:, 20:30:2, :, 2] += 1.4e-3
    hopping = dataclasses.replace(motion, position=hops)

    (rests,), (hopped,) = (pushes_of(Record(scene, batch, m, RK4)) for m in (motion, hopping))

    assert rests.resting[:, 1:].all()
    assert not hopped.resting[:, 19:30].any()
    assert hopped.resting[:, 30:].all()


def _driven(
    friction: float = 0.43, *, speed: float = 10.0, rates: tuple[float, float] = (40.0, 60.0)
) -> tuple[Scene, Batch, Trajectory]:
    """Drive the car straight on, its front wheels too slow and its rear wheels too fast."""
    scene = msgspec.structs.replace(_short("particlecar", 60), noise=0.0)
    torque = np.repeat([[2.0, -1.0], [-2.0, 2.0]], 30, axis=0)
    made = _with_ground(scene, friction=friction)
    return scene, *straight_run(made, speed=speed, rates=rates, torque=torque)


def test_a_car_on_the_ground_passes_every_check() -> None:
    findings = _findings(*_driven())

    assert _failed(findings) == set()
    for name in ("balance", "balance drift", "wheels"):
        assert findings[name].figure.max() < 1e-9, name
    assert findings["cones"].figure.max() < 1e-7
    assert {"restitution", "rolling", "hop"}.isdisjoint(findings)


@pytest.mark.parametrize("taken", [0.185, 0.40, 0.46])
def test_another_friction_shows_under_wheels_that_slip(taken: float) -> None:
    """The two axles pull against each other, so that their sum is within the cone."""
    findings = _findings(*_driven(taken))

    assert _failed(findings) == {"cones", "wheels"}
    assert findings["wheels"].figure == pytest.approx(abs(taken / 0.43 - 1.0))


def test_stronger_gravity_shows_in_the_friction_of_wheels_that_slip() -> None:
    scene, batch, motion = _driven()
    lighter = msgspec.structs.replace(scene, gravity=(0.0, 0.0, -9.81 / 1.01))

    assert "cones" in _failed(_findings(lighter, batch, motion))


def test_wheels_clamped_at_100_rad_s_show_on_the_ground() -> None:
    """The car loses momentum that friction should pass to the wheels."""
    scene, batch, motion = _driven(speed=20.4, rates=(97.0, 98.0))
    spin = motion.angular_velocity.copy()
    assert spin.max() > 100.5
    spin[:, :, 1:, 1] = np.minimum(spin[:, :, 1:, 1], 100.0)
    findings = _findings(scene, batch, dataclasses.replace(motion, angular_velocity=spin))

    assert "wheels" in _failed(findings)
    assert (findings["wheels"].figure > 0.1).all()


@pytest.mark.parametrize("taken", [0.185, 0.40, 0.46])
def test_another_friction_shows_while_a_ball_slips(taken: float) -> None:
    """An engine that multiplies coefficients has a friction of 0.43² = 0.185."""
    scene = _short("ballscroll", 60)
    findings = _faulty(scene, _with_ground(scene, friction=taken))

    # The first start rolls from the beginning.
    assert findings["friction"].passed.tolist() == [True, False, False]
    assert findings["friction"].figure[1:] == pytest.approx(abs(taken / 0.43 - 1.0))


@pytest.mark.parametrize(
    ("share", "part"), [(np.sqrt(0.5), "slip, ball"), (np.sqrt(2), "cone, ball")]
)
def test_a_pyramid_shows_at_45_degrees(share: float, part: str) -> None:
    """At 45° a pyramid is a cone of another size: an inscribed one is smaller, a box larger."""
    scene = _slope("at 45°")
    findings = _faulty(scene, _with_ground(scene, friction=0.43 * float(share)))

    assert "friction" in _failed(findings)
    assert not findings["friction"].passed.any()
    assert findings["friction"].figure == pytest.approx(abs(share - 1.0))
    assert part == "slip, ball" or (findings["friction"].figure > 0.4).all()


def test_what_a_springy_impact_gives_back_of_a_slip_is_no_slip() -> None:
    """A rolling ball bounces with 6 mm/s of slip, where friction could remove 5 m/s."""
    scene = _short("balldrop", 200)
    batch, motion = _exact(scene)
    aside = dataclasses.replace(motion, velocity=motion.velocity + np.array([6e-3, 0.0, 0.0]))

    assert _findings(scene, batch, aside)["friction"].passed.all()


def test_friction_beside_the_slip_shows() -> None:
    """Box friction pulls along the diagonal, whatever direction in its quadrant the slip has."""
    scene = _slope("at 20°", 10)
    batch, motion = _exact(scene)
    x, y = SLOPES["at 20°"]
    turn = np.deg2rad(5.0)
    pushed = np.array([x, y]) / np.hypot(x, y)
    aside = pushed @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    lost = 0.43 * 9.81 * motion.time[None, :, None, None] * (pushed - aside)
    bent = np.concatenate([motion.velocity[..., :2] + lost, motion.velocity[..., 2:]], axis=-1)
    findings = _findings(scene, batch, dataclasses.replace(motion, velocity=bent))

    assert not findings["friction"].passed.any()
    assert set(findings["friction"].where) == {"slip, ball"}


@pytest.mark.parametrize("off", [-0.05, 0.05])
def test_another_restitution_shows(off: float) -> None:
    scene = _short("balldrop", 100)
    findings = _faulty(scene, _with_ground(scene, restitution=0.9332 + off))

    assert _failed(findings) == {"restitution"}
    assert np.allclose(findings["restitution"].figure, 0.05, atol=1e-4)
    assert "the scene has 0.9332" in findings["restitution"].note


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_another_radius_shows_in_a_bounce(share: float) -> None:
    scene = _short("balldrop", 100)
    (sphere,) = scene.contacts
    other = msgspec.structs.replace(sphere, radius=share * sphere.radius)
    findings = _faulty(scene, msgspec.structs.replace(scene, contacts=(other,)))

    figures = findings["contact gap"].figure[~findings["contact gap"].passed]
    assert len(figures) >= 2
    assert figures == pytest.approx(0.05 * sphere.radius, rel=5e-3)


@pytest.mark.parametrize("share", [0.9, 1.06])
def test_another_radius_shows_on_the_ground(share: float) -> None:
    scene = _slope("along x")
    batch, motion = _exact(scene)
    lower = motion.position.copy()
    lower[:, 1:, :, 2] *= share
    findings = _findings(scene, batch, dataclasses.replace(motion, position=lower))

    assert "contact gap" in _failed(findings)


def test_a_ball_that_sinks_penetrates() -> None:
    scene = _slope("along x")
    batch, motion = _exact(scene)
    sunk = motion.position.copy()
    sunk[:, 30:, :, 2] -= 0.025
    findings = _findings(scene, batch, dataclasses.replace(motion, position=sunk))

    assert "penetration" in _failed(findings)
    assert findings["penetration"].figure == pytest.approx(0.025)
    assert (findings["penetration"].frame == 30).all()


def test_a_ball_that_hops_shows() -> None:
    """The ball makes hops of 2 mm, three frames each, as soft contacts with spin do."""
    scene = _short("ballscroll", 60)
    batch, motion = _exact(scene)
    phase = (motion.time % 0.04)[:, None]
    start = 9.81 * 0.02
    up, climb = motion.position.copy(), motion.velocity.copy()
    up[:, 30:, :, 2] += (start * phase - 0.5 * 9.81 * phase**2)[30:]
    climb[:, 30:, :, 2] += (start - 9.81 * phase)[30:]
    findings = _findings(scene, batch, dataclasses.replace(motion, position=up, velocity=climb))

    assert "hop" in _failed(findings)
    assert findings["hop"].figure == pytest.approx(start**2 / (2 * 9.81), rel=0.01)


def test_a_ball_that_the_ground_throws_up_at_the_start_shows() -> None:
    """Engines throw up spheres that overlap the ground in them, but not in the scene."""
    scene = _short("ballscroll", 10)
    batch = draw_batch(scene, range(3))
    velocity = batch.velocity + np.array([0.0, 0.0, 2.0])
    motion = reference.solve(scene, dataclasses.replace(batch, velocity=velocity), cache=False)
    motion.velocity[:, 0] = batch.velocity
    findings = _findings(scene, batch, motion)

    assert {"passivity", "hop"} <= _failed(findings)
    assert findings["hop"].figure == pytest.approx(2.0**2 / (2 * 9.81), rel=1e-3)


def test_a_ball_that_goes_on_slipping_does_not_roll() -> None:
    scene = _slope("along x")
    batch, motion = _exact(scene)
    slower = motion.angular_velocity * np.where(motion.time > 0.6, 0.99, 1.0)[:, None, None]
    findings = _findings(scene, batch, dataclasses.replace(motion, angular_velocity=slower))

    assert "rolling" in _failed(findings)
    assert not findings["rolling"].passed.any()


def _bounced(scene: Scene, restitution: float) -> tuple[Batch, Trajectory]:
    """Let `balldrop` bounce straight up and down, with any restitution."""
    batch, motion = _exact(scene)
    (sphere,), z, v = scene.contacts, motion.position.copy(), motion.velocity.copy()
    still = np.zeros_like(batch.velocity)
    batch = dataclasses.replace(batch, velocity=still, angular_velocity=still)
    z[..., :2], v[..., :2] = batch.position[:, None, :, :2], 0.0
    for row in range(len(batch)):
        gap, climb = float(z[row, 0, 0, 2]) - sphere.radius, 0.0
        for frame in range(1, len(motion.time)):
            rest = scene.clock.frame
            hit = (climb + np.sqrt(climb**2 + 2 * 9.81 * gap)) / 9.81
            if hit < rest:
                climb, rest, gap = -restitution * (climb - 9.81 * hit), rest - hit, 0.0
            gap, climb = gap + climb * rest - 0.5 * 9.81 * rest**2, climb - 9.81 * rest
            z[row, frame, 0, 2], v[row, frame, 0, 2] = gap + sphere.radius, climb
    unturned = np.broadcast_to(batch.orientation[:, None], motion.orientation.shape)
    return batch, dataclasses.replace(
        motion, position=z, velocity=v, orientation=unturned, angular_velocity=0.0 * v
    )


@pytest.mark.parametrize(("restitution", "passes"), [(1.0, True), (1.02, False)])
def test_a_bounce_that_creates_energy_shows(restitution: float, passes: bool) -> None:
    scene = msgspec.structs.replace(_short("balldrop", 100, restitution=1.0), noise=0.0)
    failed = _failed(_findings(scene, *_bounced(scene, restitution)))

    assert failed == (set() if passes else {"passivity", "hop", "restitution"})


@pytest.fixture(scope="module")
def thrown(
    drawn: Callable[..., tuple[Scene, Batch]], simulate: Callable[..., Trajectory]
) -> tuple[Scene, Batch, Trajectory]:
    """The cubli in flight, its flywheels near 100 rad/s and driven."""
    scene, batch = drawn(load_scene("simplecubli"), 14)
    axes = np.stack([joint.axis for joint in Mechanism.of(scene).hinges])
    turned = Mechanism.of(scene).native_rotation(batch.orientation)[:, 1:]
    fast = batch.angular_velocity.copy()
    fast[:, 1:] += 90.0 * _rotated(turned, axes)
    driven = np.broadcast_to([3.0, 2.0, 3.0], batch.torque.shape)
    batch = dataclasses.replace(batch, angular_velocity=fast, torque=driven)
    return scene, batch, simulate(scene, batch, 20)


def _rotated(turn: Array, axes: Array) -> Array:
    from mbds_xsim.base import rotation

    return rotation.rotate(turn, axes)


def _respun(scene: Scene, motion: Trajectory, change: Array) -> Trajectory:
    """Add `change` to the flywheels' rates about their axes, shape (…, hinge) [rad/s]."""
    axes = np.stack([joint.axis for joint in Mechanism.of(scene).hinges])
    turned = Mechanism.of(scene).native_rotation(motion.orientation)[:, :, 1:]
    spin = motion.angular_velocity.copy()
    spin[:, :, 1:] += change[..., None] * _rotated(turned, axes)
    return dataclasses.replace(motion, angular_velocity=spin)


def _rates(scene: Scene, motion: Trajectory) -> Array:
    axes = np.stack([joint.axis for joint in Mechanism.of(scene).hinges])
    turned = Mechanism.of(scene).native_rotation(motion.orientation)[:, :, 1:]
    spin = motion.angular_velocity[:, :, 1:] - motion.angular_velocity[:, :, :1]
    return np.asarray(np.sum(spin * _rotated(turned, axes), axis=-1))


def test_flight_exchanges_angular_momentum(thrown: tuple[Scene, Batch, Trajectory]) -> None:
    findings = _findings(*thrown)

    assert _failed(findings) == set()
    assert findings["momentum"].figure.max() < 1e-5
    assert findings["energy"].figure.max() < 1e-5


def test_a_clamped_flywheel_shows_in_flight(thrown: tuple[Scene, Batch, Trajectory]) -> None:
    scene, batch, motion = thrown
    excess = np.maximum(_rates(scene, motion) - 100.0, 0.0)
    assert excess.max() > 1.0
    findings = _findings(scene, batch, _respun(scene, motion, -excess))

    assert {"momentum", "energy"} <= _failed(findings)


def test_a_torque_without_reaction_shows_in_flight(
    thrown: tuple[Scene, Batch, Trajectory], simulate: Callable[..., Any]
) -> None:
    scene, batch, _ = thrown
    coasting = simulate(scene, dataclasses.replace(batch, torque=0.0 * batch.torque), 20)
    axial = np.diagonal(Mechanism.of(scene).inertia[1:], axis1=1, axis2=2).max(axis=1)
    gained = np.cumsum(batch.torque, axis=1) * scene.clock.frame / axial
    gained = np.concatenate([np.zeros_like(gained[:, :1]), gained], axis=1)
    findings = _findings(scene, batch, _respun(scene, coasting, gained))

    assert "momentum" in _failed(findings)
    assert {"angular momentum, frame"} == set(findings["momentum"].where)

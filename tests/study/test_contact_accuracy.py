"""The limits of contact: each is reported where it is broken, and only there."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.isolate import HERE
from mbds_xsim.checks import Finding, audit
from mbds_xsim.measure.campaign import run_references
from mbds_xsim.measure.outcome import ReferenceOutcome
from mbds_xsim.measure.trial import contact_findings
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Ground, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.timed import simulate

EULER = Method("Euler", "semi-implicit Euler", 1)
RK4 = Method("RK4", "RK4", 4)
CONTACT_SCENES = ("ballscroll", "balldrop", "simplecubli", "particlecar")
G = 9.81


def prepared(name: str, steps: int = 100) -> tuple[Scene, Batch, ReferenceOutcome]:
    scene = msgspec.structs.replace(registry.load_scene(name), clock=Clock(0.02, steps))
    batch = draw_batch(scene, range(3), seed=5)
    return scene, batch, run_references(scene, batch, HERE)


def broken(findings: list[Finding]) -> list[str]:
    return [finding.check for finding in findings if not finding.passed.all()]


def moved(exact: Trajectory, **fields: Array) -> Trajectory:
    return dataclasses.replace(exact, **fields, failures=(None,) * len(exact))


def hits(exact: Trajectory) -> list[int]:
    """First frames after the impacts of the first trajectory."""
    return [int(k) + 1 for k in np.flatnonzero(np.diff(exact.velocity[0, :, 0, 2]) > 0.5)]


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("ballscroll", ["error while sliding"]),
        (
            "balldrop",
            [
                "error before the first impact",
                "height of the first rebound",
                "error up to the third bounce",
            ],
        ),
        ("simplecubli", ["error in flight", "turn in flight"]),
        ("particlecar", []),
    ],
)
def test_the_exact_motion_is_held_to_what_applies_and_keeps_it(
    name: str, limits: list[str]
) -> None:
    scene, _, exact = prepared(name)
    findings = contact_findings(scene, moved(exact.trajectory), exact, EULER, None)

    assert [finding.check for finding in findings] == limits
    for finding in findings:
        assert finding.figure.max() < 1e-6
        assert finding.passed.all()


def test_scenes_without_contact_or_weight_have_no_limits() -> None:
    for scene, exact in (prepared("2pendulum", 5)[::2], _weightless()):
        assert contact_findings(scene, exact.trajectory, exact, EULER, exact.growth) == []


def _weightless() -> tuple[Scene, ReferenceOutcome]:
    scene, _, exact = prepared("balldrop", 5)
    return msgspec.structs.replace(scene, gravity=(0.0, 0.0, 0.0)), exact


@pytest.mark.parametrize(
    ("begin", "end", "shift", "said"),
    [
        (0, "first", (6e-4, 0.0, 0.0), ["error before the first impact"]),
        (0, "first", (4e-4, 0.0, 0.0), []),
        ("first", "third", (0.03, 0.0, 0.0), ["error up to the third bounce"]),
        ("first", "third", (0.019, 0.0, 0.0), []),
        ("third", None, (1.0, 0.0, 0.0), []),
    ],
)
def test_a_ball_is_held_to_its_flights(
    begin: int | str, end: str | None, shift: tuple[float, float, float], said: list[str]
) -> None:
    scene, _, exact = prepared("balldrop", 150)
    frames = dict(zip(("first", "second", "third"), hits(exact.trajectory), strict=False))
    place = exact.trajectory.position.copy()
    first = begin if isinstance(begin, int) else frames[begin]
    place[0, first : None if end is None else frames[end]] += shift

    motion = moved(exact.trajectory, position=place)
    assert broken(contact_findings(scene, motion, exact, EULER, None)) == said


@pytest.mark.parametrize(("share", "said"), [(0.97, True), (0.985, False), (1.03, True)])
def test_a_first_rebound_is_held_to_its_height(share: float, said: bool) -> None:
    """The ball climbs with less speed, or more, from the same impact."""
    scene, _, exact = prepared("balldrop")
    first, second, *_ = hits(exact.trajectory)
    place, speed = exact.trajectory.position.copy(), exact.trajectory.velocity.copy()
    radius = scene.contacts[0].radius
    flight = np.s_[0, first:second, 0, 2]
    energy = G * (place[flight] - radius) + 0.5 * speed[flight] ** 2
    # All of the missing height is taken from where the ball is.
    place[flight] -= (1.0 - share) * energy / G

    motion = moved(exact.trajectory, position=place, velocity=speed)
    findings = {f.check: f for f in contact_findings(scene, motion, exact, EULER, None)}
    assert findings["height of the first rebound"].figure[0] == pytest.approx(abs(1.0 - share))
    assert (not findings["height of the first rebound"].passed[0]) == said


@pytest.mark.parametrize("restitution", [0.0, 0.05])
def test_a_ball_that_hardly_rebounds_is_held_to_its_fall(restitution: float) -> None:
    scene, batch, _ = prepared("balldrop")
    scene = msgspec.structs.replace(scene, ground=Ground(0.43, restitution))
    exact = run_references(scene, batch, HERE)
    settings = settings_for(scene, registry.load_adapter("dart"), "matched")
    motion = simulate(scene, batch, "dart", settings).trajectory

    assert broken(contact_findings(scene, motion, exact, EULER, None)) == []

    place = motion.position + np.array([0.0, 0.0, 0.01])
    findings = contact_findings(scene, moved(motion, position=place), exact, EULER, None)
    assert "height of the first rebound" in broken(findings)


def test_joined_bodies_are_held_to_their_flight_and_to_nothing_after_it() -> None:
    scene, _, exact = prepared("simplecubli")
    truth = exact.trajectory
    flight = truth.known
    wild = np.where(flight[:, :, None, None], truth.position, 7.0)
    turn = np.where(flight[:, :, None, None], truth.orientation, [1.0, 0.0, 0.0, 0.0])
    fine = moved(truth, position=wild, orientation=turn)
    tilt = rotation.multiply(rotation.from_vector(np.array([0.0, 1.1e-3, 0.0])), turn)

    assert broken(contact_findings(scene, fine, exact, EULER, None)) == []
    off = dataclasses.replace(fine, position=wild + np.array([6e-4, 0.0, 0.0]))
    assert broken(contact_findings(scene, off, exact, EULER, None)) == ["error in flight"]
    turned = dataclasses.replace(fine, orientation=tilt)
    assert broken(contact_findings(scene, turned, exact, EULER, None)) == ["turn in flight"]


def test_momentum_before_an_impact_is_kept_by_the_order_of_the_method() -> None:
    scene, _, exact = prepared("simplecubli")
    truth = exact.trajectory
    flight = truth.known
    momentum = np.where(flight, 1e-5, 5e-4)

    def faults(method: Method, series: Array) -> list[str]:
        return broken(contact_findings(scene, moved(truth), exact, method, series))

    assert faults(EULER, momentum) == []
    assert faults(RK4, momentum) == ["momentum before the first impact"]
    assert faults(RK4, np.where(flight, 1e-7, 2e-3)) == ["momentum in flight"]


def test_what_was_lost_breaks_the_limit() -> None:
    scene, _, exact = prepared("ballscroll")
    place = exact.trajectory.position.copy()
    place[1, 50:] = np.nan
    motion = moved(exact.trajectory, position=place)
    (finding,) = contact_findings(scene, motion, exact, EULER, None)

    assert finding.passed.tolist() == [True, False, True]
    assert finding.frame[1] == 50


@pytest.mark.parametrize("name", CONTACT_SCENES)
def test_matched_settings_keep_the_limits(name: str, grounded: Adapter) -> None:
    settings = settings_for(registry.load_scene(name), grounded, "matched")
    if grounded.refusals(registry.load_scene(name), settings.method):
        pytest.skip(f"{grounded.name} cannot do {name}")
    scene, batch, exact = prepared(name, 40)
    motion = simulate(scene, batch, grounded.name, settings).trajectory
    method = grounded.methods[settings.method]
    checks = {f.check: f for f in audit(scene, batch, motion, method, step=settings.step)}
    momentum = checks["momentum"].series if "momentum" in checks else None

    assert motion.failures == (None,) * 3
    assert broken(contact_findings(scene, motion, exact, method, momentum)) == []

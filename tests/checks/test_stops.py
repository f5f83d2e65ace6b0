"""Joints stay between their limits, and stops give no energy."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.checks import CHECKS, Record, audited
from mbds_xsim.checks.conservation import energy_balance
from mbds_xsim.checks.stops import past_limits, stop_passivity
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing.case import Case
from mbds_xsim.testing.limit_cases import STOP_CASES


def _record(case: Case) -> Record:
    batch = draw_batch(case.scene, [0])
    return Record(case.scene, batch, solve(case.scene, batch, cache=False))


@pytest.mark.parametrize("case", STOP_CASES, ids=lambda case: case.name)
def test_the_exact_motion_passes_and_is_balanced_between_stops(case: Case) -> None:
    record = _record(case)

    assert past_limits.finding(record).figure.max() < 1e-11
    assert stop_passivity.finding(record).figure.max() < 1e-6
    assert energy_balance.finding(record).figure.max() < 1e-6


@pytest.mark.parametrize("case", STOP_CASES, ids=lambda case: case.name)
def test_a_stop_that_is_narrower_was_passed(case: Case) -> None:
    record = _record(case)
    joints = (
        msgspec.structs.replace(joint, limits=tuple(x * 0.9 for x in joint.limits), start=None)
        if joint.limits
        else joint
        for joint in case.scene.joints
    )
    narrow = msgspec.structs.replace(case.scene, joints=tuple(joints))

    finding = past_limits.finding(Record(narrow, record.batch, record.trajectory))
    assert finding.figure.max() > 0.02
    assert not finding.passed.any()


def test_a_stop_that_gives_energy_is_seen() -> None:
    (case,) = (case for case in STOP_CASES if case.name == "bouncing block")
    record = _record(case)
    fall = record.trajectory.position[0, 0, 0, 2] + 0.3
    hit = int(np.sqrt(2 * fall / 9.81) / record.frame) + 1
    velocity = record.trajectory.velocity.copy()
    # Thrown back twice as fast as it came.
    velocity[:, hit:, :, 2] += 4.0 * np.sqrt(2 * 9.81 * fall)
    thrown = dataclasses.replace(record.trajectory, velocity=velocity)

    finding = stop_passivity.finding(Record(case.scene, record.batch, thrown))
    assert not finding.passed.any()


@pytest.mark.parametrize(("hinges", "rate"), [(1, 3.0), (2, 0.0)])
def test_the_rest_on_a_stop_is_no_fault(hinges: int, rate: float) -> None:
    """An arm on one hinge or two rests on its stop by rounding, some or all of the time."""
    held = Inertia(1.0, (0.02, 0.02, 0.02))
    ways: dict[str, dict[str, Any]] = {"stop": {"start": 0.1, "limits": (0.1, 2.0)}, "loop": {}}
    joints = [
        Joint(name, "hinge", "world", "arm", (0.0, 0.2 * k, 0.0), (0.0, -1.0, 0.0), **more)
        for k, (name, more) in enumerate(ways.items())
    ]
    pin = Joint("pin", "hinge", "arm", "bob", (0.3, 0.0, 0.0), (0.0, 1.0, 0.0), rate=rate)
    bodies = [("arm", 0.0), ("bob", -0.4)]
    scene = Scene(
        "arm",
        tuple(Body(name, inertia=held, position=(0.3, 0.0, z)) for name, z in bodies),
        1.0,
        joints=(*joints[:hinges], pin),
        clock=Clock(0.02, 20),
    )
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)
    method = load_adapter("reference").methods["adaptive"]
    findings = audited(Record(scene, batch, motion, method, scene.clock.frame, 0.0), CHECKS)
    assert [finding.line(0) for finding in findings if not finding.passed.all()] == []


@pytest.mark.parametrize("geared", [False, True])
def test_rebounds_within_frames_are_no_fault(geared: bool) -> None:
    """Exact rebounds of an arm, or of a weight geared to a wheel, become shorter than a frame."""
    com = (0.0, 0.0, 0.0) if geared else (0.4, 0.0, 0.0)
    bodies = [Body("arm", inertia=Inertia(1.0, (0.02, 0.02, 0.024), com=com))]
    start = {"start": 0.0, "rate": 1.0} if geared else {"start": 0.1, "rate": 0.0}
    stop: dict[str, Any] = {**start, "limits": (-0.05, 1.0), "restitution": 0.9}
    joints = [Joint("stop", "hinge", "world", "arm", (0, 0, 0), (0, -1, 0), **stop)]
    gears = (Coupling("rail", "stop", 0.3),) if geared else ()
    if geared:
        bodies.append(Body("weight", inertia=Inertia(2.0, (0.02,) * 3), position=(1, 0, 0)))
        joints.append(Joint("rail", "slider", "world", "weight", (1, 0, 0), (0, 0, 1)))
    clock = Clock(0.05, 50)
    parts: dict[str, Any] = {"joints": tuple(joints), "couplings": gears}
    scene = Scene("rebounds", tuple(bodies), 1.0, clock=clock, **parts)
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)

    method = load_adapter("reference").methods["adaptive"]
    findings = audited(Record(scene, batch, motion, method, clock.frame, 0.0), CHECKS)
    assert [finding.line(0) for finding in findings if not finding.passed.all()] == []

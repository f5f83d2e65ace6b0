"""Bodies held by dry friction or links raise no alarm, though they creep or move by rounding."""

from __future__ import annotations

import numpy as np

from mbds_xsim import reference
from mbds_xsim.checks import Record, audited
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Joint, Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.timed import simulate

RK4 = Method("RK4", "RK4", 4)


def _failed(record: Record) -> list[str]:
    return [finding.check for finding in audited(record) if not finding.passed.all()]


def _exact(scene: Scene) -> Record:
    batch = draw_batch(scene, [0])
    return Record(scene, batch, reference.solve(scene, batch, cache=False), RK4, 1e-3)


def test_an_arm_that_swings_on_a_shoulder_that_friction_holds() -> None:
    """Every step may have a kink, so the checks say nothing of positions and velocities."""
    bodies = (
        Body("upper", inertia=Inertia(1.0, (0.1, 0.1, 0.01)), position=(0.0, 0.0, -0.5)),
        Body("fore", inertia=Inertia(0.2, (0.01, 0.01, 0.001)), position=(0.0, 0.0, -1.5)),
    )
    axis = (0.0, 1.0, 0.0)
    joints = (
        Joint("shoulder", "hinge", "world", "upper", (0, 0, 0), axis, start=0.3, friction=50.0),
        Joint("elbow", "hinge", "upper", "fore", (0.0, 0.0, -1.0), axis, start=0.8),
    )

    assert _failed(_exact(Scene("arm", bodies, 2.0, joints=joints, clock=Clock(0.02, 50)))) == []


def test_a_block_that_soft_friction_lets_creep() -> None:
    body = Body("block", inertia=Inertia(1.0, (0.1, 0.1, 0.1)))
    rail = Joint("rail", "slider", "world", "block", (0, 0, 0), (0.0, 0.0, 1.0), friction=20.0)
    scene = Scene("block", (body,), 1.0, joints=(rail,), clock=Clock(0.02, 50))
    batch, settings = draw_batch(scene, [0]), Settings("RK4", 1e-4)

    simulated = simulate(scene, batch, "mujoco", settings)
    record = Record(scene, batch, simulated.trajectory, RK4, settings.step)

    assert 1e-9 < np.abs(simulated.trajectory.position[0, -1, 0, 2]) < 1e-6
    assert _failed(record) == []
    assert _failed(_exact(scene)) == []


def test_a_body_that_six_links_hold() -> None:
    anchors = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (1, 1, 1), (0, 0, 2)]
    tips = [(0.1, 0, 0.1), (-0.1, 0, 0.1), (0, 0.1, 0.1), (0, -0.1, -0.1), (0.1, 0.1, 0.1)]
    tips.append((0.05, 0.02, 0.1))
    links = tuple(
        DistanceLink(f"link{k}", ("world", "body"), ends)
        for k, ends in enumerate(zip(anchors, tips, strict=True))
    )
    body = Body("body", inertia=Inertia(1.0, (0.1, 0.1, 0.1)))

    assert _failed(_exact(Scene("truss", (body,), 1.0, distance_links=links))) == []

"""Held forces drive balls into impacts within a frame: exact motions raise no alarm."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.checks.audit import audit
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import GRAVITY, Force, Ground, Scene
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing.collision_cases import RADIUS, Flying, balls
from mbds_xsim.testing.contact_cases import ball

_FRAME, _BACK = 0.02, 0.8
_TOUCH = _FRAME / (1.0 + _BACK)
"""Time of impact from rest at a constant pull, whose rebound stops at the frame's end [s]."""


def _on_ground(push: float) -> Scene:
    scene = ball(0.5 * (push - GRAVITY[2]) * _TOUCH**2, ground=Ground(0.2, _BACK), steps=5)
    return msgspec.structs.replace(scene, forces=(_held("ball", (0.0, 0.0, -push)),))


def _on_a_ball(push: float) -> Scene:
    apart = 2.0 * RADIUS + 0.5 * push * _TOUCH**2
    pair = (Flying((-apart, 0.0, 0.0)), Flying((0.0, 0.0, 0.0), mass=1e6))
    scene = balls(pair, restitution=_BACK, steps=5)
    return msgspec.structs.replace(
        scene, forces=(_held(scene.bodies[0].name, (push, 0.0, 0.0)),), clock=ball(steps=5).clock
    )


def _held(body: str, push: tuple[float, float, float]) -> Force:
    return Force(body, (push, (0.0, 0.0, 0.0)), 1)


@pytest.mark.parametrize(
    "scene", [_on_ground(20.0), _on_ground(100.0), _on_a_ball(1.0), _on_a_ball(100.0)]
)
def test_the_exact_motion_passes(scene: Scene) -> None:
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)
    method = load_adapter("mujoco").methods["RK4"]

    findings = audit(scene, batch, motion, method, step=1e-4, contact_time=1e-4)

    assert motion.failures == (None,)
    assert np.all([finding.passed.all() for finding in findings]), [
        finding.line(0) for finding in findings if not finding.passed.all()
    ]


def test_a_force_beside_no_ground_and_no_gravity_needs_no_friction() -> None:
    """Rounding of the impulse has no weight to be compared with, and is no friction."""
    scene = msgspec.structs.replace(
        ball(1.0, ground=Ground(0.2, _BACK), steps=20),
        gravity=(0.0, 0.0, 0.0),
        forces=(Force("ball", ((0.1, 0.05, 0.0), (-0.03, 0.07, 0.0)), 3),),
    )
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)
    method = load_adapter("mujoco").methods["RK4"]

    findings = audit(scene, batch, motion, method, step=1e-4, contact_time=1e-4)

    failed = [finding.line(0) for finding in findings if not finding.passed.all()]
    assert not failed, failed

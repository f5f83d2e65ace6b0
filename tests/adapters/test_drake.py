"""Drake, in cases that the contract suite does not cover."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing import CASES
from mbds_xsim.testing.contact_cases import bounces

pytest.importorskip("pydrake")

ENGINE = load_adapter("drake")


@pytest.mark.parametrize(
    ("method", "error"), [("runge_kutta5", 1e-11), ("semi-implicit-euler", 5e-4)]
)
def test_a_ball_joint_turns_through_every_pitch(method: str, error: float) -> None:
    """The top turns three times about y; at a quarter turn its roll and yaw axes coincide."""
    inertia = Inertia(1.0, (0.03, 0.05, 0.04))
    body = Body("top", inertia=inertia, position=(0.1, 0.0, 0.0), angular_velocity=(0.1, 20.0, 0.2))
    hook = Joint("hook", "ball", "world", "top", (0.0, 0.0, 0.0))
    scene = Scene("top", (body,), 0.1, joints=(hook,), clock=Clock(0.02, 50))
    batch = draw_batch(scene, [0])

    with ENGINE.open(scene, Settings(method, scene.clock.frame / 40)) as run:
        motion = run.rollout(batch)

    assert motion.failures == (None,)
    exact = reference.solve(scene, batch, cache=False)
    assert np.abs(motion.position - exact.position).max() < error


def test_what_a_spring_and_a_ground_must_be_is_told() -> None:
    (scene,) = (case.scene for case in CASES if case.name == "spring")
    slack = msgspec.structs.replace(scene.springs[0], rest_length=0.0)

    assert ENGINE.cannot_hold(msgspec.structs.replace(scene, springs=(slack,))) == (
        "the spring 'spring' has no rest length; Drake needs more than 0 m"
    )
    refused = [e for e in (0.0, 0.5, 0.8, 0.98, 1.0) if ENGINE.cannot_hold(bounces(e))]
    assert refused == [0.5, 1.0]


def test_smaller_steps_bring_a_rolling_ball_nearer() -> None:
    """Drake's default solver stops at a share of the momentum, and is worse at smaller steps."""
    scene = load_scene("ballscroll")
    batch = draw_batch(scene, [2], noise=False).truncated(60)
    exact = reference.solve(scene, batch)
    errors = []
    for count in (100, 200):
        with ENGINE.open(scene, Settings("semi-implicit-euler", scene.clock.frame / count)) as run:
            errors.append(np.abs(run.rollout(batch).position - exact.position).max())

    assert errors[1] < 0.6 * errors[0]

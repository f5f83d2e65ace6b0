"""Drake, in cases that the contract suite does not cover."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Ground, Inertia, Joint, Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing import CASES
from mbds_xsim.testing.contact_cases import ball

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
    grounds = {e: ball(0.5, ground=Ground(0.43, e)) for e in (0.0, 0.5, 0.8, 0.98, 1.0)}
    refused = [e for e, scene in grounds.items() if ENGINE.cannot_hold(scene)]
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


@pytest.mark.parametrize(
    ("first", "second", "hinge"),
    [("a", "b", "a"), ("a", "b", ""), ("frame 3", "anchor of loops", "free 0")],
)
def test_every_name_that_a_scene_may_have_runs(first: str, second: str, hinge: str) -> None:
    """Drake wants names of its own for a free body's joint, and ends the process at empty ones."""
    bodies = tuple(
        Body(name, inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(place, 0.0, 0.0))
        for name, place in ((first, 0.0), (second, 0.3))
    )
    ends = (first, second, (0.1, 0.0, 0.0))
    scene = Scene(
        "names",
        bodies,
        1.0,
        joints=(Joint(hinge, "hinge", *ends, (0.0, 0.0, 1.0), armature=0.1),),
        distance_links=(DistanceLink("link", ("world", first), ((0, 0, 1.0), (0, 0, 0.0))),),
        clock=Clock(0.01, 5),
    )

    with ENGINE.open(scene, ENGINE.settings(scene, "native")) as run:
        assert run.rollout(draw_batch(scene, [0])).failures == (None,)


def test_steps_too_fine_for_a_stop_are_refused() -> None:
    """Drake's stop is a spring of 1e12 N/m, which rebounds once a step resolves it."""
    heavy = _dropped(1e4)
    settings = [ENGINE.settings(heavy, profile).step for profile in ("native", "matched")]
    assert min(settings) >= 2e-4
    assert ENGINE.settings(_dropped(1.0), "matched").step == 1e-4

    message = r"drake: step: got 0.0001 s, allowed is from 0.0002 s.*up to 1e\+04 kg.* in dropped"
    with pytest.raises(Unsupported, match=message):
        ENGINE.open(heavy, Settings("semi-implicit-euler", 1e-4))
    assert ENGINE.cannot_hold(_dropped(1e8)) == (
        "a joint with limits moves 1e+08 kg or kg·m²; Drake's stops hold 2.5e+07 at steps of a "
        "whole frame, and make more rebound"
    )


@pytest.mark.parametrize("mass", [1.0, 1e4, 1e6])
def test_a_stop_does_not_rebound_at_presets(mass: float) -> None:
    scene = _dropped(mass)
    for profile in ("native", "matched"):
        with ENGINE.open(scene, ENGINE.settings(scene, profile)) as run:
            fall = run.rollout(draw_batch(scene, [0])).velocity[0, :, 0, 2]
        assert fall.min() < -0.3
        assert fall[fall.argmin() :].max() < 1e-4


def _dropped(mass: float) -> Scene:
    """Make a block that falls along a rail onto its stop, which it hits at 0.44 m/s."""
    block = Body("block", inertia=Inertia(mass, (mass,) * 3))
    ends, up = ("world", "block", (0.0, 0.0, 0.0)), (0.0, 0.0, 1.0)
    rail = Joint("rail", "slider", *ends, up, limits=(-0.01, 1.0))
    return Scene("dropped", (block,), 1.0, joints=(rail,), clock=Clock(0.01, 10))

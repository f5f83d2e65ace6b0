"""Errors of rounding, by precision, length of chains and number of steps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate import rounding
from mbds_xsim.simulate.claims import Method
from mbds_xsim.simulate.registry import load_scene

DOUBLE = Method("RK4", "RK4", 4)
SINGLE = dataclasses.replace(DOUBLE, single=True)


def _lost(scene_name: str) -> float:
    """Return the relative error of bodies whose links were rounded to float32 once."""
    scene = load_scene(scene_name)
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(20))
    start = BodyStates.of(mechanism, batch)
    links = to_links(mechanism, start)
    short = LinkStates(*(values.astype(np.float32) * 1.0 for values in vars(links).values()))
    back = to_bodies(mechanism, short)
    return float(np.abs(back.position - start.position).max() / scene.length)


@pytest.mark.parametrize("scene", ["2pendulum", "6pendulum", "20pendulum"])
def test_single_precision_loses_a_share_of_what_is_allowed(scene: str) -> None:
    allowed = rounding.state_error(Mechanism.of(load_scene(scene)), SINGLE)

    assert allowed / 1000 < _lost(scene) < allowed


def test_longer_chains_and_more_steps_lose_more() -> None:
    short, long = (Mechanism.of(load_scene(name)) for name in ("2pendulum", "6pendulum"))

    assert rounding.state_error(long, SINGLE) == pytest.approx(
        3 * rounding.state_error(short, SINGLE)
    )
    assert rounding.step_error(SINGLE, 100) == pytest.approx(100 * 2.0**-24)
    assert rounding.state_error(long, DOUBLE) < 1e-13
    assert rounding.state_error(long, None) == rounding.state_error(long, DOUBLE)

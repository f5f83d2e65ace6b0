"""Pinocchio: what the contract suite does not see."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.testing import CASES

pytest.importorskip("pinocchio")

ENGINE = load_adapter("pinocchio")


def test_what_blows_up_ends_and_what_is_stepped_beside_it_goes_on() -> None:
    """One of two masses is let go where its stiff spring is slack, the other 0.1 m further out."""
    (soft,) = (case.scene for case in CASES if case.name == "spring")
    spring = msgspec.structs.replace(soft.springs[0], stiffness=1e8, damping=0.0)
    scene = msgspec.structs.replace(soft, springs=(spring,))
    batch = draw_batch(scene, [0, 1])
    batch.position[0] = (1.0, 0.0, 0.0)

    with ENGINE.open(scene, Settings("forward-dynamics-RK4", scene.clock.frame)) as run:
        motion = run.rollout(batch)

    slack, stretched = motion.failures
    assert slack is None
    np.testing.assert_array_equal(motion.position[0], np.broadcast_to([1.0, 0.0, 0.0], (51, 1, 3)))
    assert stretched is not None
    assert "a body's speed passes" in stretched.reason
    assert np.isnan(motion.position[1, stretched.frame :]).all()
    assert np.isfinite(motion.position[1, : stretched.frame]).all()


def test_rows_that_say_the_same_do_not_pull_at_a_driven_four_bar() -> None:
    """Its last hinge is closed by two points; 100 rounds at a softness of 1e-6 are 12 µm off."""
    scene = load_scene("workbench")
    batch = draw_batch(scene, [2]).truncated(50)

    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)

    exact = reference.solve(scene, batch)
    assert np.abs(motion.position - exact.position).max() < 1e-7

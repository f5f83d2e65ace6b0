"""Pinocchio, in cases that the contract suite does not cover."""

from __future__ import annotations

import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.registry import load_adapter, load_scene

pytest.importorskip("pinocchio")

ENGINE = load_adapter("pinocchio")


def test_rows_that_say_the_same_do_not_pull_at_a_driven_four_bar() -> None:
    """Two points close the last hinge; 100 rounds at a softness of 1e-6 would be 12 µm off."""
    scene = load_scene("workbench")
    batch = draw_batch(scene, [2]).truncated(50)

    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)

    exact = reference.solve(scene, batch)
    assert np.abs(motion.position - exact.position).max() < 1e-7

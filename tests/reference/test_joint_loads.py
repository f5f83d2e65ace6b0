"""Springs and dampers of joints in the reference: closed forms, and where whole turns are lost."""

from __future__ import annotations

import numpy as np
import pytest

from mbds_xsim.reference import marching
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.solution import solve, start_states
from mbds_xsim.scene.joint_space import joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.testing import Case
from mbds_xsim.testing.joint_cases import JOINT_CASES


@pytest.mark.parametrize("case", JOINT_CASES, ids=lambda case: case.name)
def test_the_reference_meets_the_closed_form(case: Case) -> None:
    motion = solve(case.scene, draw_batch(case.scene, [0]), cache=False)

    assert motion.failures == (None,)
    assert np.abs(motion.position[0] - case.exact(motion.time)).max() < 1e-11


def test_maximal_coordinates_end_where_a_spring_passes_half_a_turn() -> None:
    (case,) = (case for case in JOINT_CASES if case.name == "sprung hinge")
    mechanism, batch = Mechanism.of(case.scene), draw_batch(case.scene, [0])
    dynamics, start = dynamics_of(mechanism), start_states(mechanism, batch)
    problem = marching.Problem(dynamics, start, batch.force, batch.torque, rtol=1e-9)

    marched = marching.march(problem).within_half_turns(dynamics)

    (failure,) = marched.failures
    assert failure is not None
    assert "'axle' passes a half turn" in failure.reason
    before = dynamics.unpack(marched.states[0, : failure.frame])
    (axle,) = mechanism.compliant
    assert joint_coordinate(axle, before.position, before.native)[-1] > 2.5
    exact = case.exact(problem.frame * np.arange(failure.frame, dtype=float))
    assert before.position == pytest.approx(exact, abs=1e-8)
    assert np.isnan(marched.states[0, failure.frame :]).all()

"""Springs and dampers of joints in the reference: closed forms, and where whole turns are lost."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.reference.solution import confirmed, solve
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


@pytest.mark.parametrize("stiffness", [1e-3, 3.0])
def test_maximal_coordinates_end_where_a_spring_passes_half_a_turn(stiffness: float) -> None:
    """Steps lead over the jump of a weak spring's torque there, but not of a stronger one's."""
    (case,) = (case for case in JOINT_CASES if case.name == "sprung hinge")
    mount, axle, weld = case.scene.joints
    axle = msgspec.structs.replace(axle, stiffness=stiffness)
    scene = msgspec.structs.replace(case.scene, joints=(mount, axle, weld))
    batch = draw_batch(scene, [0])

    motion, truth = confirmed(scene, batch, False), solve(scene, batch, cache=False)

    (failure,) = motion.failures
    assert failure is not None
    assert "'axle' passes a half turn" in failure.reason
    mechanism = Mechanism.of(scene)
    native = mechanism.native_rotation(motion.orientation[0])
    angle = joint_coordinate(mechanism.compliant[0], motion.position[0], native)
    assert angle[failure.frame - 1] > 1.5
    assert np.abs(motion.position - truth.position)[:, : failure.frame].max() < 1e-8
    assert not motion.known[0, failure.frame :].any()

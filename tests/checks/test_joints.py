from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.checks import Record
from mbds_xsim.checks.integrity import angle_gap, gap
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Joint, Scene
from mbds_xsim.scene.state import Trajectory


def test_a_motion_that_keeps_its_joints_passes(pendulum: Any, tumbling: Any, linkage: Any) -> None:
    for case in (pendulum, tumbling, linkage):
        finding = gap.finding(Record(case.scene, case.batch, case.exact))
        assert finding.passed.all()
        assert finding.figure.max() < 1e-6


def test_a_gap_is_measured_in_metres_and_its_joint_named(linkage: Any) -> None:
    position = linkage.exact.position.copy()
    position[2, 11, 0] += [0.0, 3e-4, 4e-4]
    broken = dataclasses.replace(linkage.exact, position=position)
    finding = gap.finding(Record(linkage.scene, linkage.batch, broken))
    assert finding.passed.tolist() == [True, True, False]
    assert finding.figure[2] == pytest.approx(5e-4, rel=1e-3)
    assert finding.frame[2] == 11
    assert finding.where[2] in ("joint drive", "joint pin")


def test_a_hinge_may_turn_about_its_axis_and_about_no_other(tumbling: Any) -> None:
    axis = np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
    across = np.array([1.0, 0.0, 0.0])
    for vector, expected in ((0.7 * axis, 0.0), (2e-3 * across, 2e-3)):
        native = tumbling.exact.orientation.copy()
        native[:, 9, 1] = rotation.multiply(native[:, 9, 1], rotation.from_vector(vector))
        moved = dataclasses.replace(tumbling.exact, orientation=native)
        finding = angle_gap.finding(Record(tumbling.scene, tumbling.batch, moved))
        assert np.allclose(finding.figure, expected, atol=1e-8)
        assert finding.passed.all() == (expected == 0.0)


def test_a_quaternion_in_another_order_opens_the_joints(pendulum: Any) -> None:
    swapped = dataclasses.replace(
        pendulum.exact, orientation=np.roll(pendulum.exact.orientation, -1, axis=-1)
    )
    finding = gap.finding(Record(pendulum.scene, pendulum.batch, swapped))
    assert not finding.passed.any()


def _rail() -> Scene:
    ball = Inertia(1.0, (0.1, 0.1, 0.1))
    return Scene(
        name="rail",
        bodies=(
            Body("cart", inertia=ball, position=(1.0, 0.0, 0.0)),
            Body("load", inertia=ball, position=(1.0, 0.0, -1.0)),
        ),
        joints=(Joint("rail", "slider", "world", "cart", (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),),
        distance_links=(DistanceLink("rope", ("cart", "load"), ((1, 0, 0), (1, 0, -1))),),
        length=1.0,
        clock=Clock(0.02, 1),
    )


def test_sliders_and_distance_links_are_measured_across_their_freedom() -> None:
    scene = _rail()
    batch = draw_batch(scene, range(4))
    position = np.repeat(batch.position[:, None], 2, axis=1)
    position[0, 1] += [0.5, 0.0, 0.0]  # both along the rail: free
    position[1, 1] += [0.5, 0.0, 3e-3]  # both off the rail
    position[2, 1, 1] += [0.0, 0.0, 2e-3]  # the load into its rope
    orientation = np.repeat(batch.orientation[:, None], 2, axis=1)
    orientation[3, 1, 0] = rotation.from_vector(np.array([4e-3, 0.0, 0.0]))
    still = np.zeros_like(position)
    moved = Trajectory(np.array([0, 0.02]), position, orientation, still, still, (None,) * 4)
    record = Record(scene, batch, moved)
    distance, angle = gap.finding(record), angle_gap.finding(record)
    assert np.allclose(distance.figure, [0.0, 3e-3, 2e-3, 0.0], atol=1e-12)
    assert distance.where[1:3] == ("joint rail", "distance link rope")
    assert np.allclose(angle.figure, [0.0, 0.0, 0.0, 4e-3], atol=1e-12)

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from mbds_xsim.checks import Record
from mbds_xsim.checks.integrity import finite, planarity, precision, start
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate.claims import Method


def test_a_good_trajectory_is_finite_and_starts_where_it_was_drawn(pendulum: Any) -> None:
    record = Record(pendulum.scene, pendulum.batch, pendulum.exact)
    assert finite.finding(record).passed.all()
    assert start.finding(record).passed.all()
    assert finite.finding(record).figure.max() < 1e-14


def test_a_number_that_is_not_finite_fails_its_trajectory_alone(pendulum: Any) -> None:
    velocity = pendulum.exact.velocity.copy()
    velocity[1, 7:] = np.nan
    broken = dataclasses.replace(
        pendulum.exact, velocity=velocity, failures=(None, Failure(7, "it blew up"), None)
    )
    finding = finite.finding(Record(pendulum.scene, pendulum.batch, broken))
    assert finding.passed.tolist() == [True, False, True]
    assert finding.frame[1] == 7
    assert finding.worst == 1
    assert "it blew up" in finding.note


def test_a_quaternion_off_unit_length_fails(pendulum: Any) -> None:
    orientation = pendulum.exact.orientation.copy()
    orientation[2, 5, 1] *= 1 + 1e-8
    broken = dataclasses.replace(pendulum.exact, orientation=orientation)
    finding = finite.finding(Record(pendulum.scene, pendulum.batch, broken))
    assert finding.passed.tolist() == [True, True, False]
    assert (finding.frame[2], finding.where[2]) == (5, "link2")
    assert finding.figure[2] == pytest.approx(1e-8, rel=1e-4)


_STATE = ("position", "orientation", "velocity", "angular_velocity")


@pytest.mark.parametrize("field", _STATE)
def test_what_was_rounded_to_single_precision_fails(pendulum: Any, field: str) -> None:
    """One trajectory of three is rounded from frame 1 on, so that its start is the drawn one."""
    values = getattr(pendulum.exact, field).copy()
    values[1, 1:] = values[1, 1:].astype(np.float32)
    finding = precision.finding(
        Record(
            pendulum.scene,
            pendulum.batch,
            dataclasses.replace(pendulum.exact, **{field: values}),
        ),
    )
    assert finding.passed.tolist() == [True, False, True]
    assert finding.figure.tolist() == [0.0, 1.0, 0.0]
    ending = "(angular velocity rounded to 24 significant bits)"
    assert finding.line(1).endswith(ending.replace("angular velocity", field.replace("_", " ")))


def test_motion_that_is_exact_by_nature_is_not_rounded(pendulum: Any) -> None:
    """Bodies at rest pass, and a fall of 10 m/s² at 1/64 s, whose heights are float32 numbers."""
    still = {key: np.repeat(getattr(pendulum.exact, key)[:, :1], 65, axis=1) for key in _STATE}
    time = np.arange(65) / 64.0
    fall = {**still, "position": np.array(still["position"]).astype(np.float32).astype(float)}
    fall["position"][:] = 0.0
    fall["position"][..., 2] = (2049.0 - 5.0 * time**2)[:, None]
    fall["velocity"] = np.zeros_like(fall["position"])
    fall["velocity"][..., 2] = (-10.0 * time)[:, None]
    clock = msgspec.structs.replace(pendulum.scene.clock, frame=1.0 / 64.0, steps=64)
    scene = msgspec.structs.replace(pendulum.scene, clock=clock)
    batch = dataclasses.replace(pendulum.batch, position=fall["position"][:, 0])
    for motion in (still, fall):
        exact = dataclasses.replace(pendulum.exact, time=time, **motion)
        assert precision.finding(Record(scene, batch, exact)).figure.tolist() == [0.0] * 3


@pytest.mark.parametrize("field", ["position", "velocity", "angular_velocity"])
def test_another_start_than_the_drawn_one_fails(pendulum: Any, field: str) -> None:
    values = getattr(pendulum.exact, field).copy()
    values[0, 0, 2, 1] += 1e-9
    broken = dataclasses.replace(pendulum.exact, **{field: values})
    finding = start.finding(Record(pendulum.scene, pendulum.batch, broken))
    assert finding.passed.tolist() == [False, True, True]
    assert finding.where[0] == "link3"


def test_velocities_may_round_as_much_as_rates_at_an_arm_do(pendulum: Any) -> None:
    """Velocities of slow centres follow from tips of fast rods, at speeds of 1e6 m/s."""
    length = pendulum.scene.length
    spin = np.full_like(pendulum.batch.angular_velocity, 1e6)
    batch = dataclasses.replace(pendulum.batch, angular_velocity=spin)
    spins, velocity = (getattr(pendulum.exact, k).copy() for k in ("angular_velocity", "velocity"))
    spins[:, 0] = spin
    velocity[0, 0] += 0.9e-6 * length
    velocity[1, 0] += 1.1e-6 * length
    motion = dataclasses.replace(pendulum.exact, angular_velocity=spins, velocity=velocity)
    assert start.finding(Record(pendulum.scene, batch, motion)).passed.tolist() == [
        True,
        False,
        True,
    ]


def test_velocities_may_round_as_much_as_rates_at_the_origin_do(pendulum: Any) -> None:
    """Far away, an engine may compute velocities from those at the origin."""
    far = {"position": pendulum.exact.position + 1e5}
    spin = np.ones_like(pendulum.batch.angular_velocity)
    place = {"position": pendulum.batch.position + 1e5}
    batch = dataclasses.replace(pendulum.batch, **place, angular_velocity=spin)
    spins, velocity = (getattr(pendulum.exact, k).copy() for k in ("angular_velocity", "velocity"))
    spins[:, 0] = spin
    velocity[0, 0] += 1.7e-10
    velocity[1, 0] += 1.9e-10
    motion = dataclasses.replace(pendulum.exact, **far, angular_velocity=spins, velocity=velocity)
    assert start.finding(Record(pendulum.scene, batch, motion)).passed.tolist() == [
        True,
        False,
        True,
    ]


def test_the_sign_of_a_quaternion_is_no_defect_but_its_order_is(pendulum: Any) -> None:
    negated = dataclasses.replace(pendulum.exact, orientation=-pendulum.exact.orientation)
    assert start.finding(Record(pendulum.scene, pendulum.batch, negated)).passed.all()
    swapped = dataclasses.replace(
        pendulum.exact, orientation=np.roll(pendulum.exact.orientation, -1, axis=-1)
    )
    assert not start.finding(Record(pendulum.scene, pendulum.batch, swapped)).passed.any()


def test_a_flat_mechanism_that_leaves_its_plane_fails(linkage: Any, pendulum: Any) -> None:
    good = planarity.finding(Record(linkage.scene, linkage.batch, linkage.exact))
    assert good.passed.all()
    position = linkage.exact.position.copy()
    position[1, 20, 2, 1] += 2e-6 * linkage.scene.length
    broken = planarity.finding(
        Record(linkage.scene, linkage.batch, dataclasses.replace(linkage.exact, position=position))
    )
    assert broken.passed.tolist() == [True, False, True]
    assert broken.where[1] == "rocker"
    assert planarity(Record(pendulum.scene, pendulum.batch, pendulum.exact)) is None


def test_sideways_motion_is_measured_over_the_length(pendulum: Any) -> None:
    # The chain swings in 3D: declared flat, its sideways motion must show.
    flat = msgspec.structs.replace(pendulum.scene, dimension=2)
    finding = planarity.finding(Record(flat, pendulum.batch, pendulum.exact))
    sideways = np.abs(pendulum.exact.position[..., 1] - pendulum.exact.position[:, :1, :, 1])
    assert np.allclose(finding.figure, sideways.max(axis=(1, 2)) / flat.length)


def test_a_method_in_single_precision_is_held_to_what_24_bits_can_tell(pendulum: Any) -> None:
    """A start may be off by rounding, and not by a tenth of a millimetre."""
    single = Method("RK4", "RK4", 4, single=True)
    short = dataclasses.replace(
        pendulum.exact,
        **{name: getattr(pendulum.exact, name).astype(np.float32) * 1.0 for name in _STATE},
    )
    position = short.position.copy()
    position[2] += 1e-4

    about = pendulum.scene, pendulum.batch
    moved = Record(*about, dataclasses.replace(short, position=position), single)

    assert not start.finding(Record(*about, short)).passed.any()
    assert start.finding(moved).passed.tolist() == [True, True, False]
    assert precision(moved) is None

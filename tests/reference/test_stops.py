"""Stops of joints allow one motion, which never passes them and never gains energy."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import SceneError
from mbds_xsim.checks import Record
from mbds_xsim.checks.conservation import energy_of
from mbds_xsim.checks.stops import past_limits
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.testing.case import NONE, even
from tests.random_scenes import MOVED, SEEDS, Kind, ruled_tree


def _stopped(seed: int, kinds: list[Kind], restitution: float, friction: float) -> Scene:
    law = {"limits": (-0.3, 0.2), "restitution": restitution, "friction": friction, "rate": 0.5}
    return ruled_tree(seed, kinds, Clock(frame=0.01, steps=60), **law)


@settings(max_examples=6, deadline=None)
@given(SEEDS, MOVED, st.sampled_from([0.0, 0.4]), st.sampled_from([0.0, 1.0]))
def test_no_motion_passes_a_stop_or_gains_energy(
    seed: int, kinds: list[Kind], restitution: float, friction: float
) -> None:
    scene = _stopped(seed, kinds, restitution, friction)
    batch = draw_batch(scene, [0])
    record = Record(scene, batch, solve(scene, batch, cache=False))

    assert record.trajectory.failures == (None,)
    assert past_limits.finding(record).figure.max() < 1e-11
    energy = energy_of(record)
    assert np.diff(energy.total, axis=1).max() < 1e-9 * energy.scale.max()


def test_elastic_stops_keep_the_energy() -> None:
    scene = _stopped(3, ["hinge", "slider"], 1.0, 0.0)
    batch = draw_batch(scene, [0])
    record = Record(scene, batch, solve(scene, batch, cache=False))
    energy = energy_of(record)

    assert np.ptp(energy.total) < 1e-9 * energy.scale.max()


def test_two_carts_that_meet_their_stops_at_once_share_the_impulse() -> None:
    """A cart on a cart, each with 0.1 m to go at 1 m/s on its rail: both stop at once."""
    along = (1.0, 0.0, 0.0)
    scene = Scene(
        "carts",
        (even("below", 2.0, 0.1), even("above", 1.0, 0.1)),
        1.0,
        joints=(
            Joint("rail", "slider", "world", "below", NONE, along, rate=1.0, limits=(-1.0, 0.1)),
            Joint("deck", "slider", "below", "above", NONE, along, rate=1.0, limits=(-1.0, 0.1)),
        ),
        gravity=NONE,
        clock=Clock(0.02, 20),
    )
    mechanism = Mechanism.of(scene)
    states = BodyStates.of(mechanism, solve(scene, draw_batch(scene, [0]), cache=False))
    links = to_links(mechanism, states)

    assert np.abs(links.rate[0, -1]).max() < 1e-12
    np.testing.assert_allclose(links.coordinate[0, -1], 0.1, atol=1e-12)


def test_a_gripper_that_nothing_opens_stays_at_its_stops() -> None:
    """Equal fingers on one gear, at a swinging arm, move to and fro by rounding alone."""
    across, up = (0.6, 0.8, 0.0), (0.0, 0.0, 0.3)
    away = (-0.6, -0.8, 0.0)
    scene = Scene(
        "gripper",
        (even("arm", 3.0, 0.3, up), even("left", 0.1, 0.01, up), even("right", 0.1, 0.01, up)),
        1.0,
        joints=(
            Joint("shoulder", "hinge", "world", "arm", NONE, (0.48, 0.64, 0.6), rate=1.3),
            Joint("one", "slider", "arm", "left", up, across, damping=0.3, limits=(0.0, 0.04)),
            Joint("other", "slider", "arm", "right", up, away, damping=0.3, limits=(0.0, 0.04)),
        ),
        couplings=(Coupling("other", "one"),),
        clock=Clock(0.02, 50),
    )
    mechanism, motion = Mechanism.of(scene), solve(scene, draw_batch(scene, [0]), cache=False)
    links = to_links(mechanism, BodyStates.of(mechanism, motion))

    assert motion.failures == (None,)
    assert np.ptp(links.coordinate[0, :, 0]) > 1.0
    assert np.abs(links.coordinate[0, :, 1:]).max() < 1e-14


def _lifted(mass: float, radius: float, friction: float, rate: float) -> Scene:
    """An arm that lies on its stop, and at its end a wheel with its mass above the axle."""
    origin, hub, axis = (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 1.0, 0.0)
    arm = Body("arm", inertia=Inertia(1.0, (0.01, 0.02, 0.02), com=(0.3, 0.0, 0.0)))
    wheel = Inertia(mass, (0.001,) * 3, com=(0.0, 0.0, radius))
    pin = Joint("pin", "hinge", "world", "arm", origin, axis, rate=0.0, friction=friction)
    pin = msgspec.structs.replace(pin, limits=(-1.0, 0.0))
    axle = Joint("axle", "hinge", "arm", "wheel", hub, axis, rate=rate)
    bodies = (arm, Body("wheel", position=hub, inertia=wheel))
    return Scene("lifted", bodies, 1.0, joints=(pin, axle), clock=Clock(0.002, 1))


def test_a_joint_is_lifted_off_its_stop_against_its_friction_as_a_whole() -> None:
    """At the threshold rate of the wheel, rounding could let stop or friction give way alone."""
    for mass, radius, friction, rate in (
        (0.59, 0.153, 1.336, 12.605420836817402),
        (0.461, 0.129, 0.689, 14.077148474752903),
        (0.397, 0.101, 0.844, 16.911715008318424),
    ):
        for share, moves in ((0.999, False), (1.0, None), (1.001, True)):
            scene = _lifted(mass, radius, friction, share * rate)
            motion = solve(scene, draw_batch(scene, [0]), cache=False)
            assert motion.failures == (None,)
            assert moves in (None, bool(motion.velocity[0, -1, 0].any()))


def test_a_start_past_the_limits_is_refused() -> None:
    rod = Body("rod", inertia=Inertia(1.0, (0.1, 0.1, 0.1)))
    pin = Joint("pin", "hinge", "world", "rod", NONE, (0.0, 1.0, 0.0), start=0.5, limits=(0.0, 0.3))

    with pytest.raises(SceneError, match=r"'pin' is 0\.2 rad or m past its limits"):
        draw_batch(Scene("late", (rod,), 1.0, joints=(pin,)), [0])


def test_limits_must_ascend_and_a_rebound_needs_them() -> None:
    for law in ({"limits": (1.0, 1.0)}, {"restitution": 0.5}):
        with pytest.raises(SceneError, match="allowed"):
            Joint("pin", "hinge", "world", "rod", NONE, (0.0, 1.0, 0.0), **law)

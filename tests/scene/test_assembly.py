"""Starts of closed mechanisms, against closed-form kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import assemble, check_joints
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, DistanceLink, Inertia, Joint, Scene

Y = (0.0, 1.0, 0.0)
Point = tuple[float, float, float]


def _bar(name: str, start: Point, end: Point) -> Body:
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]), 0.5 * (start[2] + end[2]))
    return Body(name, inertia=Inertia(1.0, (0.1, 0.1, 0.01)), position=middle)


def _four_bar(crank: float | None, rate: float | None) -> Scene:
    """Ground 4, crank 2, coupler 4, rocker 3, in the x–z plane, crank up at the reference."""
    a, b = (0.0, 0.0, 0.0), (0.0, 0.0, 2.0)
    # The coupler's far end: 4 from b and 3 from d = (4, 0, 0).
    x, z = _circles((0.0, 2.0), 4.0, (4.0, 0.0), 3.0)
    c, d = (x, 0.0, z), (4.0, 0.0, 0.0)
    return Scene(
        "four-bar",
        (_bar("crank", a, b), _bar("coupler", b, c), _bar("rocker", c, d)),
        4.0,
        joints=(
            # Positive turns of the child are about +y: from +z towards +x.
            Joint("drive", "hinge", "world", "crank", a, Y, start=crank, rate=rate),
            Joint("knee", "hinge", "crank", "coupler", b, Y),
            Joint("elbow", "hinge", "coupler", "rocker", c, Y),
            Joint("swing", "hinge", "world", "rocker", d, Y),
        ),
    )


def _circles(
    p: tuple[float, float], r: float, q: tuple[float, float], s: float
) -> tuple[float, float]:
    """Upper intersection of two circles."""
    dx, dz = q[0] - p[0], q[1] - p[1]
    apart = math.hypot(dx, dz)
    along = (r * r - s * s + apart * apart) / (2 * apart)
    up = math.sqrt(r * r - along * along)
    return p[0] + (along * dx - up * dz) / apart, p[1] + (along * dz + up * dx) / apart


@pytest.mark.parametrize("crank", [0.0, 0.7, -0.7, math.pi / 2, 2.5, -3.0])
def test_a_four_bar_closes_where_circles_meet(crank: float) -> None:
    mechanism = Mechanism.of(_four_bar(crank, None))

    start = assemble(mechanism)

    b = (2.0 * math.sin(crank), 2.0 * math.cos(crank))
    c = _circles(b, 4.0, (4.0, 0.0), 3.0)
    rounding = 8e-15  # of lengths of 4 m: the circles' own included
    np.testing.assert_allclose(start.position[0], [b[0] / 2, 0.0, b[1] / 2], atol=rounding)
    np.testing.assert_allclose(
        start.position[1], [(b[0] + c[0]) / 2, 0.0, (b[1] + c[1]) / 2], atol=rounding
    )
    angle = joint_coordinate(mechanism.joints[0], start.position, start.native)
    assert angle == pytest.approx(crank, abs=rounding)
    assert np.all(start.velocity == 0.0)


def test_the_rate_of_a_four_bar_follows_its_poses() -> None:
    step, rate = 1e-5, 3.0

    now = assemble(Mechanism.of(_four_bar(0.7, rate)))

    ahead, behind = (assemble(Mechanism.of(_four_bar(0.7 + sign * step, None))) for sign in (1, -1))
    np.testing.assert_allclose(
        now.velocity, rate * (ahead.position - behind.position) / (2 * step), atol=1e-6
    )
    assert now.angular_velocity[0].tolist() == pytest.approx([0.0, rate, 0.0], abs=1e-12)
    check_joints(Mechanism.of(_four_bar(0.7, rate)), now)


def test_start_and_rate_of_a_slider_crank() -> None:
    crank, rod, angle, rate = 0.3, 1.0, 0.9, 2.0
    pin = (0.0, 0.0, crank)
    foot = (math.sqrt(rod**2 - crank**2), 0.0, 0.0)
    scene = Scene(
        "slider-crank",
        (
            _bar("crank", (0.0, 0.0, 0.0), pin),
            _bar("rod", pin, foot),
            Body("piston", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=foot),
        ),
        1.3,
        joints=(
            Joint("drive", "hinge", "world", "crank", (0.0, 0.0, 0.0), Y, start=angle, rate=rate),
            Joint("big end", "ball", "crank", "rod", pin),
            Joint("wrist", "hinge", "rod", "piston", foot, Y),
            Joint("guide", "slider", "world", "piston", foot, (1.0, 0.0, 0.0)),
        ),
    )
    mechanism = Mechanism.of(scene)

    start = assemble(mechanism)

    sine, cosine = math.sin(angle), math.cos(angle)
    root = math.sqrt(rod**2 - (crank * cosine) ** 2)
    travel = crank * sine + root
    speed = rate * (crank * cosine + crank**2 * cosine * sine / root)
    np.testing.assert_allclose(start.position[2], [travel, 0.0, 0.0], atol=1e-11)
    np.testing.assert_allclose(start.velocity[2], [speed, 0.0, 0.0], atol=1e-10)
    coordinate = joint_coordinate(mechanism.joints[3], start.position, start.native)
    assert coordinate == pytest.approx(travel - foot[0], abs=1e-11)


def test_a_slider_is_led_to_its_start() -> None:
    body = Body("cart", inertia=Inertia(1.0, (1.0, 1.0, 1.0)))
    for length in (0.1, 10.0):
        joint = Joint(
            "rail",
            "slider",
            "world",
            "cart",
            (0.0, 0.0, 0.0),
            (0.0, 3.0, 4.0),
            start=5.0,
            rate=-1.0,
        )

        start = assemble(Mechanism.of(Scene("cart", (body,), length, joints=(joint,))))

        np.testing.assert_allclose(start.position, [[0.0, 3.0, 4.0]], atol=1e-12)
        np.testing.assert_allclose(start.velocity, [[0.0, -0.6, -0.8]], atol=1e-12)


def test_a_distance_link_of_another_length_moves_the_lighter_body_more() -> None:
    ball = (1.0, 1.0, 1.0)
    scene = Scene(
        "two masses",
        (
            Body("heavy", inertia=Inertia(3.0, ball)),
            Body("light", inertia=Inertia(1.0, ball), position=(1.0, 0.0, 0.0)),
        ),
        1.0,
        distance_links=(
            DistanceLink("rod", ("heavy", "light"), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 1.4),
        ),
    )

    start = assemble(Mechanism.of(scene))

    # Mass-weighted steps keep the common centre of mass.
    np.testing.assert_allclose(start.position[:, 0], [-0.1, 1.3], atol=1e-12)


def test_velocities_left_out_are_those_of_least_kinetic_energy() -> None:
    inertia, arm = 0.2, 0.5
    scene = Scene(
        "two bars",
        (
            Body("driven", inertia=Inertia(1.0, (1.0, 1.0, 1.0)), velocity=(0.0, 0.0, 1.0),
                 angular_velocity=(0.0, 0.0, 0.0)),
            Body("pulled", inertia=Inertia(2.0, (1.0, inertia, 1.0)), position=(arm, 0.0, 0.0)),
        ),
        1.0,
        joints=(Joint("pin", "ball", "driven", "pulled", (0.0, 0.0, 0.0)),),
    )  # fmt: skip

    start = assemble(Mechanism.of(scene))

    # As after a blow at the pin: it moves at 1 m/s, with m v = −J and I ω = arm × J about y.
    blow = 1.0 / (1 / 2.0 + arm**2 / inertia)
    np.testing.assert_allclose(start.velocity[1], [0.0, 0.0, blow / 2.0], atol=1e-12)
    np.testing.assert_allclose(
        start.angular_velocity[1], [0.0, blow * arm / inertia, 0.0], atol=1e-12
    )


def test_velocities_against_a_joint_are_refused_by_name() -> None:
    scene = Scene(
        "held",
        (Body("bar", inertia=Inertia(1.0, (1.0, 1.0, 1.0)), velocity=(1.0, 0.0, 0.0)),),
        1.0,
        joints=(Joint("rail", "slider", "world", "bar", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),),
    )

    with pytest.raises(SceneError, match=r"contradict each other at (joints\['rail'\]|bodies\['b)"):
        assemble(Mechanism.of(scene))


def test_a_start_that_a_loop_forbids_is_refused_by_name() -> None:
    scene = _four_bar(None, None)
    joints = (*scene.joints[:3], Joint("swing", "hinge", "world", "rocker", (40.0, 0.0, 0.0), Y))

    # The reference pose places joints, so an anchor anywhere is a valid joint there.
    moved = Scene("moved", scene.bodies, 4.0, joints=joints)
    assert degrees_of_freedom(Mechanism.of(moved)) >= 1
    assemble(Mechanism.of(moved))
    rocker = Joint("swing", "hinge", "world", "rocker", (4.0, 0.0, 0.0), Y, start=2.0)
    locked = Scene("locked", scene.bodies, 4.0, joints=(*_four_bar(0.5, None).joints[:3], rocker))
    # The first of 20 strides fails: its small error must not be taken for that of the whole start.
    fault = r"joints\[.(drive|swing).\] cannot be closed: 5 % of the way to the start leaves it off"
    with pytest.raises(SceneError, match=fault):
        assemble(Mechanism.of(locked))


def test_a_gear_that_starts_past_half_a_turn_is_told_so() -> None:
    """Three times 1 rad is less than half a turn, three times 1.5 rad is more."""
    wheel = Inertia(1.0, (0.1,) * 3)
    bodies = tuple(Body(name, inertia=wheel) for name in ("large", "small"))
    for angle in (1.0, 1.5):
        large = Joint("large", "hinge", "world", "large", (0.0, 0.0, 0.0), Y, start=angle)
        small = Joint("small", "hinge", "world", "small", (1.0, 0.0, 0.0), Y)
        gear = (Coupling("small", "large", 3.0),)
        scene = Scene("gear", bodies, 1.0, joints=(large, small), couplings=gear)
        if angle < math.pi / 3:
            assemble(Mechanism.of(scene))
    with pytest.raises(SceneError, match="so that no coupled hinge starts past half a turn"):
        assemble(Mechanism.of(scene))


def test_check_joints_names_the_joint_of_any_trajectory() -> None:
    mechanism = Mechanism.of(_four_bar(0.0, 1.0))
    start = assemble(mechanism)
    many = BodyStates(*(np.stack([getattr(start, key)] * 3) for key in start.__dataclass_fields__))
    check_joints(mechanism, many)

    many.velocity[2, 0, 1] += 1e-6
    with pytest.raises(SceneError, match=r"velocities break joints\['(drive|knee)'\] at 1e-06"):
        check_joints(mechanism, many)
    many.position[1, 2, 0] += 1e-3
    with pytest.raises(SceneError, match=r"start leaves joints\['(elbow|swing)'\] off by 0.001"):
        check_joints(mechanism, many)


def test_a_speck_of_dust_on_a_long_rod_starts_as_given() -> None:
    """An open tree always starts: the rod weighs 1 kg, the part on its end 2e-15 kg."""
    rod = Body("rod", inertia=Inertia(1.0, (1 / 12, 1 / 12, 1e-4)), position=(0.0, 0.0, -0.5))
    speck = Body(
        "speck",
        inertia=Inertia(2e-15, (2e-28, 2e-28, 2e-28)),
        position=(0.0, 0.0, -1.0 - 5e-7),
    )
    axis = (0.0, 1.0, 0.0)
    joints = (
        Joint("top", "hinge", "world", "rod", (0.0, 0.0, 0.0), axis, start=0.3, rate=2.0),
        Joint("end", "hinge", "rod", "speck", (0.0, 0.0, -1.0), axis, start=-0.8, rate=5.0),
    )
    mechanism = Mechanism.of(Scene("dust", (rod, speck), 1.0, joints=joints))

    start = assemble(mechanism)

    for placed, (angle, rate) in zip(mechanism.joints, ((0.3, 2.0), (-0.8, 5.0)), strict=True):
        assert joint_coordinate(placed, start.position, start.native) == pytest.approx(angle)
        assert placed.kind == "hinge"
        parent = start.angular_velocity[placed.parent, 1] if placed.parent >= 0 else 0.0
        assert start.angular_velocity[placed.child, 1] - parent == pytest.approx(rate)
    pin = 2.0 * start.position[0]
    arm = rotation.rotate(start.native[1], np.array([0.0, 0.0, 5e-7]))
    np.testing.assert_allclose(start.position[1] + arm, pin, rtol=0, atol=1e-12)


def _chain(count: int, rate: float | None) -> Scene:
    """Make a chain of rods of 1 m that hangs from a hinge, each 0.1 rad on from the one above."""
    bodies = tuple(
        Body(f"rod{k}", inertia=Inertia(1.0, (1 / 12, 1 / 12, 1e-10)), position=(0, 0, -k - 0.5))
        for k in range(count)
    )
    names = ["world", *(body.name for body in bodies)]
    joints = tuple(
        Joint(f"pin{k}", "hinge", names[k], names[k + 1], (0, 0, -k), (0, 1, 0), 0.1, rate)
        for k in range(count)
    )
    return Scene("chain", bodies, float(count), joints=joints)


def test_a_long_chain_whose_rates_are_all_given_is_put_together_joint_by_joint() -> None:
    """Rates that add up to thousands, at arms of kilometres, leave the hinges together."""
    count = 2000
    start = assemble(mechanism := Mechanism.of(_chain(count, 1.0)))

    check_joints(mechanism, start)
    turn = 0.1 * np.arange(1, count + 1)
    spin = np.arange(1.0, count + 1.0)
    arm = -np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    swing = np.stack([-np.cos(turn), np.sin(turn)], axis=-1) * spin[:, None]
    for actual, rods in ((start.position, arm), (start.velocity, swing)):
        expected = np.cumsum(rods, axis=0) - rods / 2
        rounding = 1e-11 * np.abs(expected).max()
        np.testing.assert_allclose(actual[:, [0, 2]], expected, rtol=0, atol=rounding)
    np.testing.assert_allclose(start.angular_velocity[:, 1], spin, rtol=1e-15)


@pytest.mark.parametrize("rate", [None, 30.0])
def test_a_start_is_on_its_hinges_to_the_last_digit(rate: float | None) -> None:
    """The rod's least moment is 1e-10 kg·m²: weighted with it, rounding errors show at once."""
    start = assemble(Mechanism.of(_chain(1, rate)))

    assert start.native[0, [1, 3]].tolist() == [0.0, 0.0]
    assert start.angular_velocity[0].tolist() == [0.0, rate or 0.0, 0.0]
    assert np.abs(start.position[0] + [np.sin(0.1) / 2, 0.0, np.cos(0.1) / 2]).max() < 1e-16

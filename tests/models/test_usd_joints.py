"""Joints of USD Physics are read with frames, limits and drives as their schema defines them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from tests.models.usd_files import ARM, PLACE, general, joined, read, rigid

pytest.importorskip("pxr")


def test_a_joint_from_the_hand_to_the_base_is_turned_around(here: Path) -> None:
    forward = read(here, *ARM).scene
    swapped = joined(
        "Prismatic", "rail", ("fore", "upper"), '    uniform token physics:axis = "Z"\n'
    )
    backward = read(here, *ARM[:3], swapped).scene

    np.testing.assert_allclose(backward.joints[1].axis or (), -np.array(forward.joints[1].axis))
    assert backward.joints[1].child == "fore"


def test_limits_count_from_where_the_bodies_stand(here: Path) -> None:
    (shoulder, _) = read(here, *ARM).facts.joints

    standing = 2 * np.arccos(0.8)  # turned about y
    low, high = shoulder.limits or (0, 0)
    np.testing.assert_allclose([low, high], [-np.pi / 2 - standing, np.pi - standing], atol=1e-6)


@pytest.mark.parametrize("sign", ["", "-"])
@pytest.mark.parametrize(
    ("low", "high", "standing"),
    [(0, 180, 180), (-180, 0, -180), (90, 270, 180), (-190, -170, -180), (-180, 180, 180)],
)
def test_half_a_turn_counts_as_limits_say(
    sign: str, low: float, high: float, standing: float, here: Path
) -> None:
    limits = f"    float physics:lowerLimit = {low}\n    float physics:upperLimit = {high}\n"
    turn = f"(1e-9, {sign}1, 0, 0)"
    (joint,) = read(
        here, rigid("rod", "(0, 0, 0)", turn), joined("Revolute", "hip", ("", "rod"), limits)
    ).scene.joints

    assert joint.limits == pytest.approx(np.radians([low - standing, high - standing]), abs=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "standing"), [(350, 370, 1), (-730, -710, -2), (190, 270, 1)]
)
def test_whole_turns_count_as_limits_say(
    low: float, high: float, standing: int, here: Path
) -> None:
    limits = f"    float physics:lowerLimit = {low}\n    float physics:upperLimit = {high}\n"
    span = np.radians([low - 360 * standing, high - 360 * standing])
    for joint in (joined("Revolute", "hip", ("", "rod"), limits), general(("rotX", low, high))):
        (read_joint,) = read(here, rigid("rod", "(0, 0, 0)"), joint).scene.joints
        assert read_joint.limits == pytest.approx(span, abs=1e-6)


def test_a_drive_to_half_a_turn_does_not_wind_up(here: Path) -> None:
    for target in (180, -180):
        inside = (
            "    float drive:angular:physics:stiffness = 3\n"
            f"    float drive:angular:physics:targetPosition = {target}\n"
        )
        hip = _driven("Revolute", "angular", inside)
        (servo,) = read(here, rigid("rod", "(1, 2, 3)", "(0, 1, 0, 0)"), hip).scene.servos
        assert servo.position == pytest.approx((0,), abs=1e-6)


def test_limits_that_are_upside_down_are_dropped(here: Path) -> None:
    limits = "    float physics:lowerLimit = 1\n    float physics:upperLimit = -1\n"
    joint = joined("Prismatic", "rail", ("", "rod"), PLACE + limits)
    imported = read(here, rigid("rod", "(1, 2, 3)"), joint)

    assert imported.scene.joints[0].limits is None
    (entry,) = (fate for fate in imported.fates if fate.properties == ("physics:lowerLimit",))
    assert (entry.outcome, entry.places) == ("dropped", ("rail: 1 to -1",))


def _driven(kind: str, token: str, inside: str) -> str:
    joint = joined(kind, "hip", ("", "rod"), inside + PLACE)
    head, _, rest = joint.partition("\n")
    return f'{head} (prepend apiSchemas = ["PhysicsDriveAPI:{token}"])\n{rest}'


def test_a_drive_is_a_servo_to_its_target_with_its_limit(here: Path) -> None:
    """Drives use degrees and the stage's units: 0.1 m and 2 kg make torques of 0.02 N·m."""
    law = {"stiffness": 3, "damping": 0.5, "targetPosition": 90, "targetVelocity": 18}
    inside = "".join(
        f"    float drive:angular:physics:{key} = {value}\n"
        for key, value in (law | {"maxForce": 40}).items()
    )
    imported = read(
        here,
        rigid("rod", "(1, 2, 3)"),
        _driven("Revolute", "angular", inside),
        units=(0.1, 2, "Z"),
    )

    (servo,) = imported.scene.servos
    assert servo.joint == "hip"
    assert servo.stiffness == pytest.approx(3 * 0.02 * 180 / np.pi)
    assert servo.damping == pytest.approx(0.5 * 0.02 * 180 / np.pi)
    assert servo.position == pytest.approx((np.pi / 2,), abs=1e-6)
    assert servo.velocity == pytest.approx((np.pi / 10,), abs=1e-6)
    assert servo.limit == pytest.approx(0.8)
    fates = [fate for fate in imported.fates if fate.element == "drive"]
    assert [(fate.outcome, fate.reason) for fate in fates] == [
        ("kept", "a servo to the target of the file")
    ]


def test_a_drive_of_accelerations_is_told(here: Path) -> None:
    inside = (
        '    uniform token drive:linear:physics:type = "acceleration"\n'
        "    float drive:linear:physics:damping = 3\n"
    )
    imported = read(here, rigid("rod", "(1, 2, 3)"), _driven("Prismatic", "linear", inside))

    assert not imported.scene.servos
    (fate,) = (fate for fate in imported.fates if fate.element == "drive")
    assert (fate.outcome, fate.moves) == ("dropped", True)
    assert "gains are of accelerations" in fate.reason


@pytest.mark.parametrize(
    ("kind", "token", "inside", "reason", "moves"),
    [
        ("Prismatic", "angular", "stiffness = 3", "its joint has no such axis, or its API", True),
        ("Revolute", "rotX", "stiffness = 3", "its joint has no such axis, or its API", True),
        ("Revolute", "angular", "stiffness = -3", "it has a negative gain", True),
        ("Revolute", "angular", "stiffness = 0", "it has no gain, and so exerts nothing", False),
    ],
)
def test_a_drive_that_is_no_servo_is_told(
    kind: str, token: str, inside: str, reason: str, moves: bool, here: Path
) -> None:
    drive = f"    float drive:{token}:physics:{inside}\n"
    imported = read(here, rigid("rod", "(1, 2, 3)"), _driven(kind, token, drive))

    assert not imported.scene.servos
    (fate,) = (f for f in imported.fates if "drive" in f.element + "".join(f.properties))
    assert (fate.outcome, fate.places, fate.moves) == ("dropped", ("hip",), moves)
    assert fate.reason.startswith(reason)


def test_a_target_that_changes_in_time_is_told(here: Path) -> None:
    drive = "float drive:angular:physics:stiffness = 3\n"
    drive += "float drive:angular:physics:targetPosition.timeSamples = { 0: 10, 1: 20 }\n"
    imported = read(here, rigid("rod", "(1, 2, 3)"), _driven("Revolute", "angular", drive))

    (fate,) = (fate for fate in imported.fates if fate.outcome == "dropped")
    assert (fate.properties, fate.moves) == (("drive:angular:physics:targetPosition",), True)


def test_a_limit_that_the_library_does_not_parse_is_told(here: Path) -> None:
    text = general(("transX", 0, 2)).replace('"PhysicsLimitAPI:rotX", ', "")
    imported = read(here, rigid("rod", "(1, 0, 0)"), text)

    assert [joint.kind for joint in imported.scene.joints] == ["slider", "hinge"]
    outcomes = {name: f.outcome for f in imported.fates for name in f.properties}
    assert outcomes["limit:rotX:physics:low"] == "dropped"
    assert outcomes["limit:rotY:physics:low"] == "kept"


_WRITTEN = [
    ("state:angular:physics:position", "30", "0"),
    ("physics:breakForce", "9", "inf"),
    ("physics:coneAngle0Limit", "30", "-1"),
]


@pytest.mark.parametrize(("name", "value", "none"), _WRITTEN)
def test_what_no_scene_has_is_told_unless_it_is_none(
    name: str, value: str, none: str, here: Path
) -> None:
    for stated, outcome in ((value, "dropped"), (none, "kept")):
        joint = joined("Spherical", "hip", ("", "rod"), f"    float {name} = {stated}\n" + PLACE)
        imported = read(here, rigid("rod", "(1, 2, 3)"), joint)

        (fate,) = (fate for fate in imported.fates if name in fate.properties)
        assert (fate.outcome, fate.moves) == (outcome, True)


def test_general_joints_count_from_where_the_bodies_stand(here: Path) -> None:
    drives = (
        "    float drive:transX:physics:stiffness = 10\n"
        "    float drive:transX:physics:targetPosition = 0.2\n"
    )
    rail = read(here, rigid("rod", "(0.5, 0, 0)"), general(("transX", 0, 1), more=drives))
    hinge = read(here, rigid("rod", "(0, 0, 0)", "(0.8, 0.6, 0, 0)"), general(("rotX", -90, 180)))

    assert rail.scene.joints[0].limits == pytest.approx((-0.5, 0.5))
    assert rail.scene.servos[0].position == pytest.approx((-0.3,))
    standing = 2 * np.arccos(0.8)
    span = (-np.pi / 2 - standing, np.pi - standing)
    assert hinge.scene.joints[0].limits == pytest.approx(span, abs=1e-6)


def test_a_general_joint_turns_about_the_frame_of_the_second_body(here: Path) -> None:
    crane = general(("transX", 0, 1), ("rotZ", -90, 90))
    slider, hinge = read(here, rigid("rod", "(0.5, 0, 0)"), crane).scene.joints

    assert (slider.kind, hinge.kind) == ("slider", "hinge")
    assert hinge.anchor == pytest.approx((0.5, 0, 0))


def test_a_limit_on_one_side_is_kept(here: Path) -> None:
    for kind, side, span in (
        ("Revolute", "lower", (0.0, 1e9)),
        ("Prismatic", "upper", (-1e9, 0.0)),
    ):
        joint = joined(kind, "hip", ("", "rod"), f"    float physics:{side}Limit = 0\n{PLACE}")
        assert read(here, rigid("rod", "(1, 2, 3)"), joint).scene.joints[0].limits == span


def test_places_of_joints_are_scaled_once(here: Path) -> None:
    scaled = (
        "double3 xformOp:scale = (0.01, 0.01, 0.01)\n"
        'uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    )
    bodies = rigid("upper", "(0, 0, 0)") + rigid("fore", "(0, 0, 200)")
    frames = (
        "    point3f physics:localPos0 = (0, 0, 100)\n"
        "    point3f physics:localPos1 = (0, 0, -100)\n"
        "    quatf physics:localRot0 = (0, 0, 0, 0)\n"
    )
    joints = joined("Revolute", "shoulder", ("", "arm/upper")) + joined(
        "Revolute", "elbow", ("arm/upper", "arm/fore"), frames
    )
    scene = read(here, f'def Xform "arm"\n{{\n{scaled}{bodies}}}\n', joints).scene

    assert scene.bodies[1].position == pytest.approx((0, 0, 2))
    assert scene.joints[1].anchor == pytest.approx((0, 0, 1))


def test_limits_of_a_joint_that_closes_a_loop_are_told(here: Path) -> None:
    limits = "    float physics:lowerLimit = -10\n    float physics:upperLimit = 10\n"
    bodies = rigid("a", "(0, 0, 0)"), rigid("b", "(0, 0, 0)")
    joints = [joined("Revolute", f"to_{name}", ("", name)) for name in "ab"]
    imported = read(here, *bodies, *joints, joined("Revolute", "loop", ("a", "b"), limits))

    (fate,) = (each for each in imported.fates if "physics:lowerLimit" in each.properties)
    assert (fate.outcome, fate.moves, fate.places) == ("dropped", True, ("loop",))
    assert fate.reason == "its joint closes a loop"


def test_a_rod_is_as_long_as_its_ends_are_apart_but_for_rounding(here: Path) -> None:
    """Its length is in single precision; a and b only turn about the axis of one of its ends."""
    hinges = [joined("Revolute", f"to_{name}", ("", name)) for name in "ab"]
    length = "".join(f"    float physics:{side}Distance = 1.1401754\n" for side in ("min", "max"))
    place = "    point3f physics:localPos1 = (0, 0.7, 0.9)\n"
    rod = joined("Distance", "rod", ("a", "b"), length + place)
    scene = read(here, rigid("a", "(0, 0, 0)"), rigid("b", "(0, 0, 0)"), *hinges, rod).scene

    assert scene.distance_links[0].length == pytest.approx(1.3**0.5, abs=1e-7)


def test_a_loop_that_no_joint_closes_is_refused(here: Path) -> None:
    general = joined("", "loose", ("upper", ""))
    with pytest.raises(InputError, match="too many freedoms"):
        read(here, *ARM, general)

"""USD Physics is read with masses, frames and units as its schema defines them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model
from tests.command_line import CommandLine

pytest.importorskip("pxr")

_HEAD = '#usda 1.0\n(\n    metersPerUnit = {}\n    kilogramsPerUnit = {}\n    upAxis = "{}"\n)\n'
_SCENE = 'def PhysicsScene "scene"\n{\n}\n'
_MASS = """        float physics:mass = 2
        point3f physics:centerOfMass = (0, 0, -0.5)
        float3 physics:diagonalInertia = (0.5, 0.5, 0.25)
"""
_ORDER = '        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]\n'
_APIS = '(prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])'


def _body(name: str, place: str, turn: str = "(1, 0, 0, 0)", inside: str = _MASS) -> str:
    return (
        f'def Xform "{name}" {_APIS}\n{{\n        double3 xformOp:translate = {place}\n'
        f"        quatd xformOp:orient = {turn}\n{_ORDER}{inside}}}\n"
    )


def _joint(kind: str, name: str, ends: tuple[str, str], inside: str = "") -> str:
    first, second = (
        f"    rel physics:body{k} = </{end}>\n" if end else "" for k, end in enumerate(ends)
    )
    return f'def Physics{kind}Joint "{name}"\n{{\n{first}{second}{inside}}}\n'


def _read(here: Path, *parts: str, units: tuple[float, float, str] = (1, 1, "Z")) -> Imported:
    (here / "model.usda").write_text(_HEAD.format(*units) + _SCENE + "".join(parts))
    return read_model(here / "model.usda")


_PLACE = "    point3f physics:localPos0 = (1, 2, 3)\n"
_ARM = (
    _body("upper", "(1, 2, 3)", "(0.8, 0, 0.6, 0)"),
    _body("fore", "(1.96, 2, 3.28)", "(0.8, 0, 0.6, 0)"),
    _joint(
        "Revolute",
        "shoulder",
        ("", "upper"),
        '    uniform token physics:axis = "Y"\n    point3f physics:localPos0 = (1, 2, 3)\n'
        "    quatf physics:localRot0 = (1, 0, 0, 0)\n"
        "    float physics:lowerLimit = -90\n    float physics:upperLimit = 180\n",
    ),
    _joint("Prismatic", "rail", ("upper", "fore"), '    uniform token physics:axis = "Z"\n'),
)


def test_a_chain_stands_where_its_prims_do(here: Path) -> None:
    scene = _read(here, *_ARM).scene

    mechanism = Mechanism.of(scene)
    turn = rotation.matrix(np.array([0.8, 0, 0.6, 0]))
    np.testing.assert_allclose(mechanism.com[0], [1 - 0.48, 2, 3 - 0.14], atol=1e-7)
    inertia = turn @ np.diag([0.5, 0.5, 0.25]) @ turn.T
    np.testing.assert_allclose(mechanism.inertia[0], inertia, atol=1e-7)
    shoulder, rail = scene.joints
    np.testing.assert_allclose(shoulder.axis or (), [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(shoulder.anchor, [1, 2, 3], atol=1e-7)
    np.testing.assert_allclose(rail.axis or (), [0.96, 0, 0.28], atol=1e-7)
    assert (rail.parent, rail.child) == ("upper", "fore")
    assert scene.gravity == pytest.approx((0, 0, -9.81), abs=1e-6)


def test_limits_count_from_where_the_bodies_stand(here: Path) -> None:
    (shoulder, _) = _read(here, *_ARM).facts.joints

    standing = 2 * np.arccos(0.8)  # turned about y
    low, high = shoulder.limits or (0, 0)
    np.testing.assert_allclose([low, high], [-np.pi / 2 - standing, np.pi - standing], atol=1e-6)


def test_limits_that_are_upside_down_are_dropped(here: Path) -> None:
    limits = "    float physics:lowerLimit = 1\n    float physics:upperLimit = -1\n"
    joint = _joint("Prismatic", "rail", ("", "rod"), _PLACE + limits)
    imported = _read(here, _body("rod", "(1, 2, 3)"), joint)

    assert imported.scene.joints[0].limits is None
    (entry,) = (fate for fate in imported.fates if fate.properties == ("physics:lowerLimit",))
    assert (entry.outcome, entry.places) == ("dropped", ("rail: 1 to -1",))


def test_centimetres_grams_and_y_up_become_si_and_z_up(here: Path) -> None:
    parts = (
        _body("rod", "(100, 200, 300)"),
        _joint(
            "Spherical", "ball", ("", "rod"), "    point3f physics:localPos0 = (100, 200, 300)\n"
        ),
    )
    scene = _read(here, *parts, units=(0.01, 0.001, "Y")).scene

    mechanism = Mechanism.of(scene)
    np.testing.assert_allclose(scene.joints[0].anchor, [1, -3, 2], atol=1e-7)
    np.testing.assert_allclose(mechanism.com[0], [1, -3 + 0.005, 2], atol=1e-7)
    np.testing.assert_allclose(mechanism.mass, [0.002], rtol=1e-7)
    # Its z is our −y: the smallest moment is along y.
    expected = np.diag([0.5, 0.25, 0.5]) * 1e-3 * 1e-4
    np.testing.assert_allclose(mechanism.inertia[0], expected, rtol=1e-6, atol=1e-15)
    assert scene.gravity == pytest.approx((0, 0, -9.81), rel=1e-6)


_R, _H = 0.3, 0.8
_BALL, _ROD = 4 / 3 * np.pi * _R**3, np.pi * _R**2 * _H


@pytest.mark.parametrize(
    ("shape", "volume", "moments"),
    [
        ("Cube", 0.008, np.full(3, 0.008 * 2 / 12 * 0.04)),
        ("Sphere", _BALL, np.full(3, 0.4 * _BALL * _R**2)),
        (
            "Cylinder",
            _ROD,
            np.array([_R**2 / 2, *[(3 * _R**2 + _H**2) / 12] * 2]) * _ROD,
        ),
        (
            "Cone",
            _ROD / 3,
            np.array([0.3 * _R**2, *[0.15 * _R**2 + 3 / 80 * _H**2] * 2]) * _ROD / 3,
        ),
        (
            "Capsule",
            _ROD + _BALL,
            np.array([
                _ROD * _R**2 / 2 + 0.4 * _BALL * _R**2,
                *[
                    _ROD * (3 * _R**2 + _H**2) / 12
                    + _BALL * (0.4 * _R**2 + _H**2 / 4 + 3 / 8 * _H * _R)
                ] * 2,
            ]),
        ),
    ],
)  # fmt: skip
def test_shapes_weigh_by_their_density(
    here: Path, shape: str, volume: float, moments: list[float]
) -> None:
    size = {
        "Cube": "double size = 0.2",
        "Sphere": f"double radius = {_R}",
    }.get(shape, f'double radius = {_R}\ndouble height = {_H}\nuniform token axis = "X"')
    inside = (
        f'def {shape} "solid" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"])\n'
        f"{{\n{size}\nfloat physics:density = 500\n}}\n"
    )
    scene = _read(here, _body("solid", "(0, 0, 1)", inside=inside)).scene

    mechanism = Mechanism.of(scene)
    np.testing.assert_allclose(mechanism.mass[0], 500 * volume, rtol=1e-6)
    np.testing.assert_allclose(np.diag(mechanism.inertia[0]), 500 * np.array(moments), rtol=2e-6)
    assert degrees_of_freedom(mechanism) == 6


def test_a_joint_from_the_hand_to_the_base_is_turned_around(here: Path) -> None:
    forward = _read(here, *_ARM).scene
    swapped = _joint(
        "Prismatic", "rail", ("fore", "upper"), '    uniform token physics:axis = "Z"\n'
    )
    backward = _read(here, *_ARM[:3], swapped).scene

    np.testing.assert_allclose(backward.joints[1].axis or (), -np.array(forward.joints[1].axis))
    assert backward.joints[1].child == "fore"


def test_a_name_is_the_last_part_of_a_path_where_no_other_has_it(here: Path) -> None:
    rod, other = (_body("rod", place) for place in ("(1, 2, 3)", "(4, 5, 6)"))
    arm = _body("arm", "(7, 8, 9)")
    scene = _read(here, f'def "left"\n{{\n{rod}{arm}}}\n', f'def "right"\n{{\n{other}}}\n').scene

    assert [body.name for body in scene.bodies] == ["left rod", "arm", "right rod"]


def test_what_is_lost_is_named(here: Path) -> None:
    inside = "    float drive:angular:physics:stiffness = 3\n    float physxJoint:armature = 0.1\n"
    imported = _read(
        here, _body("rod", "(1, 2, 3)"), _joint("Revolute", "hip", ("", "rod"), inside + _PLACE)
    )

    lost = {name for f in imported.fates if f.outcome == "dropped" for name in f.properties}
    assert {"drive:angular:physics:stiffness", "physxJoint:armature"} <= lost


def _driven(kind: str, token: str, inside: str) -> str:
    joint = _joint(kind, "hip", ("", "rod"), inside + _PLACE)
    head, _, rest = joint.partition("\n")
    return f'{head} (prepend apiSchemas = ["PhysicsDriveAPI:{token}"])\n{rest}'


def test_a_drive_is_a_servo_to_its_target_with_its_limit(here: Path) -> None:
    """Drives use degrees and the stage's units: 0.1 m and 2 kg make torques of 0.02 N·m."""
    law = {"stiffness": 3, "damping": 0.5, "targetPosition": 90, "targetVelocity": 18}
    inside = "".join(
        f"    float drive:angular:physics:{key} = {value}\n"
        for key, value in (law | {"maxForce": 40}).items()
    )
    imported = _read(
        here, _body("rod", "(1, 2, 3)"), _driven("Revolute", "angular", inside), units=(0.1, 2, "Z")
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
    imported = _read(here, _body("rod", "(1, 2, 3)"), _driven("Prismatic", "linear", inside))

    assert not imported.scene.servos
    (fate,) = (fate for fate in imported.fates if fate.element == "drive")
    assert (fate.outcome, fate.moves) == ("dropped", True)
    assert "gains are of accelerations" in fate.reason


_MESH = 'def Mesh "shell" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'
_POINT = (
    'float physics:mass = 1\ndef Sphere "point" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n'
    "{\ndouble radius = 0\n}\n"
)
_BAD = {
    "text": ("#usda 1.0\ndef {", "model.usda:2:1: parse error matching"),
    "place": (_body("rod", "(nan, 2, 3)"), "position of 'rod': got [nan, "),
    "size": (_body("rod", "(0, 0, 0)", inside=_POINT), "inertia of 'rod': got [nan, "),
    "units": (_HEAD.format(0, 1, "Z") + _body("rod", "(1, 2, 3)"), "metersPerUnit: got 0.0, allow"),
    "apart": (
        _body("rod", "(1, 2, 3)") + _joint("Revolute", "hip", ("", "rod")),
        "'hip' differ as bodies are placed: got 3.74 m between",
    ),
    "twisted": (
        _body("rod", "(0, 0, 0)", "(0.8, 0.6, 0, 0)") + _joint("Fixed", "weld", ("", "rod")),
        "got 0 m between origins and 1.7",
    ),
    "reversed": (
        _body("rod", "(0, 0, 0)", "(0, 0, 1, 0)") + _joint("Revolute", "hip", ("", "rod")),
        "got 0 m between origins and 2 between axes",
    ),
    "mesh": (_body("rod", "(0, 0, 0)", inside=_MESH), "state its mass and diagonalInertia"),
    "reference": ('def "a" (references = @gone.usda@)\n{\n}\n', "'gone.usda', which is not there"),
    "outside": ('def "a" (references = @../outside.usda@)\n{\n}\n', "import` a --folder"),
    "nothing": ('def Xform "a"\n{\n}\n', "nothing in it moves"),
}


@pytest.mark.parametrize("name", _BAD)
def test_a_bad_stage_is_one_line(name: str, run: CommandLine, here: Path) -> None:
    text, part = _BAD[name]
    head = "" if text.startswith("#") else _HEAD.format(1, 1, "Z")
    (here / "model.usda").write_text(head + text)
    (here.parent / "outside.usda").write_text("#usda 1.0\n")

    refusal = run("import", "model.usda").refusal

    assert refusal.startswith("mbds-xsim: model.usda: ")
    assert part in refusal


def test_a_loop_that_no_joint_closes_is_refused(here: Path) -> None:
    general = _joint("", "loose", ("upper", ""))
    with pytest.raises(InputError, match="too many freedoms"):
        _read(here, *_ARM, general)

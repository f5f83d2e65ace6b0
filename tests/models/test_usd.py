"""USD Physics is read with masses, frames and units as its schema defines them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model
from tests.command_line import CommandLine
from tests.models.usd_files import ARM, HEAD, PLACE, SCENE, general, joined, read, rigid

pytest.importorskip("pxr")


def test_a_chain_stands_where_its_prims_do(here: Path) -> None:
    scene = read(here, *ARM).scene

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
    assert scene.gravity == (0, 0, -9.81)  # stated in single precision


def test_centimetres_grams_and_y_up_become_si_and_z_up(here: Path) -> None:
    parts = (
        rigid("rod", "(100, 200, 300)"),
        joined(
            "Spherical", "ball", ("", "rod"), "    point3f physics:localPos0 = (100, 200, 300)\n"
        ),
    )
    scene = read(here, *parts, units=(0.01, 0.001, "Y")).scene

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
    scene = read(here, rigid("solid", "(0, 0, 1)", inside=inside)).scene

    mechanism = Mechanism.of(scene)
    np.testing.assert_allclose(mechanism.mass[0], 500 * volume, rtol=1e-6)
    np.testing.assert_allclose(np.diag(mechanism.inertia[0]), 500 * np.array(moments), rtol=2e-6)
    assert degrees_of_freedom(mechanism) == 6


def test_a_name_is_the_last_part_of_a_path_where_no_other_has_it(here: Path) -> None:
    rod, other = (rigid("rod", place) for place in ("(1, 2, 3)", "(4, 5, 6)"))
    arm = rigid("arm", "(7, 8, 9)")
    scene = read(here, f'def "left"\n{{\n{rod}{arm}}}\n', f'def "right"\n{{\n{other}}}\n').scene

    assert [body.name for body in scene.bodies] == ["left rod", "arm", "right rod"]


def test_what_is_lost_is_named(here: Path) -> None:
    inside = "    float drive:angular:physics:stiffness = 3\n    float physxJoint:armature = 0.1\n"
    imported = read(
        here,
        rigid("rod", "(1, 2, 3)"),
        joined("Revolute", "hip", ("", "rod"), inside + PLACE),
    )

    lost = {name for f in imported.fates if f.outcome == "dropped" for name in f.properties}
    assert {"drive:angular:physics:stiffness", "physxJoint:armature"} <= lost


def test_what_instances_hold_is_told(here: Path) -> None:
    shell = 'def Cube "box" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\ndouble size = 0.2\n'
    part = f'def Xform "part"\n{{\n{shell}float physxCollision:offset = 1\n}}\n}}\n'
    copy = 'def Xform "copy" (instanceable = true\nprepend references = </part>)\n{\n}\n'
    imported = read(here, rigid("rod", "(0, 0, 0)", inside=copy), part)

    assert imported.facts.links[0].mass == pytest.approx(1000 * 0.2**3)
    fates = {f.properties: f for f in imported.fates if f.element == "Cube"}
    assert fates["size",].count == fates["physxCollision:offset",].count == 2
    assert (fates["size",].outcome, fates["physxCollision:offset",].outcome) == ("kept", "dropped")
    contact = fates["physics:collisionEnabled",]  # which no one writes, as it is the default
    assert (contact.outcome, contact.moves, contact.count) == ("dropped", True, 2)


def test_a_place_that_changes_in_time_is_told(here: Path) -> None:
    rod = rigid("rod", "(1, 2, 3)").replace("translate =", "translate.timeSamples =")
    imported = read(here, rod.replace("(1, 2, 3)", "{ 0: (1, 2, 3) }"))

    (fate,) = (f for f in imported.fates if f.outcome == "dropped")
    assert (fate.properties, fate.moves, fate.places) == (("xformOp:translate",), True, ("rod",))


def test_a_camera_that_moves_is_no_loss(here: Path) -> None:
    place = "double3 xformOp:translate.timeSamples = { 0: (1, 2, 3) }\n"
    order = 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    imported = read(here, rigid("rod", "(1, 2, 3)"), f'def Camera "eye"\n{{\n{place}{order}}}\n')

    assert {fate.outcome for fate in imported.fates} == {"kept"}


@pytest.mark.parametrize(("speed", "outcome"), [("(0, 1, 0)", "dropped"), ("(0, 0, 0)", "kept")])
def test_a_speed_is_told_unless_it_is_none(speed: str, outcome: str, here: Path) -> None:
    inside = _STATED + f"vector3f physics:velocity = {speed}\n"
    imported = read(here, rigid("rod", "(1, 2, 3)", inside=inside))

    (fate,) = (fate for fate in imported.fates if "physics:velocity" in fate.properties)
    assert fate.outcome == outcome


def test_units_and_axis_that_a_stage_does_not_state_are_told(here: Path) -> None:
    (here / "model.usda").write_text("#usda 1.0\n" + SCENE + "".join(ARM))
    bare, stated = read_model(here / "model.usda"), read(here, *ARM, units=(0.01, 1, "Y"))

    assert bare.scene == stated.scene
    told = {fate.properties for fate in bare.fates if fate.outcome == "approximated" and fate.moves}
    assert {("metersPerUnit",), ("upAxis",)} <= told
    assert not any(fate.element == "stage" for fate in stated.fates)


_STATED = "float physics:mass = 2\nfloat3 physics:diagonalInertia = (1, 1, 1.5)\n"
_ASIDE = (
    'def Sphere "ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\ndouble radius = 0.1\n'
    "double3 xformOp:translate = (0.5, 0, 0)\n"
    'uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
)
_NO_CENTRE = "point3f physics:centerOfMass = (-inf, -inf, -inf)\n"


@pytest.mark.parametrize("inside", [_STATED + _ASIDE, _STATED + _NO_CENTRE + _ASIDE])
def test_a_centre_of_mass_that_is_not_stated_is_that_of_the_shapes(here: Path, inside: str) -> None:
    (body,) = read(here, rigid("rod", "(0, 0, 0)", inside=inside)).scene.bodies

    assert body.inertia is not None
    assert body.inertia.com == pytest.approx((0.5, 0, 0))
    assert (body.inertia.mass, body.inertia.moments) == (2, (1, 1, 1.5))


def test_stated_moments_without_axes_are_along_those_of_the_body(here: Path) -> None:
    turned = _ASIDE.replace("Sphere", "Capsule").replace(
        'uniform token[] xformOpOrder = ["', 'double3 xformOp:rotateXYZ = (10, 20, 30)\n'
        'uniform token[] xformOpOrder = ["xformOp:rotateXYZ", "'
    )  # fmt: skip
    inside = "float3 physics:diagonalInertia = (1, 1, 1.5)\n" + turned
    (body,) = read(here, rigid("rod", "(0, 0, 0)", inside=inside)).scene.bodies

    assert body.inertia is not None
    assert body.inertia.moments == pytest.approx((1, 1, 1.5))
    assert body.inertia.products == pytest.approx((0, 0, 0))


def test_a_body_without_shapes_has_what_is_stated(here: Path) -> None:
    """Values that are blocked are not stated."""
    centre = "float physics:mass = 2\npoint3f physics:centerOfMass = (0.25, 0, 0)\n"
    blocked = "point3f physics:centerOfMass = None\nquatf physics:principalAxes = None\n"
    moments = "float3 physics:diagonalInertia = (1, 2, 2.5)\n" + blocked
    bodies = (
        rigid("a", "(0, 0, 0)", inside=centre),
        rigid("b", "(0, 0, 0)", inside=moments),
    )
    first, second = (body.inertia for body in read(here, *bodies).scene.bodies)

    assert first is not None
    assert second is not None
    assert (first.mass, first.com) == (2, (0.25, 0, 0))
    assert second.moments == (1, 2, 2.5)


def test_without_a_scene_gravity_is_its_default(here: Path) -> None:
    (here / "model.usda").write_text(HEAD.format(0.01, 1, "Y") + rigid("rod", "(0, 0, 0)"))
    imported = read_model(here / "model.usda")

    assert imported.scene.gravity == pytest.approx((0, 0, -9.81))
    (fate,) = (fate for fate in imported.fates if fate.element == "PhysicsScene")
    assert fate.outcome == "approximated"


def test_gravity_of_several_scenes_is_that_of_the_first(here: Path) -> None:
    other = 'def PhysicsScene "other"\n{\nfloat physics:gravityMagnitude = 3\n}\n'
    imported = read(here, other, rigid("rod", "(0, 0, 0)"))

    assert imported.scene.gravity == pytest.approx((0, 0, -9.81), abs=1e-6)
    (fate,) = (fate for fate in imported.fates if fate.outcome == "approximated")
    assert (fate.element, fate.moves) == ("PhysicsScene", True)


_MESH = 'def Mesh "shell" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'
_POINT = (
    'float physics:mass = 1\ndef Sphere "point" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n'
    "{\ndouble radius = 0\n}\n"
)
_BAD = {
    "text": ("#usda 1.0\ndef {", "model.usda:2:1: parse error matching"),
    "place": (rigid("rod", "(nan, 2, 3)"), "position of 'rod': got [nan, "),
    "size": (rigid("rod", "(0, 0, 0)", inside=_POINT), "inertia of 'rod': got [nan, "),
    "units": (
        HEAD.format(0, 1, "Z") + rigid("rod", "(1, 2, 3)"),
        "metersPerUnit: got 0.0, allow",
    ),
    "apart": (
        rigid("rod", "(1, 2, 3)") + joined("Revolute", "hip", ("", "rod")),
        "'hip' differ as bodies are placed: got 3.74 m between",
    ),
    "twisted": (
        rigid("rod", "(0, 0, 0)", "(0.8, 0.6, 0, 0)") + joined("Fixed", "weld", ("", "rod")),
        "got 0 m between origins and 1.7",
    ),
    "reversed": (
        rigid("rod", "(0, 0, 0)", "(0, 0, 1, 0)") + joined("Revolute", "hip", ("", "rod")),
        "got 0 m between origins and 2 between axes",
    ),
    "offset": (
        rigid("rod", "(1, 0.5, 0)") + general(("transX", 0, 1)),
        "'general' differ as bodies are placed: got 0.5 m between",
    ),
    "tilted": (
        rigid("rod", "(1, 0, 0)", "(0.8, 0.6, 0, 0)") + general(("transX", 0, 1)),
        "got 0 m between origins and 1.",
    ),
    "turned": (
        rigid("rod", "(0, 0, 0)", "(0.8, 0.6, 0, 0)")
        + general(("rotX", -90, 90), ("rotY", -90, 90)),
        "got 0 m between origins and 1.",
    ),
    "no body": (
        rigid("rod", "(1, 2, 3)") + joined("Revolute", "hip", ("gone", "rod"), PLACE),
        "the joint /hip holds /gone, which is not there",
    ),
    "inactive": (
        'def "off" (active = false)\n{\n}\n'
        + rigid("rod", "(1, 2, 3)")
        + joined("Distance", "rope", ("off", "rod")),
        "the joint /rope holds /off, which is not there",
    ),
    "unknown centre": (
        rigid("rod", "(0, 0, 0)", inside=_STATED + _MESH),
        "depends on the mesh /rod/shell; state its mass",
    ),
    "mesh": (
        rigid("rod", "(0, 0, 0)", inside=_MESH),
        "state its mass, diagonalInertia and centerOf",
    ),
    "reference": ('def "a" (references = @gone.usda@)\n{\n}\n', "'gone.usda', which is not there"),
    "outside": ('def "a" (references = @../outside.usda@)\n{\n}\n', "import` a --folder"),
    "mirrored": (
        f'def Xform "a"\n{{\ndouble3 xformOp:scale = (1, -1, 1)\nuniform token[] xformOpOrder = '
        f'["xformOp:scale"]\n{rigid("rod", "(0, 0, 0)")}}}\n',
        "the frame of /a/rod is mirrored or sheared by scales",
    ),
    "nothing": ('def Xform "a"\n{\n}\n', "nothing in it moves"),
}


@pytest.mark.parametrize("name", _BAD)
def test_a_bad_stage_is_one_line(name: str, run: CommandLine, here: Path) -> None:
    text, part = _BAD[name]
    head = "" if text.startswith("#") else HEAD.format(1, 1, "Z")
    (here / "model.usda").write_text(head + text)
    (here.parent / "outside.usda").write_text("#usda 1.0\n")

    refusal = run("import", "model.usda").refusal

    assert refusal.startswith("mbds-xsim: model.usda: ")
    assert part in refusal


def test_inertia_without_mass_stays_where_it_is() -> None:
    mass: Any = importlib.import_module("mbds_xsim_adapters.models.parts").Mass
    nothing = mass(0.0, np.zeros(3), np.zeros((3, 3)))
    wheel = mass(0.0, np.array([1.0, 0.0, 1.0]), np.eye(3))

    for both in (nothing + wheel, wheel + nothing):
        np.testing.assert_array_equal(both.com, wheel.com)
        np.testing.assert_array_equal(both.inertia, wheel.inertia)

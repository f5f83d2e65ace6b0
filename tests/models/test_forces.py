"""Springs, dampers, actuators and equalities of MJCF are read as MuJoCo applies them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from mbds_xsim.scene.imported import Fate, Imported
from mbds_xsim.simulate.registry import read_model

mujoco = pytest.importorskip("mujoco")
fates_of: Any = importlib.import_module("mbds_xsim_adapters.models.fates").fates_of
pytestmark = pytest.mark.usefixtures("in_process")

_GEOM = '<geom type="sphere" size=".1" pos="0 0 -1"/>'


def _model(joint: str = "", *, site: str = "", option: str = "", rest: str = "") -> str:
    return (
        f"<mujoco>{option}<worldbody>"
        f'<body name="b"><joint name="j" axis="0 1 0" {joint}/>{_GEOM}'
        '<site name="p" pos="0 0 -1"/></body>'
        f'<body name="c" pos="2 0 0"><joint name="k" axis="0 1 0"/>{_GEOM}'
        f'<site name="q" pos="-2 0 -1" {site}/>'
        f'<site name="r" pos="0 0 -1"/></body></worldbody>{rest}</mujoco>'
    )


def _read(here: Path, text: str) -> Imported:
    (here / "model.xml").write_text(text)
    return read_model(here / "model.xml")


def _fates(imported: Imported, element: str) -> dict[tuple[str, ...], Fate]:
    return {fate.properties: fate for fate in imported.fates if fate.element == element}


@pytest.mark.parametrize(
    ("joint", "linear", "dropped"),
    [
        ('stiffness="0 2" damping="0 2"', (0, 0), ("stiffness", "damping")),
        ('stiffness="1 2 3" damping="4"', (1, 4), ("stiffness",)),
        ('stiffness="1" springyield="0.1"', (1, 0), ("springyield",)),
    ],
)
def test_only_the_linear_part_of_a_joints_force_is_kept(
    joint: str, linear: tuple[float, float], dropped: tuple[str, ...], here: Path
) -> None:
    imported = _read(here, _model(joint))

    read = imported.scene.joints[0]
    assert (read.stiffness, read.damping) == linear
    fates = [
        fate for fate in imported.fates if (fate.element, fate.outcome) == ("joint", "dropped")
    ]
    assert [(fate.properties, fate.moves, fate.places) for fate in fates] == [
        (dropped, True, ("j",))
    ]
    assert "none, or zero" not in {fate.reason for fate in imported.fates}


def test_only_the_linear_part_of_a_tendons_force_is_kept(here: Path) -> None:
    tendon = (
        '<tendon><spatial name="t" stiffness="5 6" damping="2 7" springlength="1">'
        '<site site="p"/><site site="r"/></spatial></tendon>'
    )
    imported = _read(here, _model(rest=tendon))

    (spring,) = imported.scene.springs
    assert (spring.stiffness, spring.damping) == (5, 2)
    fate = _fates(imported, "tendon")["stiffness", "damping"]
    assert (fate.outcome, fate.moves) == ("dropped", True)


@pytest.mark.parametrize("option", ["", '<option><flag actuation="disable"/></option>'])
def test_armature_and_damping_of_actuators_are_on_their_joint(option: str, here: Path) -> None:
    own = 'gear="3" armature="0.5" damping="2"'
    actuators = (
        f'<actuator><motor name="m" joint="j" {own}/><position kp="7" joint="j" {own}/>'
        f'<motor name="t" tendon="t" {own}/><motor name="d" joint="k" damping="1 2"/></actuator>'
        '<tendon><fixed name="t"><joint joint="k" coef="1"/></fixed></tendon>'
    )
    xml = _model('damping="1" armature="0.25"', option=option, rest=actuators)
    imported = _read(here, xml)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[0] = 2
    mujoco.mj_forward(model, data)
    matrix = np.zeros((2, 2))
    for k, unit in enumerate(np.eye(2)):
        mujoco.mj_mulM(model, data, matrix[k], unit)

    joint = imported.scene.joints[0]
    assert joint.damping == pytest.approx(-data.qfrc_passive[0] / 2)
    inertia = 4 / 3 * np.pi * 1000 * 0.1**3 * (1 + 0.4 * 0.1**2)
    assert joint.armature == pytest.approx(matrix[0, 0] - inertia)
    assert imported.scene.joints[1].damping == 1
    fates = [fate for fate in imported.fates if fate.element == "actuator" and fate.properties]
    assert {(fate.outcome, fate.properties, fate.places) for fate in fates} == {
        ("kept", ("armature", "damping"), ("m", "actuator 1")),
        ("kept", ("damping",), ("d",)),
        ("dropped", ("damping",), ("d",)),
        ("dropped", ("armature", "damping"), ("t",)),
    }


_LINE = '<tendon><spatial name="{}" stiffness="{}"><site site="p"/><site site="{}"/></spatial>'
_JOINTS = '<joint joint1="j" joint2="k"/><joint name="again" joint1="k" joint2="j"/>'


@pytest.mark.parametrize(
    ("rest", "outcome", "place"),
    [
        (_LINE.format("point", 5, "q") + "</tendon>", "dropped", "point"),
        (_LINE.format("push", -5, "r") + "</tendon>", "dropped", "push"),
        (f"<equality>{_JOINTS}</equality>", "dropped", "k follows j"),
        ('<equality><weld name="idle" active="false" body1="b"/></equality>', "kept", "idle"),
    ],
)
def test_what_no_scene_can_have_is_told(rest: str, outcome: str, place: str, here: Path) -> None:
    fates = _read(here, _model(rest=rest)).fates

    assert [f.outcome for f in fates if place in f.places] == [outcome]


def test_what_the_compiler_resolves_is_not_lost(here: Path) -> None:
    xml = _model(rest='<default><pid kp="2"/></default><asset/><contact/>')
    xml = xml.replace("<body", '<frame scale="2" scaling="geometry" massscale="3"><body', 1)
    xml = xml.replace("</worldbody>", "</frame></worldbody>")

    assert not [f for f in _read(here, xml).fates if "unknown" in f.reason]


def test_an_attribute_that_no_reader_knows_is_dropped() -> None:
    text = (
        '<mujoco><body name="b" pos="0 0 1" later="1"><joint axis="0 0 1" new="2"/></body></mujoco>'
    )
    dropped = {
        (fate.element, fate.properties): fate.reason
        for fate in fates_of(fromstring(text), {})
        if fate.outcome == "dropped"
    }
    assert dropped == {
        ("body", ("later",)): "unknown to this reader",
        ("joint", ("new",)): "unknown to this reader",
    }


def test_what_flags_switch_off_exerts_nothing(here: Path) -> None:
    rest = (
        '<tendon><spatial stiffness="5" damping="2" springlength="1">'
        '<site site="p"/><site site="r"/></spatial></tendon><actuator>'
        '<position name="off" kp="3" joint="j" group="1"/>'
        '<position name="on" kp="3" joint="k" ctrllimited="true" ctrlrange="1 2"/></actuator>'
    )
    flag = '<flag spring="disable" damper="disable" clampctrl="disable"/>'
    option = f'<option actuatorgroupdisable="1">{flag}</option>'
    imported = _read(here, _model(option=option, rest=rest))
    bare = _read(here, _model(rest=rest))

    assert not imported.scene.springs
    (servo,) = imported.scene.servos
    assert (servo.joint, servo.position) == ("k", (0.0,))
    assert [servo.position for servo in bare.scene.servos] == [(0.0,), (1.0,)]
    assert len(bare.scene.springs) == 1
    assert "switched off" in _fates(imported, "actuator")[()].reason


def test_what_has_no_name_is_not_taken_for_another_of_the_name_it_gets(here: Path) -> None:
    xml = _model(rest='<actuator><position joint="joint 1" kp="7"/></actuator>')
    xml = xml.replace('name="j"', 'name="joint 1"').replace('name="k"', "")

    scene = _read(here, xml).scene

    assert [joint.name for joint in scene.joints] == ["joint 1", "joint 1_"]
    assert scene.servos[0].joint == "joint 1"


_SERVO = '<position joint="j" kp="7" gear="2" ctrlrange=".5 1"/>'


@pytest.mark.parametrize(
    ("actuators", "law"),
    [
        ('<orientation site="p" refsite="r" kp="2"/>' + _SERVO, ("j", 28, 0, 0.25, None)),
        ('<pid tendon="t" velrange="-1 1"/>' + _SERVO, ("j", 28, 0, 0.25, None)),
        ('<pid joint="j" kp="8" kv="2" gear="2" posrange="1 2" velrange="1 2"/>',
         ("j", 32, 8, 0.625, None)),
        ('<pid joint="j" kp="8" kv="2" input="pos ff" posrange="1 2" ffrange="4 5"/>',
         ("j", 8, 2, 1.5, None)),
        ('<position joint="k" kp="7" gear="2"/><motor tendon="t"/><motor joint="k"/>',
         ("k", 28, 0, 0, 3)),
    ],
)  # fmt: skip
def test_an_actuator_is_a_servo_whatever_stands_beside_it(
    actuators: str, law: tuple[Any, ...], here: Path
) -> None:
    """Tendon 0 and joint 0 have nothing to do with each other, and motors share no limit."""
    tendon = '<tendon><spatial name="t"><site site="p"/><site site="r"/></spatial></tendon>'
    xml = _model(rest=f"{tendon}<actuator>{actuators}</actuator>")
    imported = _read(here, xml.replace('"k" axis', '"k" actuatorfrcrange="-3 3" axis'))

    servo = imported.scene.servos[-1]
    assert (servo.joint, servo.stiffness, servo.damping, *servo.position, servo.limit) == law


@pytest.mark.parametrize(
    ("actuator", "reason"),
    [
        ('<motor joint="k" ctrlrange="1 2"/>', "its command nearest to 0 is a push"),
        ('<position joint="k" kp="-3"/>', "it has a negative gain"),
    ],
)
def test_what_is_no_servo_is_dropped_with_its_reason(
    actuator: str, reason: str, here: Path
) -> None:
    imported = _read(here, _model(rest=f"<actuator>{actuator}</actuator>"))
    assert _fates(imported, "actuator")[()].reason.startswith(reason)


@pytest.mark.parametrize(
    ("equality", "site", "kinds"),
    [
        ('<weld site1="p" site2="q"/>', "", ["fixed"]),
        ('<weld site1="p" site2="q"/>', 'euler="0 40 0"', []),
        ('<weld site1="p" site2="q" torquescale="0"/>', 'euler="0 40 0"', ["ball"]),
        ('<weld body1="b" body2="c"/>', "", ["fixed"]),
        ('<weld body1="b" body2="c" torquescale="0"/>', "", ["ball"]),
        ('<weld body1="b" body2="c" relpose="2 0 0 0.9 0.1 0 0"/>', "", []),
        ('<weld body1="b" body2="c" relpose="2 0 0 0.9 0.1 0 0" torquescale="0"/>', "", ["ball"]),
        (2 * '<connect body1="b" body2="c" anchor="1 0 0"/>', "", ["ball"]),
        (3 * '<connect body1="b" body2="c" anchor="1 0 0"/>', "", ["ball"]),
        ('<connect body1="b" body2="c" anchor="1 0 0"/><connect body1="b" body2="c" '
         'anchor="1 1 0"/>', "", ["hinge"]),
    ],
)  # fmt: skip
def test_an_equality_holds_what_it_holds_in_mujoco(
    equality: str, site: str, kinds: list[str], here: Path
) -> None:
    imported = _read(here, _model(site=site, rest=f"<equality>{equality}</equality>"))

    assert [joint.kind for joint in imported.scene.joints[2:]] == kinds
    outcome = "approximated" if kinds else "dropped"
    assert {fate.outcome for fate in imported.fates if fate.element == "equality"} == {outcome}

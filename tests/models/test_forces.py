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
_POLYNOMIALS = pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "jnt_stiffnesspoly"), reason="this release has linear forces alone"
)


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


@_POLYNOMIALS
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


@_POLYNOMIALS
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


@pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "actuator_armature"), reason="actuators have no armature"
)
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

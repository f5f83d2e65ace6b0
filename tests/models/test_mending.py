"""Models that older programs and lax readers accept are read as they do, with a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Fate, Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("in_process")

_URDF = """<robot name="arm"><link name="world"/><link name="rod"><inertial>
<origin xyz="0.5 0 -0.1"/><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="revolute"><parent link="world"/><child link="rod"/>
<origin xyz="0 0 2" rpy="0 0.3 1"/><axis xyz="0 1 0"/><limit lower="-1.5" upper="1"/></joint>
</robot>"""
_HEAVY = '<inertial><mass value="0"/><inertia ixx="1" iyy="9" izz="1"/></inertial>'
_LAX = {
    "commas": ('"0.5 0 -0.1"', '"0.5, 0, -0.1"', "rod"),
    "a number too many": ('"0 0.3 1"', '"0 0.3 1 7"', "pivot: 0 0.3 1 7 read as 0 0.3 1"),
    "a dot too many": ('"-1.5"', '"-1.5."', "pivot: -1.5. read as -1.5"),
    "a default": ('"0 0 2"', '"$(optenv ARM_AT 0 0 2)"', "pivot: $(optenv"),
    "another axis": ("<limit", '<axis xyz="1 0 0"/><limit', "pivot"),
    "the same axis": ("<limit", '<axis xyz="0 1 0"/><limit', "pivot"),
    "a heavy world": ('<link name="world"/>', f'<link name="world">{_HEAVY}</link>', "world"),
}
_MJCF = """<mujoco model="arm"><compiler inertiafromgeom="true" angle="radian"/><asset>
<material name="blue" rgba="0 0 1 1"/></asset><default><geom density="500"/></default>
<worldbody><body name="arm"><geom name="arm" type="capsule" size=".1" fromto="0 0 0 1 0 0"/>
<joint name="pivot" axis="0 1 0" damping="3"/><body name="hand">
<geom size=".1" pos="1.2 0 0"/></body></body></worldbody></mujoco>"""
_OLD = {
    "unknown attribute": ('damping="3"', 'damping="3" bounce="1"', ("dropped", True)),
    "in two places": ('size=".1"', 'size=".1" shine="1"', ("dropped", True)),
    "no such material": ('name="arm" t', 'name="arm" material="gone" t', ("dropped", False)),
    "a fixed joint": (
        '<body name="hand">',
        '<body name="hand"><joint type="fixed"/>',
        ("kept", True),
    ),
    "inertia without a place": (
        '<body name="hand">',
        '<body name="hand"><inertial mass="9"/>',
        ("dropped", True),
    ),
    "a material twice": ("</asset>", '<material name="blue"/></asset>', ("dropped", False)),
}  # fmt: skip


_GLOBAL = """<mujoco model="leg"><compiler coordinate="global" inertiafromgeom="true"/><worldbody>
<body name="thigh" pos="9 0 0"><joint name="hip" axis="0 1 0" pos="0 0 1"/>
<geom type="capsule" size=".05" fromto="0 0 1 0 0 .5"/><body name="shank">
<joint name="knee" axis="0 1 0" pos="0 0 .5" ref="10"/>
<geom type="capsule" size=".04" fromto="0 0 .5 .1 0 0"/>
</body></body></worldbody></mujoco>"""
_LOCAL = """<mujoco model="leg"><compiler inertiafromgeom="true"/><worldbody>
<body name="thigh" pos="0 0 1"><joint name="hip" axis="0 1 0"/>
<geom type="capsule" size=".05" fromto="0 0 0 0 0 -.5"/><body name="shank" pos="0 0 -.5">
<joint name="knee" axis="0 1 0" ref="10"/><geom type="capsule" size=".04" fromto="0 0 0 .1 0 -.5"/>
</body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", _LAX)
def test_a_lax_urdf_is_the_plain_one(name: str, here: Path) -> None:
    plain, lax, place = _LAX[name]

    fate = _mend(here, "arm.urdf", _URDF, _URDF.replace(plain, lax))

    alike = name in ("the same axis", "a heavy world")
    assert (fate.outcome, fate.moves) == ("kept" if alike else "approximated", True)
    assert fate.places[0].startswith(place)


@pytest.mark.parametrize("name", _OLD)
def test_an_old_mjcf_is_the_plain_one(name: str, here: Path) -> None:
    plain, old, expected = _OLD[name]

    fate = _mend(here, "arm.xml", _MJCF, _MJCF.replace(plain, old))

    assert (fate.outcome, fate.moves) == expected
    assert fate.count == _MJCF.count(plain)


def test_what_is_unknown_in_one_place_is_kept_where_it_is_known(here: Path) -> None:
    hand = _MJCF.replace('name="hand">', 'name="hand"><joint name="wrist" axis="0 1 0"/>')
    tie = '<equality><joint joint1="wrist" joint2="pivot" damping="5"/></equality></mujoco>'
    scene = _read(here, "arm.xml", hand.replace("</mujoco>", tie)).scene

    assert [joint.damping for joint in scene.joints] == [3, 0]
    assert [each.name for each in scene.couplings] == ["wrist follows pivot"]


def test_places_in_w_are_those_in_the_bodies_frames(here: Path) -> None:
    old, local = (_read(here, "leg.xml", text).scene for text in (_GLOBAL, _LOCAL))

    first, second = Mechanism.of(old), Mechanism.of(local)
    np.testing.assert_allclose(first.mass, second.mass, rtol=1e-12)
    np.testing.assert_allclose(first.com, second.com, atol=1e-12)
    np.testing.assert_allclose(first.inertia, second.inertia, atol=1e-12)
    np.testing.assert_allclose(
        [joint.anchor for joint in old.joints], [joint.anchor for joint in local.joints], atol=1e-12
    )


_TIP = """<link name="tip"/><joint name="knee" type="continuous">
<parent link="rod"/><child link="tip"/></joint></robot>"""
_FOOT = '><collision><geometry><sphere radius="0.1"/></geometry></collision></link>'


@pytest.mark.parametrize(
    ("plain", "more", "place", "reason"),
    [
        ("</robot>", _TIP, "tip, with its joint 'knee'", "it has no mass (in URDF: no <inertial>)"),
        ("</joint>", '<mimic joint="clop"/></joint>', "pivot", "no joint is called 'clop'"),
    ],
)
def test_what_is_left_out_is_told_with_its_cause(
    plain: str, more: str, place: str, reason: str, here: Path
) -> None:
    fate = _mend(here, "arm.urdf", _URDF, _URDF.replace(plain, more))

    assert (fate.outcome, fate.moves, fate.places) == ("dropped", True, (place,))
    assert fate.reason.startswith(reason)


def test_a_negative_inertia_is_not_called_none(here: Path) -> None:
    negative = _URDF.replace('ixx="1" iyy="1" izz="1"', 'ixx="-1" iyy="-1" izz="-1"')
    fates = _read(here, "arm.urdf", negative).fates
    (fate,) = (fate for fate in fates if fate.outcome == "approximated")

    assert fate.reason.startswith("mass with negative inertia: it gets 1e-06 of its mass times")


def test_shapes_of_what_has_no_mass_touch_no_ground(here: Path) -> None:
    (here / "arm.urdf").write_text(_URDF.replace("</robot>", _TIP.replace("/>", _FOOT, 1)))
    with pytest.raises(InputError, match=r"touch the ground \(its body has no mass"):
        read_model(here / "arm.urdf", ground=True)


def test_what_floats_on_the_root_floats_in_the_world(here: Path) -> None:
    free = _URDF.replace("revolute", "floating")
    plain, root = (_read(here, "arm.urdf", text) for text in (free, free.replace("world", "base")))

    assert root.scene == plain.scene
    assert len(Mechanism.of(root.scene).joints) == 0


def test_extensions_may_have_as_many_numbers_as_they_like(here: Path) -> None:
    extended = _URDF.replace("<limit", '<fdir1 value="1 0 0"/><limit')

    (fate,) = (f for f in _read(here, "arm.urdf", extended).fates if f.element == "fdir1")

    assert (fate.outcome, fate.properties) == ("dropped", ("value",))


def test_what_no_mend_makes_plain_is_refused_as_it_was(here: Path) -> None:
    turned = _GLOBAL.replace('pos="9 0 0"', 'euler="0 90 0"')

    with pytest.raises(InputError, match="global coordinates"):
        _read(here, "leg.xml", turned)
    with pytest.raises(InputError, match="bad format in attribute 'xyz'"):
        _read(here, "arm.urdf", _URDF.replace('"0 0 2"', '"0 0 two"'))


def _mend(here: Path, name: str, plain: str, lax: str) -> Fate:
    """Assert that both texts are the same scene, and return the fate that only `lax` has."""
    assert lax != plain
    sound, mended = _read(here, name, plain), _read(here, name, lax)
    assert mended.scene == sound.scene
    known = {fate.reason for fate in sound.fates}
    (own,) = (fate for fate in mended.fates if fate.reason not in known)
    return own


def _read(here: Path, name: str, text: str) -> Imported:
    (here / name).write_text(text)
    return read_model(here / name)

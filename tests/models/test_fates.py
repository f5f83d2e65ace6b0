"""Reports on losses name what affects the motion, and nothing else, as lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbds_xsim.simulate.registry import read_model

pytestmark = pytest.mark.usefixtures("in_process")

_MASS = (
    '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)
_URDF = f"""<robot name="arm" xmlns="http://www.ros.org" xmlns:xi="http://www.w3.org/2001/XInclude">
<mujoco><compiler balanceinertia="true" meshdir="../meshes"/><size nstack="3"/></mujoco>
<link name="base"/><link name="rod">{_MASS}</link><joint name="pivot" type="continuous">
<parent link="base"/><child link="rod"/><origin/><limit/><dynamics/></joint></robot>"""
_SDF = """<sdf version="1.6" xmlns:xacro="http://www.ros.org/wiki/xacro"><world name="w">
<gravity>0 0 -9.8</gravity><atmosphere type="adiabatic"/><magnetic_field>1 0 0</magnetic_field>
<spherical_coordinates><surface_model>EARTH_WGS84</surface_model></spherical_coordinates>
<model name="m"><allow_auto_disable>1</allow_auto_disable><link name="rod"><inertial><mass>1</mass>
<inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial><enable_wind>0</enable_wind>
<kinematic>0</kinematic><velocity_decay><linear>0.0</linear><angular>0</angular></velocity_decay>
<must_be_base_link>1</must_be_base_link></link><joint name="pivot" type="revolute">
<parent>world</parent><child>rod</child><axis><xyz>1 0 0</xyz><limit/><dynamics/></axis></joint>
</model></world></sdf>"""


@pytest.mark.parametrize(
    ("library", "name", "text"), [("mujoco", "arm.urdf", _URDF), ("dartpy", "arm.sdf", _SDF)]
)
def test_what_bears_on_no_motion_is_not_told_as_lost(
    library: str, name: str, text: str, here: Path
) -> None:
    pytest.importorskip(library)
    (here / name).write_text(text)

    imported = read_model(here / name)

    assert not [fate for fate in imported.fates if fate.moves and fate.outcome != "kept"]
    assert len(imported.scene.joints) == 1


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("<model", "<wind><linear_velocity>1 0 0</linear_velocity></wind><model"),
        ("<kinematic>0", "<kinematic>1"),
        ("<angular>0", "<angular>0.05"),
    ],
)
def test_what_sdf_moves_by_other_means_is_told_as_lost(place: str, text: str, here: Path) -> None:
    pytest.importorskip("dartpy")
    (here / "arm.sdf").write_text(_SDF.replace(place, text))

    lost = [fate for fate in read_model(here / "arm.sdf").fates if fate.outcome == "dropped"]

    assert [fate.moves for fate in lost].count(True) == 1

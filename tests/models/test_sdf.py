"""SDF is read with poses, masses and axes as its specification defines them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model
from tests.command_line import CommandLine

pytest.importorskip("dartpy")

_INERTIA = (
    "<inertial><pose>0.1 0.2 0.3 0 0 {}</pose><mass>2</mass><inertia><ixx>1</ixx><iyy>2</iyy>"
    "<izz>2.5</izz><ixy>0.1</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
)
_ARM = (
    '<link name="arm"><pose>1 2 3 0 0 0.5</pose>' + _INERTIA.format(0.3) + "{}</link>"
    '<joint name="pivot" type="{}"><parent>world</parent><child>arm</child>'
    "<pose>0 0 1 0 0 0.2</pose><axis><xyz>1 0 0</xyz>{}</axis></joint>"
)


def _read(here: Path, inside: str, version: str = "1.6", name: str = "model.sdf") -> Imported:
    text = f'<sdf version="{version}"><model name="robot">{inside}</model></sdf>'
    (here / name).write_text(text)
    return read_model(here / name)


def test_a_link_has_the_inertia_that_is_stated_in_its_poses(here: Path) -> None:
    scene = _read(here, _ARM.format("", "revolute", "")).scene

    mechanism = Mechanism.of(scene)
    link, inertial = (
        rotation.matrix(rotation.from_vector(np.array([0, 0, a]))) for a in (0.5, 0.8)
    )
    stated = np.array([[1, 0.1, 0], [0.1, 2, 0], [0, 0, 2.5]])
    np.testing.assert_allclose(mechanism.inertia[0], inertial @ stated @ inertial.T, atol=1e-12)
    place = np.array([1, 2, 3]) + link @ [0.1, 0.2, 0.3]
    np.testing.assert_allclose(mechanism.com[0], place, atol=1e-12)
    np.testing.assert_allclose(scene.joints[0].anchor, [1, 2, 4], atol=1e-12)
    np.testing.assert_allclose(
        scene.joints[0].axis or (), [np.cos(0.7), np.sin(0.7), 0], atol=1e-12
    )


def test_an_axis_may_be_in_the_frame_of_the_model(here: Path) -> None:
    frame = "<use_parent_model_frame>1</use_parent_model_frame>"
    scene = _read(here, _ARM.format("", "prismatic", frame)).scene

    assert scene.joints[0].kind == "slider"
    np.testing.assert_allclose(scene.joints[0].axis or (), [1, 0, 0], atol=1e-12)


def test_what_is_lost_is_named(here: Path) -> None:
    limit = "<limit><lower>-1</lower><upper>2</upper></limit>"
    more = f"<dynamics><damping>0.4</damping></dynamics>{limit}"
    mesh = "<collision name='c'><geometry><mesh><uri>gone.stl</uri></mesh></geometry></collision>"
    imported = _read(here, _ARM.format(mesh + "<spring>3</spring>", "revolute", more))

    lost = {fate.element: fate for fate in imported.fates if fate.outcome == "dropped"}
    assert {"collision", "spring"} <= lost.keys()
    places = {fate.element: fate.places for fate in imported.fates}
    assert places["damping"] == ("pivot: 0.4",)
    assert places["lower"] == ("pivot: -1 to 2",)
    assert imported.facts.joints[0].limits == (-1, 2)


def test_a_mass_is_that_of_the_file_however_small(here: Path) -> None:
    """DART's parser would raise such a mass to 1e-9 kg."""
    light = _ARM.format("", "revolute", "").replace("<mass>2", "<mass>1e-12")
    base = "<static>1</static>" + _ARM.format("", "fixed", "").replace("<mass>2", "<mass>0")
    models = f'<model name="a">{light}</model><model name="b">{base}</model>'
    (here / "model.sdf").write_text(f'<sdf version="1.7"><world name="w">{models}</world></sdf>')

    (body,) = read_model(here / "model.sdf").scene.bodies

    assert body.inertia is not None
    assert body.inertia.mass == 1e-12


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_limits_that_are_upside_down_are_dropped(kind: str, here: Path) -> None:
    limit = "<limit><lower>1</lower><upper>-1</upper></limit>"
    imported = _read(here, _ARM.format("", kind, limit))

    assert imported.scene.joints[0].limits is None
    (entry,) = (fate for fate in imported.fates if fate.element == "lower")
    assert (entry.outcome, entry.reason) == ("dropped", "the lower one is not below the upper one")
    assert entry.places == ("pivot: 1 to -1",)


def test_gravity_is_that_of_the_world(here: Path) -> None:
    """DART's parser ignores it; links without gravity are reported."""
    model = (
        '<model name="robot">' + _ARM.format("<gravity>0</gravity>", "revolute", "") + "</model>"
    )
    text = f'<sdf version="1.7"><world name="w"><gravity>1 2 -3</gravity>{model}</world></sdf>'
    (here / "model.sdf").write_text(text)

    imported = read_model(here / "model.sdf")

    assert imported.scene.gravity == (1.0, 2.0, -3.0)
    outcomes = {(fate.element, fate.outcome) for fate in imported.fates}
    assert {("gravity", "kept"), ("link/gravity", "dropped")} <= outcomes


@pytest.mark.parametrize(
    ("inside", "down"), [("", 9.8), ("<physics><gravity>0 0 -1</gravity></physics>", 1)]
)
def test_gravity_that_no_world_states_is_the_specifications(
    inside: str, down: float, here: Path
) -> None:
    model = '<model name="robot">' + _ARM.format("", "revolute", "") + "</model>"
    (here / "model.sdf").write_text(
        f'<sdf version="1.6"><world name="w">{inside}{model}</world></sdf>'
    )

    imported = read_model(here / "model.sdf")

    assert imported.scene.gravity == pytest.approx((0, 0, -down))
    told = [f.outcome for f in imported.fates if (f.element, f.properties) == ("gravity", ())]
    assert told == (["approximated"] if not inside else [])


def test_a_pose_may_say_what_holds_anyway(here: Path) -> None:
    said = '<pose degrees="false" rotation_format="euler_rpy">1 2'
    sound, plain = (_read(here, text) for text in (_SOUND.replace("<pose>1 2", said), _SOUND))

    assert sound.scene == plain.scene
    assert not [fate for fate in sound.fates if "unknown" in fate.reason]


def test_a_continuous_joint_is_a_hinge_without_limits(here: Path) -> None:
    """DART does not know the type, and reads nothing that hangs on such a joint."""
    limit = "<limit><lower>-1</lower><upper>2</upper></limit>"
    (joint,) = _read(here, _ARM.format("", "continuous", limit)).scene.joints

    assert (joint.kind, joint.limits) == ("hinge", None)


_MIMIC = (
    "<mimic {}><multiplier>2</multiplier><offset>0.1</offset><reference>0.2</reference></mimic>"
)


def _led(kind: str, how: str) -> str:
    """Return a joint, and one that follows it."""
    first = _ARM.format("", kind, "").replace("</axis>", "</axis><axis2><xyz>0 1 0</xyz></axis2>")
    second = _ARM.replace("arm", "hand").replace("pivot", "clip")
    return first + second.format("", "revolute", _MIMIC.format(how))


@pytest.mark.parametrize(
    ("kind", "how", "leader"),
    [
        ("revolute", 'joint="pivot"', "pivot"),
        ("universal", 'joint="pivot"', "pivot 1"),
        ("universal", 'joint="pivot" axis="axis2"', "pivot 2"),
    ],
)
def test_a_joint_follows_another(here: Path, kind: str, how: str, leader: str) -> None:
    imported = _read(here, _led(kind, how), "1.11")

    (coupling,) = imported.scene.couplings
    assert (coupling.joint, coupling.follows, coupling.ratio) == ("clip", leader, 2.0)
    assert coupling.offset == pytest.approx(0.1 - 2 * 0.2)
    (fate,) = (fate for fate in imported.fates if fate.element == "mimic")
    assert (fate.outcome, fate.places) == ("kept", (f"clip follows {leader}",))
    assert imported.facts.couplings == 1


@pytest.mark.parametrize(
    ("kind", "how"),
    [("ball", 'joint="pivot"'), ("revolute", ""), ("revolute", 'joint="pivot" axis="axis2"')],
)
def test_a_mimic_of_nothing_is_dropped_by_name(here: Path, kind: str, how: str) -> None:
    imported = _read(here, _led(kind, how), "1.11")

    (fate,) = (fate for fate in imported.fates if fate.element == "mimic")
    assert (fate.outcome, fate.places) == ("dropped", ("clip",))
    assert not imported.scene.couplings


@pytest.mark.parametrize(("other", "count"), [("revolute", 2), ("ball", 1)])
def test_a_mimic_of_joints_whose_names_two_models_have_is_dropped(
    here: Path, other: str, count: int
) -> None:
    first, second = _led("revolute", 'joint="pivot"'), _ARM.format("", other, "")
    inside = {"a": first, "b": first if other == "revolute" else second}
    models = "".join(f'<model name="{name}">{text}</model>' for name, text in inside.items())
    (here / "model.sdf").write_text(f'<sdf version="1.11"><world name="w">{models}</world></sdf>')

    imported = read_model(here / "model.sdf")

    assert not imported.scene.couplings
    (fate,) = (fate for fate in imported.fates if fate.element == "mimic")
    assert (fate.outcome, fate.places, fate.count) == ("dropped", ("clip",), count)


@pytest.mark.parametrize(
    ("place", "kept"), [("</axis>", 1), ("</joint>", 0)], ids=["twice", "in a joint"]
)
def test_a_mimic_that_nothing_reads_is_told(here: Path, place: str, kept: int) -> None:
    more = '<mimic joint="other"/>'
    start, _, end = _led("revolute", 'joint="pivot"' if kept else "").rpartition(place)
    imported = _read(here, f"{start}{more}{place}{end}", "1.11")

    assert len(imported.scene.couplings) == kept
    unknown = [fate for fate in imported.fates if fate.properties == ("joint",)]
    assert [(fate.element, fate.outcome) for fate in unknown] == [("mimic", "dropped")]


@pytest.mark.parametrize(
    ("kind", "limit", "span"),
    [
        ("revolute", "<lower>0</lower>", (0.0, 1e9)),
        ("prismatic", "<lower>0</lower><upper>1e16</upper>", (0.0, 1e9)),
        ("revolute", "<lower>-inf</lower><upper>0.5</upper>", (-1e9, 0.5)),
        ("revolute", "<lower>-1e16</lower><upper>1e16</upper>", None),
    ],
)
def test_a_limit_on_one_side_is_kept(
    here: Path, kind: str, limit: str, span: tuple[float, float] | None
) -> None:
    (joint,) = _read(here, _ARM.format("", kind, f"<limit>{limit}</limit>")).scene.joints

    assert joint.limits == span


@pytest.mark.parametrize(
    ("inertial", "mass", "moments", "told"),
    [
        ("<mass>2</mass><inertia><ixx>1</ixx><iyy>2</iyy><izz>2.5</izz></inertia>",
         2, (1, 2, 2.5), set()),
        ("<mass>2</mass>", 2, (1, 1, 1), {"inertia"}),
        ("<inertia><ixx>1</ixx><iyy>2</iyy><izz>2.5</izz></inertia>", 1, (1, 2, 2.5), {"mass"}),
    ],
)  # fmt: skip
def test_defaults_are_those_of_the_specification(
    here: Path, inertial: str, mass: float, moments: tuple[float, ...], told: set[str]
) -> None:
    imported = _read(
        here,
        f'<link name="arm"><inertial><pose>0.1 0.2 0.3 0 0 0</pose>{inertial}</inertial></link>'
        '<joint name="pivot" type="revolute"><parent>world</parent><child>arm</child><axis/>'
        "</joint>",
    )

    (body,), (joint,) = imported.scene.bodies, imported.scene.joints
    assert body.inertia is not None
    assert (body.inertia.mass, *body.inertia.moments) == (mass, *moments)
    assert body.inertia.com == pytest.approx((0.1, 0.2, 0.3))
    assert joint.axis == pytest.approx((0, 0, 1))
    assert {fate.element for fate in imported.fates if fate.outcome != "kept"} == told


def test_a_density_beside_stated_masses_counts_for_nothing(here: Path) -> None:
    sound = _ARM.format("", "revolute", "")
    dense = sound.replace("</mass>", "</mass><density>9</density>", 1)

    assert _read(here, dense).scene.bodies == _read(here, sound).scene.bodies


def test_a_joint_between_models_is_refused(run: CommandLine, here: Path) -> None:
    models = f'<model name="a">{_SOUND}</model><joint name="weld" type="fixed"/>'
    (here / "model.sdf").write_text(f'<sdf version="1.10"><world name="w">{models}</world></sdf>')

    assert "<world> has a <joint> 'weld'" in run("import", "model.sdf").refusal


def test_names_of_links_may_stand_between_spaces(here: Path) -> None:
    hand = _ARM.replace("arm", "hand").replace("pivot", "wrist").replace("world", "arm")
    both = (_ARM + hand).replace("arm</", "\n arm </")
    joints = _read(here, both.format(*2 * ("", "revolute", ""))).scene.joints

    assert [(joint.parent, joint.child) for joint in joints] == [("world", "arm"), ("arm", "hand")]
    (joint,) = _read(here, _ARM.replace("arm", " arm").format("", "revolute", "")).scene.joints
    assert joint.child == " arm"


_SOUND = _ARM.format("", "revolute", "")
_BAD = {
    "mass": (_SOUND.replace("<mass>2", "<mass>-1"), "<mass> of <link> 'arm' is -1, allowed is ab"),
    "no mass": (_SOUND.replace("<mass>2", "<mass>0"), "<mass> of <link> 'arm' is 0, allowed is ab"),
    "mass nan": (_SOUND.replace("<mass>2", "<mass>nan"), "'arm' is 'nan', allowed is a number"),
    "moment": (_SOUND.replace("<ixx>1", "<ixx>inf"), "<ixx> of <link> 'arm' is 'inf', allowed is"),
    "pose": (f"<pose>nan 0 1 0 0 0</pose>{_SOUND}", "<pose> of <model> 'robot' is 'nan 0 1 0 0 0'"),
    "place": (_SOUND.replace("<pose>0.1 0.2", "<pose>inf 0"), "<pose> of <link> 'arm' is 'inf 0 "),
    "twice": (f'<link name="arm"/>{_SOUND}', "'robot' has two links called 'arm', allowed is one"),
    "turned": (_SOUND.replace("1 0 0</xyz>", "nan 0 0</xyz>"), "<xyz> of <joint> 'pivot' is 'nan"),
    "damper": (_ARM.format("", "revolute", "<dynamics><damping>inf</damping></dynamics>"),
               "<damping> of <joint> 'pivot' is 'inf', allowed is a number"),
    "no axis": (_SOUND.replace("axis>", "gone>"), "'pivot' is revolute and has no <axis>, which"),
    "stop": (_ARM.format("", "revolute", "<limit><lower>-1,5</lower></limit>"),
             "<lower> of <joint> 'pivot' is '-1,5', allowed is a number"),
    "pusher": (_ARM.format("", "revolute", "<dynamics><damping>-1</damping></dynamics>"),
               "<damping> of <joint> 'pivot' is -1, allowed is 0 or more"),
    "leader": (_ARM.format("", "revolute", "<mimic><multiplier>two</multiplier></mimic>"),
               "<multiplier> of <joint> 'pivot' is 'two', allowed is a number"),
    "axis": (_SOUND.replace("1 0 0</xyz>", "0 0 0</xyz>"), "joint 'pivot': axis: got [0.0, 0.0, 0"),
    "frames": (_ARM.format("", "revolute", "").replace("<pose>1", '<pose relative_to="b">1'),
               "does not read (relative_to=)"),
    "automatic": (_SOUND.replace("<inertial>", '<inertial auto="true">'), 'has auto="true", but'),
    "include": ("<include><uri>model://a</uri></include>", "does not read (include)"),
    "nested": ('<model name="b"/>', "a model in a model"),
    "misplaced": ('<link name="rod"><model><mass>2</mass></model></link>', "a model in a link"),
    "gears": (_ARM.format("", "gearbox", ""), "leaves out the link 'arm'"),
    "screw": (_ARM.format("", "screw", ""), "ScrewJoint"),
    "nothing": (_ARM.format("", "fixed", ""), "nothing in it moves"),
    "parent": (_SOUND.replace(">world<", ">base<"), "of <joint> 'pivot' is 'base', allowed is a l"),
    "no parent": (_SOUND.replace("parent>", "gone>"), "<parent> of <joint> 'pivot' is '', allowed"),
    "itself": (_SOUND.replace(">world<", ">arm<"), "hold links in a circle: 'arm', 'arm'; let one"),
    "joint twice": (f'{_SOUND}<joint name="pivot"/>', "two joints called 'pivot', allowed is one"),
    "old": (None, "version 1.4"),
}  # fmt: skip


@pytest.mark.parametrize("name", _BAD)
def test_a_bad_file_is_one_line(name: str, run: CommandLine, here: Path) -> None:
    inside, part = _BAD[name]
    version = "1.6" if inside else "1.4"
    inside = inside or _ARM.format("", "revolute", "")
    text = f'<sdf version="{version}"><model name="robot">{inside}</model></sdf>'
    (here / "model.sdf").write_text(text)

    refusal = run("import", "model.sdf").refusal

    assert refusal.startswith("mbds-xsim: model.sdf: ")
    assert part in refusal

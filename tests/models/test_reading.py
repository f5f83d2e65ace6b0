"""Models of other formats are read as their formats say, and losses are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.reference import solve
from mbds_xsim.scene.imported import Fate, Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.simulate.registry import read_model

mujoco = pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("in_process")

_LAW = 'damping="0.7" stiffness="30" springref="20" ref="5"'
_SECOND = (('<link name="rod"', "<joint"), ("<joint", "</robot>"))
_INERTIA = '<inertia ixx="{}" iyy="{}" izz="{}" ixy="{}" ixz="{}" iyz="{}"/>'


def _read(here: Path, text: str, name: str = "model.xml", **options: Any) -> Imported:
    (here / name).write_text(text)
    return read_model(here / name, **options)


def _urdf(inertial: str, rest: str = "") -> str:
    return (
        '<robot name="arm"><link name="base"/><link name="rod"><inertial>'
        f'{inertial}</inertial></link><joint name="pivot" type="continuous">'
        '<parent link="base"/><child link="rod"/><origin xyz="0 0 2" rpy="0 0 1.2"/>'
        f'<axis xyz="0 1 0"/></joint>{rest}</robot>'
    )


def _fates(imported: Imported, outcome: str, moves: bool = True) -> dict[str, Fate]:
    chosen = (f for f in imported.fates if f.outcome == outcome and f.moves == moves)
    return {" ".join((fate.element, *fate.properties)): fate for fate in chosen}


def test_a_box_on_a_hinge_has_the_inertia_of_a_box(here: Path) -> None:
    scene = _read(
        here,
        '<mujoco><compiler angle="degree"/><worldbody><body pos="0 0 3" euler="0 90 0">'
        '<joint type="hinge" axis="1 0 0" pos="0 0 .5"/>'
        '<geom type="box" size=".1 .2 .3" mass="6" pos="0 0 -1"/></body></worldbody></mujoco>',
    ).scene

    mechanism = Mechanism.of(scene)
    moments = [2 * (0.2**2 + 0.3**2), 2 * (0.1**2 + 0.3**2), 2 * (0.1**2 + 0.2**2)]
    # A quarter turn about y takes the body's x to −z and its z to x.
    np.testing.assert_allclose(mechanism.inertia[0], np.diag(moments[::-1]), atol=1e-12)
    np.testing.assert_allclose(mechanism.com[0], [-1, 0, 3], atol=1e-12)
    np.testing.assert_allclose(scene.joints[0].axis or (), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(scene.joints[0].anchor, [0.5, 0, 3], atol=1e-12)


@pytest.mark.parametrize(("stated", "name"), [('model="cart"', "cart"), ("", "model")])
def test_a_model_without_a_name_has_that_of_its_file(stated: str, name: str, here: Path) -> None:
    body = '<body><joint/><geom size=".1"/></body>'
    scene = _read(here, f"<mujoco {stated}><worldbody>{body}</worldbody></mujoco>").scene

    assert scene.name == name


def test_a_link_has_the_inertia_that_its_urdf_states(here: Path) -> None:
    inertial = '<origin xyz="1 0 0" rpy="0 0 0.3"/><mass value="2"/>'
    scene = _read(here, _urdf(inertial + _INERTIA.format(1, 2, 2.5, 0.1, 0, 0)), "arm.urdf").scene

    mechanism = Mechanism.of(scene)
    turn = rotation.matrix(rotation.from_vector(np.array([0, 0, 1.5])))
    stated = np.array([[1, 0.1, 0], [0.1, 2, 0], [0, 0, 2.5]])
    np.testing.assert_allclose(mechanism.inertia[0], turn @ stated @ turn.T, atol=1e-12)
    np.testing.assert_allclose(mechanism.com[0], [np.cos(1.2), np.sin(1.2), 2], atol=1e-12)
    np.testing.assert_allclose(
        scene.joints[0].axis or (), [-np.sin(1.2), np.cos(1.2), 0], atol=1e-12
    )
    assert scene.joints[0].anchor == (0, 0, 2)


@pytest.mark.parametrize("floating", [False, True])
def test_links_without_inertial_have_no_mass(here: Path, floating: bool) -> None:
    text = (
        '<robot name="arm"><link name="base"/><link name="rod"/><joint name="pivot" '
        'type="continuous"><parent link="base"/><child link="rod"/></joint></robot>'
    )
    with pytest.raises(InputError, match="nothing in it moves: all is fixed in the world or has"):
        _read(here, text, "arm.urdf", floating=floating)


@pytest.mark.parametrize(
    ("stated", "limits", "place"),
    [
        ('lower="0.5" upper="0.5"', None, "pivot: 0.5 to 0.5"),
        ('lower="0" upper="0"', None, "pivot: 0 to 0"),
        ('lower="1" upper="-1"', None, "pivot: 1 to -1"),
        ('lower="" upper="0.7"', (0.0, 0.7), ""),
        ('upper="-1"', None, "pivot: 0 to -1"),
        ('lower="-1"', (-1.0, 0.0), ""),
        ('upper="0.7"', (0.0, 0.7), ""),
        ('lower="-1" upper="0.7"', (-1.0, 0.7), ""),
    ],
)
def test_limits_of_a_urdf_are_stops_or_dropped(
    stated: str, limits: tuple[float, float] | None, place: str, here: Path
) -> None:
    text = _urdf('<mass value="1"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0))
    text = text.replace("continuous", "revolute").replace(
        "</joint>", f'<limit {stated} effort="1" velocity="1"/></joint>'
    )
    imported = _read(here, text, "arm.urdf")

    assert imported.scene.joints[0].limits == limits
    dropped = _fates(imported, "dropped").get("limit lower")
    assert (dropped.places if dropped else ()) == ((place,) if place else ())
    assert dropped is None or dropped.reason == "the lower one is not below the upper one"


def test_a_coupled_joint_may_start_at_its_limit_but_for_rounding(here: Path) -> None:
    text = _urdf('<mass value="1"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0))
    limit = '<limit lower="0.15" upper="1" effort="1" velocity="1"/>'
    text = text.replace("continuous", "revolute").replace("</joint>", f"{limit}</joint>")
    link, joint = (text[text.index(a) : text.index(b)] for a, b in _SECOND)
    mimic = '<mimic joint="pivot" multiplier="-1" offset="0.3"/></joint>'
    again = (
        (link + joint.replace("</joint>", mimic))
        .replace("rod", "tip")
        .replace('"pivot" t', '"tip" t')
    )
    scene = _read(here, text.replace("</robot>", f"{again}</robot>"), "arm.urdf").scene

    assert [joint.limits for joint in scene.joints] == [(0.15, 1.0)] * 2


def test_a_point_mass_on_several_joints_gets_an_inertia(here: Path) -> None:
    text = _urdf('<mass value="1"/>' + _INERTIA.format(0, 0, 0, 0, 0, 0))
    imported = _read(here, text.replace("continuous", "planar").replace("0 1 0", "0 0 1"), "a.urdf")

    assert len(imported.scene.bodies) == 3
    assert "mass without inertia" in " ".join(f.reason for f in imported.fates)


def test_a_mimic_of_what_does_not_move_is_dropped_by_name(here: Path) -> None:
    text = _urdf('<mass value="1"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0))
    clip = '<link name="b"/><joint name="clip" type="fixed">'
    clip += '<parent link="base"/><child link="b"/></joint>'
    text = text.replace("</joint>", '<mimic joint="clip"/></joint>' + clip)

    assert _fates(_read(here, text, "arm.urdf"), "dropped")["mimic"].places == ("pivot",)


def test_what_a_urdf_cannot_mean_is_refused(here: Path) -> None:
    text = _urdf('<mass value="-1"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0))
    with pytest.raises(InputError, match=r"mass of 'rod': got -1.0, allowed is .* 0 or more"):
        _read(here, text, "arm.urdf")
    world = text.replace("-1", "1").replace("base", "world")
    with pytest.raises(InputError, match="joints move all links on the link 'world'; leave it out"):
        _read(here, world, "arm.urdf", floating=True)


def test_welded_bodies_are_one_by_the_parallel_axis_theorem(here: Path) -> None:
    imported = _read(
        here,
        '<mujoco><worldbody><body name="bar"><joint/><geom type="box" size=".1 .1 .1" mass="3"/>'
        '<body name="end" pos="0 0 2"><geom type="box" size=".1 .1 .1" mass="1"/></body>'
        "</body></worldbody></mujoco>",
    )

    cube = 4 * (2 / 3) * 0.1**2
    across = cube + (3 * 1 / 4) * 2**2  # the reduced mass times the distance squared
    mechanism = Mechanism.of(imported.scene)
    assert mechanism.body_count == 1
    np.testing.assert_allclose(mechanism.com, [[0, 0, 0.5]], atol=1e-14)
    np.testing.assert_allclose(mechanism.inertia[0], np.diag([across, across, cube]), atol=1e-12)
    assert _fates(imported, "kept")["body"].places == ("end in bar",)


def test_moments_that_no_body_has_are_raised_least(here: Path) -> None:
    imported = _read(
        here, _urdf('<mass value="1"/>' + _INERTIA.format(1, 1, 3, 0, 0, 0)), "arm.urdf"
    )

    # Second moments along x, y, z: 1.5, 1.5, −0.5. The last becomes 0.
    moments = np.linalg.eigvalsh(Mechanism.of(imported.scene).inertia[0])
    np.testing.assert_allclose(moments, [1.5, 1.5, 3], rtol=1e-8)
    fate = _fates(imported, "approximated")["inertial"]
    assert "A + B < C" in fate.reason
    np.testing.assert_allclose(float(fate.places[0].split()[2]), (0.5 / 11) ** 0.5, rtol=0.02)


_FRAME = """<link name="frame"/><joint name="flange" type="fixed"><parent link="rod"/>
<child link="frame"/></joint>"""


@pytest.mark.parametrize("rest", ["", _FRAME])
def test_a_mass_without_inertia_gets_a_small_one_whatever_frames_it_carries(
    here: Path, rest: str
) -> None:
    inertial = '<origin xyz="0.02 0 0.7"/><mass value="1.095"/>' + _INERTIA.format(*6 * "0")
    imported = _read(here, _urdf(inertial, rest), "arm.urdf")

    wanted = 1.095e-6 * imported.scene.length**2 * np.eye(3)
    np.testing.assert_allclose(Mechanism.of(imported.scene).inertia[0], wanted, atol=1e-15)
    assert "mass without inertia" in _fates(imported, "approximated")["inertial"].reason


def test_what_the_scene_has_no_place_for_is_dropped_by_name_with_its_value(here: Path) -> None:
    geom = '<geom type="capsule" size=".05" fromto="0 0 0 0 0 1"/>'
    imported = _read(
        here,
        '<mujoco><option density="1.2" timestep="0.01"/><worldbody>'
        f'<geom type="plane" size="1 1 1"/><body><joint name="j1" axis="0 1 0"/>{geom}'
        f'<body pos="0 0 1"><joint name="j2" axis="0 1 0" damping=".3" armature="0.5"/>{geom}'
        "</body></body></worldbody>"
        '<actuator><motor name="m" joint="j1"/><position joint="j2" kp="5" forcerange="-1 2"/>'
        '<muscle name="arm" joint="j2" lengthrange="0 1"/></actuator></mujoco>',
    )

    dropped = _fates(imported, "dropped")
    assert _fates(imported, "kept")["joint damping"].places == ("j2: 0.3",)
    assert (imported.scene.joints[1].damping, imported.scene.joints[1].armature) == (0.3, 0.5)
    assert [(servo.joint, servo.stiffness) for servo in imported.scene.servos] == [("j2", 5.0)]
    reason = _fates(imported, "approximated")["actuator"].reason
    assert reason.startswith("a servo at its command nearest to 0, without the limit of its torque")
    assert reason.endswith(": -1 to 2 is not symmetric")
    assert dropped["geom contact"].count == 3
    assert "no fluid" in dropped["option density"].reason
    assert dropped["actuator"].places == ("arm",)
    idle = _fates(imported, "dropped", moves=False)
    assert idle["actuator"].places == ("m",)
    assert "option timestep" in idle


def test_what_says_who_collides_with_whom_is_told_by_name(here: Path) -> None:
    body = '<body name="{0}"><freejoint/><geom name="{0}" size=".1"/></body>'
    pairs = '<contact><exclude body1="a" body2="b"/><pair geom1="a" geom2="b"/></contact>'
    inside = body.format("a") + body.format("b")
    fates = _read(here, f"<mujoco><worldbody>{inside}</worldbody>{pairs}</mujoco>").fates

    dropped = {fate.element: fate.moves for fate in fates if fate.outcome == "dropped"}
    assert dropped == {"exclude": False, "pair": True, "geom": True}


def test_what_a_format_does_not_know_is_dropped_by_name(here: Path) -> None:
    text = _urdf(
        '<mass value="1" density="3"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0),
        "<spring stiffness='3'/><gazebo reference='rod'/>",
    )
    dropped = _fates(_read(here, text, "arm.urdf"), "dropped")

    assert {"mass density", "spring stiffness", "gazebo reference"} <= dropped.keys()


def test_a_links_base_is_fixed_or_floats_as_asked(here: Path) -> None:
    inertial = '<mass value="2"/>' + _INERTIA.format(1, 1, 1, 0, 0, 0)
    text = _urdf(inertial).replace('<link name="base"/>', f'<link name="base"><inertial>{inertial}'
                                   "</inertial></link>")  # fmt: skip
    fixed, free = (_read(here, text, "arm.urdf", floating=f).scene for f in (False, True))

    assert [body.name for body in fixed.bodies] == ["rod"]
    assert [body.name for body in free.bodies] == ["base", "rod"]
    assert len(free.joints) == 1


_CHAIN = st.lists(
    st.tuples(
        st.sampled_from(["hinge", "slide", "ball", "fixed"]),
        st.lists(st.floats(-1, 1), min_size=9, max_size=9),
    ),
    min_size=1,
    max_size=4,
)


@settings(deadline=None, max_examples=25, suppress_health_check=list(HealthCheck))
@given(_CHAIN)
def test_places_axes_and_inertia_are_those_of_the_compiled_model(
    tmp_path: Path, chain: list[tuple[str, list[float]]]
) -> None:
    text, ends = "", ""
    for k, (kind, numbers) in enumerate([("hinge", [0.3] * 9), *chain]):
        place, angles, size = np.reshape(numbers, (3, 3))
        hold = f'<joint name="j{k}" type="{kind}" axis="{0.2 + abs(place[0])} 1 {place[1]}"/>'
        text += (
            f'<body name="b{k}" pos="{_row(place)}" euler="{_row(90 * angles)}">'
            f'{hold if kind != "fixed" else ""}<geom type="box" size="{_row(0.1 + size**2)}" '
            f'pos="{_row(angles)}" mass="{1 + size[0] ** 2}"/>'
        )
        ends += "</body>"
    xml = f"<mujoco><worldbody>{text}{ends}</worldbody></mujoco>"
    scene = _read(tmp_path, xml).scene
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    mechanism = Mechanism.of(scene)
    np.testing.assert_allclose(mechanism.mass.sum(), model.body_mass.sum(), rtol=1e-12)
    for joint in scene.joints:
        j = model.joint(joint.name).id
        np.testing.assert_allclose(joint.anchor, data.xanchor[j], atol=1e-9)
        if joint.axis is not None:
            np.testing.assert_allclose(joint.axis, data.xaxis[j], atol=1e-9)
    # A body includes all that is fixed to it, which MuJoCo keeps as bodies of their own.
    for k, body in enumerate(scene.bodies):
        own = [b for b in range(1, model.nbody) if model.body_weldid[b] == model.body(body.name).id]
        com, tensor = _together(model, data, own)
        np.testing.assert_allclose(mechanism.com[k], com, atol=1e-9)
        np.testing.assert_allclose(mechanism.inertia[k], tensor, atol=1e-9)


def _row(values: Array) -> str:
    return " ".join(map(repr, values.tolist()))


def _together(model: Any, data: Any, bodies: list[int]) -> tuple[Array, Array]:
    """Add up bodies; `data.xipos` would round a centre of mass near the frame's origin to it."""
    mass = model.body_mass[bodies]
    turns = [data.xmat[b].reshape(3, 3) for b in bodies]
    places = np.array(
        [data.xpos[b] + t @ model.body_ipos[b] for b, t in zip(bodies, turns, strict=True)]
    )
    com = mass @ places / mass.sum()
    tensor = np.zeros((3, 3))
    for b, turn, arm in zip(bodies, turns, places - com, strict=True):
        axes = turn @ rotation.matrix(model.body_iquat[b])
        tensor += axes @ np.diag(model.body_inertia[b]) @ axes.T
        tensor += model.body_mass[b] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return com, tensor


@pytest.mark.parametrize(
    ("joints", "tolerance"),
    [
        ('<joint name="a" axis="0 1 0"/>', 1e-9),
        ('<joint name="a" type="slide" axis="1 0 1"/>', 1e-9),
        (
            '<joint name="a" axis="0 1 0" damping="0.7" stiffness="30" springref="20" ref="5"/>',
            1e-9,
        ),
        ('<joint name="a" type="ball"/>', 1e-9),
        ('<freejoint name="a"/>', 1e-9),
        # Three hinges in a point are a ball joint; two have a small body between them.
        ('<joint axis="1 0 0"/><joint axis="0 1 0"/><joint axis="0 0 1"/>', 1e-9),
        ('<joint axis="1 0 0"/><joint axis="0 1 0"/>', 1e-5),
        ('<joint type="slide" axis="1 0 0"/><joint axis="0 1 0"/>', 1e-5),
    ],
)
def test_a_model_moves_as_it_does_where_it_comes_from(
    here: Path, joints: str, tolerance: float
) -> None:
    xml = (
        '<mujoco><option timestep="0.0002" integrator="RK4"><flag contact="disable"/></option>'
        f'<worldbody><body name="first">{joints}<geom type="box" size=".1 .2 .3" pos=".4 .1 -.5"/>'
        '<body name="second" pos=".4 0 -1"><joint name="k" axis="0.2 1 0" ref="9" armature="3"/>'
        '<geom type="box" size=".2 .1 .1" pos=".3 0 0"/></body></body></worldbody><actuator>'
        '<position joint="k" kp="9" kv="1" gear="2" ctrlrange=".5 1" forcerange="-5 5"/>'
        '<intvelocity joint="k" kp="9" actrange="-1 1"/><velocity joint="k" kv="3"/></actuator>'
        "</mujoco>"
    )
    imported = _read(here, xml).scene
    assert [servo.limit for servo in imported.servos] == [10.0, None, None]
    scene = Scene(imported.name, imported.bodies, imported.length, joints=imported.joints,
                  servos=imported.servos, clock=Clock(frame=0.02, steps=10))  # fmt: skip
    reference = solve(scene, draw_batch(scene, [0]))
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    mujoco.mj_forward(model, data)

    names = [body.name for body in scene.bodies]
    moved = reference.position[0, -1]
    for name in ("first", "second"):
        np.testing.assert_allclose(moved[names.index(name)], data.body(name).xipos, atol=tolerance)
    start = reference.position[0, 0]
    assert np.abs(moved - start).max() > 0.05


def test_limits_that_no_joint_reaches_are_none(here: Path) -> None:
    geom = '<geom type="box" size=".1 .1 .3" pos="0 0 -1"/>'
    imported = _read(
        here,
        '<mujoco><compiler angle="radian"/><worldbody><body><joint name="rotor" axis="0 0 1" '
        f'range="-1e16 1e16"/>{geom}</body></worldbody></mujoco>',
    )

    assert imported.scene.joints[0].limits is None
    assert "no joint gets so far" in _fates(imported, "dropped")["joint range"].reason
    assert np.abs(draw_batch(imported.scene, [2]).orientation).max() <= 1.0

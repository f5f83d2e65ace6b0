"""With `--ground`, the spheres of a model meet the ground where its shapes would."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError, SceneError
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import Lift
from mbds_xsim.scene.scene import Clock, Ground, Scene
from mbds_xsim.simulate.adapter import Adapter, Settings
from mbds_xsim.simulate.registry import read_model
from tests.command_line import CommandLine

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("in_process")

_G = 9.81
_FLOOR = '<geom name="floor" type="plane" size="1 1 1" {}/>'
_SHAPES = {
    "sphere": (0.1,),
    "capsule": (0.05, 0.2),
    "box": (0.2, 0.15, 0.1),
    "cylinder": (0.2, 0.1),
}


def _geom(kind: str, size: tuple[float, ...], more: str = "") -> str:
    return f'<geom name="{kind}" type="{kind}" size="{" ".join(map(repr, size))}" {more}/>'


def _read(here: Path, inside: str, more: str = "", *, floor: str | None = "") -> Imported:
    plane = "" if floor is None else _FLOOR.format(floor)
    (here / "model.xml").write_text(
        f"<mujoco><worldbody>{plane}{inside}</worldbody>{more}</mujoco>"
    )
    return read_model(here / "model.xml", ground=True)


def _free(inside: str, place: str = 'pos="0 0 1"') -> str:
    return f'<body name="b" {place}><freejoint/>{inside}</body>'


def _lowest(kind: str, size: tuple[float, ...], down: Array) -> float:
    """Return how far a shape reaches along a direction of its frame (its support function)."""
    x, y, z = np.abs(down)
    if kind == "box":
        return float(np.dot(size, (x, y, z)))
    radius, half = (*size, 0.0)[:2]
    return float(radius * (np.hypot(x, y) if kind == "cylinder" else 1.0) + half * z)


def _bottoms(scene: Scene) -> Array:
    return np.array([sphere.center[2] - sphere.radius for sphere in scene.contacts])


_NUMBER = st.floats(-1, 1)


@settings(deadline=None, max_examples=60, suppress_health_check=list(HealthCheck))
@given(
    kind=st.sampled_from(sorted(_SHAPES)),
    size=st.tuples(*[st.floats(0.01, 1.0)] * 3),
    turn=st.tuples(*[_NUMBER] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    flat=st.booleans(),
)
def test_spheres_reach_as_low_as_their_shape_but_for_what_the_report_says(
    tmp_path: Path, kind: str, size: tuple[float, ...], turn: tuple[float, ...], flat: bool
) -> None:
    size = size[: len(_SHAPES[kind])]
    quaternion = np.array([1.0, 0, 0, 0] if flat else turn)
    place = f'pos="0.3 -2 4" quat="{" ".join(map(repr, quaternion.tolist()))}"'
    imported = _read(tmp_path, _free(_geom(kind, size), place))

    down = rotation.matrix(quaternion / np.linalg.norm(quaternion)).T @ [0, 0, -1]
    short = _bottoms(imported.scene).min() - (4 - _lowest(kind, size, down))
    fates = [fate for fate in imported.fates if "sphere" in fate.reason]
    (place,) = fates[0].places
    most = 0.0 if fates[0].outcome == "kept" else 1.05 * float(place.split()[-2])
    assert -1e-12 < short < (0.0 if flat else most) + 1e-12


_CASES = {
    # Statements of the file, then the resulting number of spheres and coefficient.
    "the larger coefficient counts": ('friction="0.3"', 'friction="0.7"', "", 1, 0.7),
    "that of the higher priority": ('friction="0.3" priority="1"', 'friction="0.7"', "", 1, 0.3),
    "that of the plane's": ('friction="0.9"', 'friction="0.2" priority="2"', "", 1, 0.2),
    "without friction": ('condim="1"', 'condim="1"', "", 1, 0.0),
    "one of both has friction": ('condim="1" friction=".4"', 'friction=".4"', "", 1, 0.4),
    "masks that meet one way": ('contype="2" conaffinity="0"', 'conaffinity="6"', "", 1, 1.0),
    "masks that do not meet": ('contype="2" conaffinity="2"', "", "", 0, 0.0),
    "an exclusion": ("", "", '<contact><exclude body1="world" body2="b"/></contact>', 0, 0.0),
    "contact off": ("", "", '<option><flag contact="disable"/></option>', 0, 0.0),
}


@pytest.mark.parametrize("case", _CASES)
def test_a_shape_meets_the_plane_as_mujoco_pairs_them(case: str, here: Path) -> None:
    shape, floor, more, count, friction = _CASES[case]
    body = _free(_geom("sphere", (0.1,), shape))

    if not count:
        with pytest.raises(InputError, match="no collision shape of it can touch the ground"):
            _read(here, body, more, floor=floor)
        return
    scene = _read(here, body, more, floor=floor).scene
    assert len(scene.contacts) == count
    assert scene.ground == Ground(friction, 0.0)


def test_the_models_plane_is_the_ground(here: Path) -> None:
    geoms = _geom("sphere", (0.1,), 'pos="0 0 .5"') + _geom("ellipsoid", (0.1, 0.1, 0.1))
    arm = (
        '<body pos="0 0 .2"><joint type="ball"/><geom name="rod" size=".02" pos="0 0 -.1"/></body>'
    )
    imported = _read(
        here,
        '<geom type="plane" size="1 1 1" zaxis="1 0 1"/>'
        '<geom name="table" type="box" size="1 1 1"/>' + _free(geoms + arm),
        floor='pos="5 5 -.3" euler="0 0 30"',
    )

    scene = imported.scene
    np.testing.assert_allclose(scene.contacts[0].center, [0, 0, 1.8], atol=1e-12)
    np.testing.assert_allclose(scene.joints[0].anchor, [0, 0, 1.5], atol=1e-12)
    np.testing.assert_allclose(Mechanism.of(scene).com[1], [0, 0, 1.4], atol=1e-12)
    dropped = {f.reason: f.places for f in imported.fates if f.outcome == "dropped" and f.moves}
    assert any("ellipsoid" in reason for reason in dropped)
    assert next(v for k, v in dropped.items() if "fixed in the world" in k) == ("of world", "table")
    assert any("in the file is at z = -0.3 m" in fate.reason for fate in imported.fates)


def test_several_coefficients_become_that_of_most_shapes(here: Path) -> None:
    feet = [_geom("sphere", (0.1,), f'pos="{k} 0 0" friction="{mu}"') for k, mu in
            enumerate((0.5, 0.8, 0.8))]  # fmt: skip
    feet = [foot.replace('name="sphere"', f'name="foot {k}"') for k, foot in enumerate(feet)]
    imported = _read(here, _free("".join(feet)), floor=None)

    assert imported.scene.ground == Ground(0.8, 0.0)
    (entry,) = (
        f for f in imported.fates if f.outcome == "approximated" and f.properties == ("friction",)
    )
    assert entry.places == ("foot 0: 0.5",)
    assert any("the ground is the plane z = 0" in fate.reason for fate in imported.fates)


def test_what_is_inside_another_sphere_is_left_out(here: Path) -> None:
    scene = _read(here, _free(_geom("sphere", (0.2,)) + _geom("capsule", (0.05, 0.15)))).scene

    assert [sphere.radius for sphere in scene.contacts] == [0.2]


_LEG = (
    '<body name="{n}" pos="{x} {y} 0"><joint name="hip {n}" axis="0 1 0" damping="1"/>'
    '<geom name="thigh {n}" type="capsule" size=".03" fromto="0 0 0 0 0 -.2"/>'
    '<body pos="0 0 -.2"><joint name="knee {n}" axis="0 1 0" damping="1" stiffness="20"/>'
    '<geom name="shank {n}" type="capsule" size=".02" fromto="0 0 0 0 0 -.15"/>'
    '<geom name="foot {n}" size=".03" pos="0 0 -.2"/></body></body>'
)
_QUADRUPED = _free(
    _geom("box", (0.3, 0.12, 0.06))
    + "".join(_LEG.format(n=f"{x} {y}", x=0.25 * x, y=0.15 * y) for x in (-1, 1) for y in (-1, 1))
)


def _heights(scene: Scene, count: int = 30) -> Array:
    """Return the height of the lowest point at each drawn start [m]."""
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(count), seed=3)
    states = BodyStates.of(mechanism, batch)
    low = mechanism.sphere_heights(states.position, states.native) - mechanism.sphere_radius
    return np.asarray(low.min(axis=1))


def test_starts_are_lifted_off_the_ground(here: Path) -> None:
    scene = _read(here, _QUADRUPED).scene

    assert [joint.name for joint in scene.joints][:2] == ["hip -1 -1", "knee -1 -1"]
    heights = _heights(scene) / scene.length
    for interval, (low, high) in enumerate([(0.01, 0.05), (0.05, 0.1), (0.1, 0.2)]):
        drawn = heights[interval::3]
        assert ((drawn > low - 1e-12) & (drawn < high + 1e-12)).all()
        assert np.ptp(drawn) > 0.3 * (high - low)


def test_an_upright_slider_lifts_a_model_that_the_world_holds(here: Path) -> None:
    rails = (
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 -1"/>'
    )
    body = f'<body name="b" pos="0 0 .2">{rails}<joint axis="0 1 0"/>' + _geom(
        "capsule", (0.05, 0.3)
    )
    scene = _read(here, body + '<body pos="0 0 -3"><joint type="slide"/>'
                  + _geom("sphere", (0.1,)) + "</body></body>").scene  # fmt: skip

    lifts = [draw for draw in scene.sampling if isinstance(draw, Lift)]
    assert [draw.body for draw in lifts] == ["b after z"]
    assert (_heights(scene) > 0.009 * scene.length).all()


@pytest.mark.parametrize("tie", ['connect body1="c" anchor="0 0 0"', 'joint joint1="s" joint2="h"'])
def test_what_a_loop_or_coupling_holds_is_not_lifted(tie: str, here: Path) -> None:
    one, other = _geom("sphere", (0.1,)), _geom("capsule", (0.1, 0.2))
    carried = f'<body name="c" pos=".5 0 0"><joint name="h" axis="0 1 0"/>{other}</body>'
    body = f'<body name="b" pos="0 0 5"><joint name="s" type="slide"/>{one}{carried}</body>'
    scene = _read(here, body, f"<equality><{tie}/></equality>").scene

    assert not any(isinstance(draw, Lift) for draw in scene.sampling)


def test_what_carries_no_sphere_is_not_lifted(here: Path) -> None:
    scene = _read(here, _free(_geom("sphere", (0.1,)))).scene
    idle = msgspec.structs.replace(scene.bodies[0], name="idle")
    lift = Lift("idle", (0.0, 0.0))

    two = msgspec.structs.replace(scene, bodies=(*scene.bodies, idle), sampling=(lift,))
    with pytest.raises(SceneError, match="'idle' carries no contact sphere"):
        draw_batch(two, [0])


_REFUSED = {
    "a fixed arm": (
        f'<body name="arm"><joint axis="0 1 0"/>{_geom("capsule", (0.05, 0.5))}</body>',
        "30 of 30 drawn starts are in the ground, 'arm' by 0.",
    ),
    "a mesh": (
        _free(_geom("ellipsoid", (0.1, 0.1, 0.1))),
        "no collision shape of it can touch the ground (no contact spheres stand for",
    ),
}


@pytest.mark.parametrize("name", _REFUSED)
def test_what_cannot_stand_on_the_ground_is_refused_in_a_line(
    name: str, here: Path, run: CommandLine
) -> None:
    inside, part = _REFUSED[name]
    (here / "model.xml").write_text(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")

    refusal = run("import", "model.xml", "--ground", "--out", "model.toml").refusal

    assert f": --ground: {part}" in refusal
    assert not (here / "model.toml").exists()


def test_shapes_of_a_urdf_stand_where_it_says(here: Path) -> None:
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial>"
    )
    solid = (
        '<collision name="{}"><origin xyz="0 0 {}" rpy="0 1.5707963267948966 0"/><geometry>{}'
        "</geometry></collision>"
    )
    foot = solid.format("foot", -0.5, '<cylinder radius="0.1" length="0.4"/>')
    hull = solid.format("hull", 0, '<mesh filename="gone.stl"/>')
    (here / "r.urdf").write_text(
        f'<robot name="r"><link name="base">{inertial}{foot}{hull}</link></robot>'
    )
    imported = read_model(here / "r.urdf", floating=True, ground=True)
    plain = read_model(here / "r.urdf", floating=True)

    scene = imported.scene
    centers = np.array([sphere.center for sphere in scene.contacts])
    np.testing.assert_allclose(np.ptp(centers, axis=0), [0.38, 0.18, 0.18], atol=1e-12)
    np.testing.assert_allclose(centers.mean(axis=0), [0, 0, -0.5], atol=1e-12)
    assert scene.ground == Ground(1.0, 0.0)
    assert "the format states none" in " ".join(fate.reason for fate in imported.fates)
    assert [f.places for f in imported.fates if "mesh" in f.reason] == [("of base",)]
    np.testing.assert_allclose(Mechanism.of(scene).inertia, Mechanism.of(plain.scene).inertia)
    assert not plain.scene.contacts
    (dropped,) = (fate for fate in plain.fates if fate.element == "collision")
    assert "--ground" in dropped.reason


_UPRIGHT = {"sphere": 0, "capsule": 90, "box": 0, "cylinder": 0}
"""Turn about y at which each shape comes to rest [°]."""
_TILTED = {"sphere": 0, "capsule": 75, "box": 12, "cylinder": 12}
"""Turn about y from which each shape falls into `_UPRIGHT` [°]."""
_FALL = 0.05
"""Height of the fall [m]."""
_STEP = 1e-3
"""Step of the simulation [s]."""


def _down(angle: float) -> Array:
    """Return the direction of −z in a frame that is turned about y [°]."""
    return np.array([np.sin(np.radians(angle)), 0.0, -np.cos(np.radians(angle))])


def test_dropped_shapes_touch_when_they_should_and_come_to_rest(
    cornered: Adapter, here: Path
) -> None:
    drops = [(kind, turn) for turns in (_UPRIGHT, _TILTED) for kind, turn in turns.items()]
    inside = ""
    for k, (kind, angle) in enumerate(drops):
        middle = _lowest(kind, _SHAPES[kind], _down(angle)) + _FALL
        place = f'pos="{k} 0 {middle!r}" euler="0 {angle} 0"'
        inside += _free(_geom(kind, _SHAPES[kind]), place).replace('"b"', f'"{k}"')
    inside = re.sub(r'geom name="\w+"', "geom", inside)
    scene = msgspec.structs.replace(
        _read(here, inside).scene, sampling=(), clock=Clock(frame=0.004, steps=100)
    )
    settings = Settings(cornered.settings(scene, "matched").method, _STEP)
    with cornered.open(scene, settings) as run:
        motion = run.rollout(draw_batch(scene, [0]))

    assert motion.failures == (None,)
    height = motion.position[0, :, :, 2]
    fall = height[0] - _G / 2 * motion.time[:, None] ** 2
    touched = motion.time[np.argmax(np.abs(height - fall) > 5e-4, axis=0)]
    # The real shapes would touch at `first`, the spheres in their place somewhat later.
    first = np.sqrt(2 * _FALL / _G)
    latest = np.sqrt(2 * (_FALL + 0.005) / _G) + 2 * scene.clock.frame
    assert ((first - 1e-3 < touched) & (touched < latest)).all()
    rest = [_lowest(kind, _SHAPES[kind], _down(_UPRIGHT[kind])) for kind, _ in drops]
    np.testing.assert_allclose(height[-1], rest, atol=_G * first * _STEP)  # no step takes it deeper

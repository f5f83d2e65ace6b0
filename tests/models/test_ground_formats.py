"""SDF and USD have the contact spheres that MJCF has, and pair shapes as each format says."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Ground, Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, read_model
from tests.command_line import CommandLine
from tests.models import ground_files as files

for _name in ("mujoco", "dartpy", "pxr"):
    pytest.importorskip(_name)
pytestmark = pytest.mark.usefixtures("in_process")


def _read(here: Path, suffix: str, text: str) -> Imported:
    (here / f"model.{suffix}").write_text(text)
    return read_model(here / f"model.{suffix}", floating=suffix == "urdf", ground=True)


def _centers(scene: Scene) -> Array:
    """Return the centres and radii of the spheres, sorted."""
    spheres = np.array([[*sphere.center, sphere.radius] for sphere in scene.contacts])
    return np.asarray(spheres[np.lexsort(spheres.round(6).T)])


@pytest.mark.parametrize("kind", files.SHAPES)
def test_a_shape_has_the_same_spheres_in_every_format(kind: str, here: Path) -> None:
    by_format = {
        suffix: _read(here, suffix, write(kind, files.SHAPES[kind]))
        for suffix, write in files.FORMATS.items()
    }

    first = _centers(by_format["xml"].scene)
    for imported in by_format.values():
        np.testing.assert_allclose(_centers(imported.scene), first, atol=1e-7)
        assert imported.scene.ground == Ground(1.0, 0.0)
        (entry,) = (fate for fate in imported.fates if "sphere" in fate.reason)
        assert entry.outcome == ("kept" if kind in ("sphere", "capsule") else "approximated")


_FALL, _HEIGHT = 0.05, -0.3  # m


def _drops() -> dict[str, str]:
    """Return a file in each format with shapes that stand upright above a floor."""
    models, prims = [files.plane(height=_HEIGHT)], [files.HEAD, files.floor(height=_HEIGHT)]
    for kind, size in files.SHAPES.items():
        lowest = sum(size) if kind == "capsule" else size[-1]
        height = _HEIGHT + _FALL + lowest
        models.append(files.link(files.solid(kind, size), kind, height))
        prims.append(files.xform(files.prim(kind, size, name=f"{kind}_shape"), kind, height))
    return {"sdf": files.world(*models), "usda": "".join(prims)}


@pytest.mark.parametrize("suffix", ["sdf", "usda"])
def test_dropped_shapes_touch_the_floor_of_the_file_when_they_should(
    suffix: str, here: Path
) -> None:
    scene = msgspec.structs.replace(
        _read(here, suffix, _drops()[suffix]).scene,
        sampling=(),
        gravity=(0.0, 0.0, -9.81),
        clock=Clock(frame=0.001, steps=120),
    )
    engine = load_adapter("mujoco")
    settings = Settings(engine.settings(scene, "matched").method, 1e-3)
    with engine.open(scene, settings) as run:
        motion = run.rollout(draw_batch(scene, [0]))

    height = motion.position[0, :, :, 2]
    fall = height[0] - 9.81 / 2 * motion.time[:, None] ** 2
    touched = motion.time[np.argmax(np.abs(height - fall) > 5e-4, axis=0)]
    first = np.sqrt(2 * _FALL / 9.81)
    assert ((first - 1e-3 < touched) & (touched < first + 4e-3)).all()


def _friction(mu: float) -> str:
    return f"<friction><ode><mu>{mu}</mu><mu2>{mu}</mu2></ode></friction>"


def _mask(bits: str, more: str = "") -> str:
    return f"<contact><collide_bitmask>{bits}</collide_bitmask>{more}</contact>"


def _bounce(restitution: float, threshold: str = "<threshold>0.1</threshold>") -> str:
    return (
        f"<bounce><restitution_coefficient>{restitution}</restitution_coefficient>{threshold}"
        "</bounce>"
    )


_SDF_PAIRS = {
    # Surfaces of the shape and of the plane (None: no plane), and the result.
    "nothing stated": ("", "", Ground(1.0, 0.0)),
    "the smaller friction": (_friction(0.7), _friction(0.3), Ground(0.3, 0.0)),
    "its own without a plane": (_friction(1.7) + _bounce(0.4), None, Ground(1.7, 0.4)),
    "the smaller restitution": (_bounce(0.6), _bounce(0.4, ""), Ground(1.0, 0.4)),
    "no speed to rebound from": (_bounce(0.6, ""), _bounce(0.4, ""), Ground(1.0, 0.0)),
    "masks that meet": (_mask("0x06"), _mask("3"), Ground(1.0, 0.0)),
    "masks that do not": (_mask("6"), _mask("1"), "by collide_bitmask"),
    "a sensor": (
        _mask("1", "<collide_without_contact>1</collide_without_contact>"),
        "",
        "only senses",
    ),
}


@pytest.mark.parametrize("case", _SDF_PAIRS)
def test_a_shape_of_sdf_meets_the_plane_as_surfaces_say(case: str, here: Path) -> None:
    shape, plane, expected = _SDF_PAIRS[case]
    models = [
        "" if plane is None else files.plane(plane),
        files.link(files.solid("sphere", (0.1,), (0,) * 6, shape), height=1.0),
    ]
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            _read(here, "sdf", files.world(*models))
        return
    imported = _read(here, "sdf", files.world(*models))
    assert imported.scene.ground == expected
    idle = [fate for fate in imported.fates if "no restitution below" in fate.reason]
    assert len(idle) == (case == "no speed to rebound from")
    assert not any("unknown" in fate.reason for fate in imported.fates)


def test_what_of_a_surface_the_ground_lacks_is_named(here: Path) -> None:
    torsional = "<torsional><coefficient>1</coefficient></torsional>"
    surface = f"<friction><ode><mu>0.5</mu><mu2>0.2</mu2></ode>{torsional}</friction>"
    shapes = files.solid("sphere", (0.1,), (0,) * 6, surface) + files.solid(
        "cone", (0.1, 0.1), name="tip"
    )
    imported = _read(here, "sdf", files.world(files.link(shapes, height=1.0)))

    lost = {
        (fate.element, *fate.properties): fate.places
        for fate in imported.fates
        if fate.outcome == "dropped" and fate.moves
    }
    assert lost["mu2",] == ()
    assert lost["collision", "rolling"] == ("s of b",)
    assert lost["collision",] == ("tip of b",)


def test_a_plane_that_moves_or_is_tilted_is_no_ground(here: Path) -> None:
    plane = '<collision name="p"><geometry><plane/></geometry></collision>'
    tilted = files.plane(height=-3.0).replace("0 0 2", "1 0 2")
    body = files.link(files.solid("sphere", (0.1,)) + plane, height=1.0)
    imported = _read(here, "sdf", files.world(tilted, body))

    losses = {fate.reason: fate.places for fate in imported.fates if fate.outcome != "kept"}
    assert any("no horizontal plane is fixed in the world" in reason for reason in losses)
    assert losses["no contact spheres stand for shapes of the kind plane"] == ("p of b",)
    assert imported.scene.bodies[0].position[2] == 1.0


def _material(name: str, friction: float, restitution: float = 0.0) -> str:
    return (
        f'def Material "{name}" (prepend apiSchemas = ["PhysicsMaterialAPI"])\n{{\n'
        f"float physics:dynamicFriction = {friction}\nfloat physics:staticFriction = 2\n"
        f"float physics:restitution = {restitution}\n}}\n"
    )


def _group(name: str, member: str, others: str, more: str = "") -> str:
    return (
        f'def PhysicsCollisionGroup "{name}" (prepend apiSchemas = ["CollectionAPI:colliders"])\n'
        f"{{\nrel collection:colliders:includes = <{member}>\n"
        f"rel physics:filteredGroups = {others}\n{more}}}\n"
    )


_RUBBER = _material("rubber", 0.7, 0.4)
_BOUND = "rel material:binding:physics = <{}>\n"
_INVERTED = "bool physics:invertFilteredGroups = 1\n"
_MERGED = 'string physics:mergeGroup = "m"\n'
_FILTERED = ', "PhysicsFilteredPairsAPI"'
_AS_USUAL = Ground(1.0, 0.0)
_NOT_MET = "collision group does not meet"
_USD_PAIRS = {
    # Text outside, in the shape, in the floor and in the body, and the result.
    "nothing stated": ("", "", "", "", _AS_USUAL),
    "their mean": (
        _RUBBER + _material("ice", 0.1),
        _BOUND.format("/rubber"),
        _BOUND.format("/ice"),
        "",
        Ground((0.7 + 0.1) / 2, 0.2),
    ),
    "the only material": (_RUBBER, "", _BOUND.format("/rubber"), "", Ground(0.7, 0.4)),
    "groups that meet": (
        _group("a", "/b/s", "</a>") + _group("f", "/floor", "[]"), "", "", "", _AS_USUAL,
    ),
    "groups that do not": (
        _group("a", "/b/s", "[]") + _group("f", "/floor", "</a>"), "", "", "", _NOT_MET,
    ),
    "all others but one": (
        _group("a", "/b/s", "</f>", _INVERTED) + _group("f", "/floor", "[]"), "", "", "", _AS_USUAL,
    ),
    "all others": (
        _group("a", "/b/s", "</a>", _INVERTED) + _group("f", "/floor", "[]"), "", "", "", _NOT_MET,
    ),
    "groups that are merged": (
        _group("a", "/b/s", "[]", _MERGED) + _group("c", "/b", "</f>", _MERGED)
        + _group("f", "/floor", "[]"), "", "", "", _NOT_MET,
    ),
    "pairs": ("", "", "", "rel physics:filteredPairs = </floor>\n", "filteredPairs"),
    "switched off": ("", "bool physics:collisionEnabled = 0\n", "", "", "it has none"),
}  # fmt: skip


@pytest.mark.parametrize("case", _USD_PAIRS)
def test_a_shape_of_usd_meets_the_plane_as_its_schema_says(case: str, here: Path) -> None:
    beside, shape, floor, body, expected = _USD_PAIRS[case]
    solid = files.prim("sphere", (0.1,), more=shape)
    text = (
        files.HEAD
        + beside
        + files.floor(floor)
        + files.xform(body + solid, height=1.0, apis=_FILTERED)
    )
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            _read(here, "usda", text)
        return
    imported = _read(here, "usda", text)
    assert imported.scene.ground == expected
    lost = {
        name for fate in imported.fates if fate.outcome == "dropped" for name in fate.properties
    }
    assert ("physics:staticFriction" in lost) == bool("rubber" in beside)


def test_centimetres_y_up_and_axes_of_usd(here: Path) -> None:
    """The capsule lies along x, in a body 2 m above a floor at 0.5 m, on a y-up stage."""
    head = files.HEAD.replace("metersPerUnit = 1", "metersPerUnit = 0.01").replace('"Z"', '"Y"')
    capsule = files.prim("capsule", (10, 30)).replace('"Z"', '"X"')
    body = files.xform(capsule).replace("(0, 0, 0.0)", "(0, 250, 0)", 1)
    floor = files.floor().replace("(0, 0, 0.0)", "(0, 50, 0)").replace('"Z"', '"Y"')

    scene = _read(here, "usda", head + floor + body).scene

    expected = [[-0.3, 0, 2, 0.1], [0.3, 0, 2, 0.1]]
    np.testing.assert_allclose(_centers(scene), expected, atol=1e-9)
    assert scene.bodies[0].position[2] == pytest.approx(2)


def test_all_places_count_from_the_floor(here: Path) -> None:
    """Raising a model by half a metre equals lowering its floor, with loops and springs too."""
    text = (
        '<mujoco><worldbody><geom type="plane" size="1 1 1" pos="0 0 {0}"/>'
        '<body pos="0 0 {1}"><joint axis="0 1 0"/><geom size=".1"/><site name="p" pos=".2 0 0"/>'
        '<body name="c" pos="1 0 0"><joint axis="0 1 0"/><geom size=".1"/></body></body>'
        '<body name="d" pos="1 1 {1}"><joint axis="0 1 0"/><geom size=".1"/></body>'
        '<site name="q" pos=".2 0 {2}"/></worldbody>'
        '<equality><connect body1="c" body2="d" anchor="0 .5 0"/></equality>'
        '<tendon><spatial stiffness="9"><site site="p"/><site site="q"/></spatial></tendon>'
        "</mujoco>"
    )
    lower, higher = (
        _read(here, "xml", text.format(floor, floor + 1.5, floor + 2.0)).scene
        for floor in (-0.5, 0.0)
    )

    assert len(higher.springs) == 1
    assert any(joint.anchor == (1.0, 0.5, 1.5) for joint in higher.joints)
    assert lower == higher


_BOX = "<collision><geometry><box/></geometry></collision>"
_BAD = {
    "size": (
        "sdf",
        files.world(files.link(files.solid("box", (0.1, -0.1, 0.1)))),
        "is 0.2 -0.2 0.2, allowed is above 0",
    ),
    "no size": ("sdf", files.world(files.link(_BOX)), "<size> of <collision> '' is not there"),
    "word": (
        "sdf",
        files.world(files.link(files.solid("sphere", (np.nan,)))),
        "allowed is a number",
    ),
    "pose": (
        "sdf",
        files.world(files.link(files.solid("sphere", (0.1,), (1, 2)))),
        "allowed is six numbers",
    ),
    "mask": (
        "sdf",
        files.world(files.link(files.solid("sphere", (0.1,), (0,) * 6, _mask("all")))),
        "'all', allowed is an integer",
    ),
    "friction": (
        "sdf",
        files.world(files.link(files.solid("sphere", (0.1,), (0,) * 6, _friction(-1)), height=1.0)),
        "collision 's of b': friction with the ground: got -1.0",
    ),
    "scales": (
        "usda",
        files.HEAD + files.xform(files.prim("sphere", (0.1,), more="")).replace(
            files.ORDER,
            "float3 xformOp:scale = (1, 2, 1)\n" + files.ORDER.replace("orient", "scale")),
        "of the kind sphere, scaled unevenly",
    ),
    "restitution": (
        "usda",
        files.HEAD + _material("r", 0.5, 1.5)
        + files.xform(files.prim("sphere", (0.1,), more=_BOUND.format("/r")), height=1.0),
        "Collision 's': restitution on the ground: got 1.5, allowed is 0 to 1",
    ),
    "radius": (
        "usda",
        files.HEAD + files.xform(files.prim("sphere", (2.0**-40,)), height=1.0),
        "Collision 's': radius: got 9",
    ),
    "normal": (
        "sdf",
        files.world(files.plane().replace("0 0 2", "0 0 0"), files.link("")),
        "<normal> of <collision> 'ground' is 0 0 0, allowed is any other",
    ),
    "plane": (
        "xml",
        '<mujoco><worldbody><geom name="p" type="plane" size="1 1 1" pos="0 0 nan"/><body>'
        '<freejoint/><geom size=".1"/></body></worldbody></mujoco>',
        "place of 'p': got ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", _BAD)
def test_a_bad_shape_is_one_line(name: str, run: CommandLine, here: Path) -> None:
    suffix, text, part = _BAD[name]
    (here / f"model.{suffix}").write_text(text)

    refusal = run("import", f"model.{suffix}", "--ground", "--out", "model.toml").refusal

    assert re.match(rf"mbds-xsim: [^\n]*{part}[^\n]*$", refusal.strip()), refusal
    assert not (here / "model.toml").exists()

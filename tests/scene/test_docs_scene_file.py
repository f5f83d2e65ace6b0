"""The page about scene files lists all that the code reads, and its examples are right."""

from __future__ import annotations

import ast
import inspect
import re
import tomllib
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError
from mbds_xsim.base.rotation import rotate
from mbds_xsim.reference import solve
from mbds_xsim.scene import budget, collisions, coupling, sampling_terms, scene, servo
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import constraint_rows
from mbds_xsim.scene.file import read_scene
from mbds_xsim.scene.joint_space import joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene

PAGE = (Path(__file__).parents[2] / "docs" / "scene-file.md").read_text("utf-8")
EXAMPLES = dict(re.findall(r"^`([\w.-]+)`:\n\n```toml\n(.*?)^```$", PAGE, re.M | re.S))

_HEADINGS: dict[type[msgspec.Struct], str] = {
    scene.Scene: "The scene",
    scene.Body: "`[[bodies]]`",
    scene.Particle: "`particles` of a body",
    scene.Inertia: "`inertia` of a body",
    scene.Joint: "`[[joints]]`",
    scene.DistanceLink: "`[[distance_links]]`",
    scene.SpringDamper: "`[[springs]]`",
    scene.Force: "`[[forces]]`",
    scene.Torque: "`[[torques]]`",
    servo.Servo: "`[[servos]]`",
    coupling.Coupling: "`[[couplings]]`",
    scene.ContactSphere: "`[[contacts]]`",
    scene.Ground: "`[ground]`",
    collisions.Collisions: "`[collisions]`",
    scene.Clock: "`[clock]`",
    budget.Budget: "`[budget]`",
    sampling_terms.Levels: "Sampling",
    sampling_terms.Swing: "Kind `swing`",
    sampling_terms.Turn: "Kind `turn`",
    sampling_terms.Throw: "Kind `throw`",
    sampling_terms.Roll: "Kind `roll`",
    sampling_terms.Lift: "Kind `lift`",
    sampling_terms.Pose: "Kind `pose`",
    sampling_terms.HingeRate: "Kind `hinge_rate`",
    sampling_terms.HingeTorque: "Kind `hinge_torque`",
    sampling_terms.Wind: "Kind `wind`",
}
_STRUCTS = list(_HEADINGS)
_NAMES = [kind.__name__ for kind in _STRUCTS]

Row = tuple[str, str, str]  # type, default, meaning


def _table(kind: type[msgspec.Struct]) -> dict[str, Row]:
    """Rows of the section's table by key."""
    heading = re.escape(_HEADINGS[kind])
    section = re.search(rf"^#+ {heading}$(.*?)(?=^#|\Z)", PAGE, re.M | re.S)
    assert section, heading
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|(?: (.*?))? \|$", section[1], re.M)
    assert len(rows) == len(re.findall(r"^\| `", section[1], re.M)), "a row that is none"
    assert len({row[0] for row in rows}) == len(rows), "a key is listed twice"
    return {key: (form, default, meaning) for key, form, default, meaning in rows}


def _attribute_docs(kind: type[msgspec.Struct]) -> dict[str, str]:
    body = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(body, ast.ClassDef)
    docs = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            docs[field.target.id] = str(text.value.value)
    return docs


def test_every_struct_has_a_section() -> None:
    defined = {
        kind
        for module in (scene, sampling_terms, servo)
        for name, kind in vars(module).items()
        if inspect.isclass(kind)
        and issubclass(kind, Neutral)
        and kind is not Neutral
        and name[0] != "_"
    }

    assert defined - {Neutral} == set(_HEADINGS)


@pytest.mark.parametrize("kind", _STRUCTS, ids=_NAMES)
def test_the_keys_are_the_fields_in_their_order(kind: type[msgspec.Struct]) -> None:
    tag = [kind.__struct_config__.tag_field] if kind.__struct_config__.tag_field else []

    assert list(_table(kind)) == [*tag, *kind.__struct_fields__]


@pytest.mark.parametrize("kind", _STRUCTS, ids=_NAMES)
def test_the_defaults_are_those_of_the_code(kind: type[msgspec.Struct]) -> None:
    table = _table(kind)
    for field in msgspec.structs.fields(kind):
        written = table[field.name][1]
        if field.required:
            assert written == "required", field.name
        elif field.default is None:
            assert written == "none", field.name
        elif isinstance(field.default, msgspec.Struct):
            assert written == "all defaults", field.name
        else:
            value = tomllib.loads(f"value = {written.strip('`')}")["value"]
            assert value == msgspec.json.decode(msgspec.json.encode(field.default)), field.name


@pytest.mark.parametrize("kind", _STRUCTS, ids=_NAMES)
def test_the_units_are_those_of_the_code(kind: type[msgspec.Struct]) -> None:
    table = _table(kind)
    for key, text in _attribute_docs(kind).items():
        for unit in re.findall(r"\[[a-zN·²³/]+\]", text):
            assert unit in table[key][2], f"{key} {unit}"


@pytest.mark.parametrize("kind", _STRUCTS, ids=_NAMES)
def test_the_allowed_words_are_those_of_the_code(kind: type[msgspec.Struct]) -> None:
    table = _table(kind)
    for key, hint in get_type_hints(kind).items():
        if get_origin(hint) is Literal:
            words = re.findall(r"`\"(\w+)\"`|\b(\d)\b", table[key][0])
            listed = {text or int(number) for text, number in words}
            assert listed == set(get_args(hint)), key
    if kind.__struct_config__.tag_field:
        assert table["kind"][2] == f'`"{kind.__struct_config__.tag}"`'


def _read(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> Scene:
    monkeypatch.chdir(folder)
    Path(name).write_text(text, "utf-8")
    return read_scene(Path(name))


@pytest.fixture
def four_bar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    return _read("four-bar.toml", tmp_path, monkeypatch, EXAMPLES["four-bar.toml"])


@pytest.fixture
def rod(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    return _read("pendulum.toml", tmp_path, monkeypatch, EXAMPLES["pendulum.toml"])


def test_the_pendulum_starts_where_the_page_says(rod: Scene) -> None:
    """The pendulum starts at 60°, with its lower end towards −x."""
    (position,) = draw_batch(rod, [0]).position[0]

    assert position == pytest.approx([-0.5 * np.sin(np.pi / 3), 0.0, -0.25], abs=1e-9)


def test_the_four_bar_follows_its_crank(four_bar: Scene) -> None:
    mechanism = Mechanism.of(four_bar)
    start = assemble(mechanism)
    crank = mechanism.joints[0]

    assert [joint.name for joint in mechanism.loops] == ["coupler pin"]
    assert joint_coordinate(crank, start.position, start.native) == pytest.approx(0.5)
    # Counter-clockwise: from straight up towards −x, and on.
    assert rotate(start.native[0], np.array([0.0, 0.0, 1.0])) == pytest.approx(
        [-np.sin(0.5), 0.0, np.cos(0.5)]
    )
    assert start.angular_velocity[0] == pytest.approx([0.0, -3.0, 0.0])
    assert np.abs(start.angular_velocity[1:, 1]).min() > 0.1
    assert np.abs(constraint_rows(mechanism, start).residual).max() < 1e-15


def test_the_rocker_lies_along_its_hinges(four_bar: Scene) -> None:
    body = four_bar.bodies[2]

    along = rotate(np.array(body.orientation), np.array([0.0, 0.0, 1.0]))

    pins = np.array(four_bar.joints[3].anchor) - four_bar.joints[2].anchor
    assert along == pytest.approx(pins / np.linalg.norm(pins), abs=1e-9)


def test_the_four_bar_turns_in_its_plane(four_bar: Scene) -> None:
    motion = solve(four_bar, draw_batch(four_bar, [0]).truncated(50), rtol=1e-8, cache=False)

    assert motion.failures == (None,)
    assert np.abs(motion.position[..., 1]).max() < 1e-9


def test_the_sampling_of_the_page_fits_the_pendulum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (draws,) = re.findall(r"^```toml\n(\[\[sampling\]\].*?)^```$", PAGE, re.M | re.S)
    text = EXAMPLES["pendulum.toml"] + "\n" + draws

    drawn = _read("drawn.toml", tmp_path, monkeypatch, text)

    batch = draw_batch(drawn, range(9))
    rates = batch.angular_velocity[:, 0, 1].reshape(3, 3)
    assert np.all((rates >= [0.0, 1.0, 2.0]) & (rates <= [1.0, 2.0, 4.0]))
    assert np.all(batch.torque[:, :20] == batch.torque[:, :1])
    assert np.all((np.abs(batch.torque) >= 0.1) & (np.abs(batch.torque) <= 0.5))


_REPLACED = re.findall(
    r"^with `(.*?)` replaced by `(.*?)`.*?:\n\n```\n([\w.-]+)(: .*?)\n```$", PAGE, re.M
)
_ADDED = re.findall(
    r"^with `(.*?)` added below `(.*?)`.*?:\n\n```\n([\w.-]+)(: .*?)\n```$", PAGE, re.M
)
_MISTAKES = [
    *((file, old, new, text) for old, new, file, text in _REPLACED),
    *((file, above, f"{above}\n{new}", text) for new, above, file, text in _ADDED),
]


def test_all_messages_of_the_page_are_tried() -> None:
    section = PAGE[PAGE.index("## When something is wrong") :]

    assert len(_MISTAKES) == len(re.findall(r"^```\n.*?^```$", section, re.M | re.S)) > 4


@pytest.mark.parametrize(("file", "old", "new", "text"), _MISTAKES)
def test_a_mistake_is_told_as_the_page_shows(
    file: str, old: str, new: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert EXAMPLES[file].count(old) == 1

    with pytest.raises(SceneError) as raised:
        _read(file, tmp_path, monkeypatch, EXAMPLES[file].replace(old, new))

    assert str(raised.value) == file + text


def test_what_is_left_out_is_not_zero() -> None:
    """The page's double pendulum has its second hinge near −0.93 rad at the start."""

    def body(name: str, z: float) -> scene.Body:
        return scene.Body(name, particles=(scene.Particle((0.0, 0.0, z)),))

    def hinge(name: str, parent: str, child: str, z: float, start: float | None) -> scene.Joint:
        axis = (0.0, 1.0, 0.0)
        return scene.Joint(name, "hinge", parent, child, (0.0, 0.0, z), axis=axis, start=start)

    free = Scene(
        name="double",
        bodies=(body("a", -0.5), body("b", -1.0)),
        length=1.0,
        joints=(hinge("1", "world", "a", 0.0, 0.5), hinge("2", "a", "b", -0.5, None)),
    )
    start = assemble(mechanism := Mechanism.of(free))

    second = joint_coordinate(mechanism.joints[1], start.position, start.native)
    assert second == pytest.approx(-0.93, abs=0.005)

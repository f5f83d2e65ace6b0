"""A bad model is refused in one line that says what is wrong with it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mbds_xsim.report.themed import PARTS
from mbds_xsim.scene.file import read_scene
from tests.command_line import CommandLine

pytest.importorskip("mujoco")

_BODY = '<body><joint/><geom size=".1"/></body>'
_MJCF = "<mujoco><worldbody>{}</worldbody>{}</mujoco>"
_FLAT = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>'
_WORDS = '<origin xyz="1 2 three"/>'
_LINKS = (
    '<link name="a"/><link name="b"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="j" type="{}"><parent link="a"/><child link="b"/>{}</joint>'
)
_SLIDES = '<robot name="r">' + _LINKS.format("prismatic", '<axis xyz="{}"/>') + "</robot>"

_BAD = {
    "mesh": (_MJCF.format(_BODY, '<asset><mesh file="gone.stl"/></asset>'), "gone.stl"),
    "include": (_MJCF.format(_BODY, '<include file="gone.xml"/>'), "'gone.xml', which is not"),
    "cycle": (_MJCF.format(_BODY, '<include file="model.xml"/>'), "includes itself"),
    "outside": (
        _MJCF.format(_BODY, '<asset><mesh file="../outside.stl"/></asset>'),
        "import` a --folder",
    ),
    "include outside": (_MJCF.format(_BODY, '<include file="../outside.xml"/>'), "--folder"),
    "folder outside": (
        _MJCF.format(_BODY, '<compiler meshdir="/etc"/><asset><mesh file="a.stl"/></asset>'),
        "import` a --folder",
    ),
    "entities": (
        '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><mujoco model="&b;"/>',
        "defines entities",
    ),
    "external entity": (
        '<!DOCTYPE m [<!ENTITY a SYSTEM "file:///etc/passwd">]><mujoco>&a;</mujoco>',
        "defines entities",
    ),
    "depth": ("<mujoco>" + "<a>" * 10**5, "deeper than 400 levels"),
    "size": (f"<!--{'x' * 16_000_000}--><mujoco/>", "larger than 16 MB"),
    "not XML": ("<mujoco><worldbody>", "is not XML: no element found"),
    "nothing": ("", "is not XML"),
    "another format": ("<svg/>", "outermost element is <svg>"),
    "schema": (_MJCF.format('<body><joint><colour/></joint></body>', ""), "colour"),
    "no mass": (_MJCF.format("<body><joint/></body>", ""), "mass and inertia of moving bodies"),
    "inertia": (
        _MJCF.format(f'<body><joint/>{_FLAT}</body>', ""),
        "A + B >= C",
    ),
    "no bodies": (_MJCF.format("", ""), "nothing in it moves"),
    "number": (_MJCF.format(_BODY.replace(".1", "nan"), ""), "nan"),
    "place": (
        _MJCF.format(_BODY.replace("<body", '<body name="b" pos="nan 0 1"'), ""),
        "position of 'b': got [nan, 0.0, 1.0], allowed are finite numbers",
    ),
    "gain": (
        _MJCF.format(
            _BODY.replace("<joint", '<joint name="j"'),
            '<actuator><position name="p" joint="j" kp="nan"/></actuator>',
        ),
        "actuator 'p': ",
    ),
    "macro": ('<robot name="r"><xacro:include filename="a.xacro"/></robot>', "expand it first"),
    "expression": ('<robot name="r"><link name="${a}"/></robot>', "expand it first"),
    "inertia of a link": (_SLIDES.format("0 1 0").replace('ixx="1', 'ixx="nan'), "inertia of 'b'"),
    "rigid": (f'<robot name="r">{_LINKS.format("fixed", "")}</robot>', "nothing in it moves"),
    "planar": (f'<robot name="r">{_LINKS.format("planar", "")}</robot>', "the normal 1 0 0"),
    "zero axis": (_SLIDES.format("0 0 0"), "joint 'j' has the axis '0 0 0'"),
    "endless axis": (_SLIDES.format("0 inf 0"), "joint 'j' has the axis"),
    "long axis": (_SLIDES.format("0 1e200 0"), "joint 'j' has the axis '0 1e200 0'"),
    "short axis": (_SLIDES.format("0 1"), "joint 'j' has the axis '0 1'"),
    "text": (f'<robot name="r">\n{_LINKS.format("fixed", _WORDS)}</robot>', "line 2"),
    "joint": (f'<robot name="r">{_LINKS.format("screw", "")}</robot>', "invalid joint type"),
    "links": (_SLIDES.format("0 1 0").replace('"b"', '"a"'), "'r' has two links called 'a', allow"),
    "link": (
        _SLIDES.format("0 1 0").replace('parent link="a"', 'parent link="aa"'),
        "no link of the joint 'j' is called 'aa'; did you mean 'a'?",
    ),
    "itself": (
        _SLIDES.format("0 1 0").replace("<axis", '<mimic joint="j"/><axis'),
        "joint 'j' follows itself, allowed is another",
    ),
    "circle": (
        _SLIDES.format("0 1 0").replace('parent link="a"', 'parent link="b"'),
        "joints of <robot> 'r' hold links in a circle: 'b', 'b'; let one of them have another chi",
    ),
    "far": (
        _SLIDES.format("0 1 0").replace("<parent", '<origin xyz="0 0 1e9"/><parent'),
        "body 'b': position: got 1000000000.0, allowed is 1e+07 at most",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", _BAD)
def test_a_bad_model_is_one_line(name: str, run: CommandLine, here: Path) -> None:
    text, part = _BAD[name]
    (here / "model.xml").write_text(text)
    (here.parent / "outside.xml").write_text("<mujoco/>")

    refusal = run("import", "model.xml", "--out", "scene.toml").refusal

    assert refusal.startswith("mbds-xsim: model.xml: ")
    assert part in refusal
    assert "Traceback" not in refusal
    assert not (here / "scene.toml").exists()


def test_what_is_not_there_or_of_no_known_format_is_one_line(run: CommandLine, here: Path) -> None:
    (here / "model.step").write_text("ISO-10303-21;")

    assert "no such file" in run("import", "gone.urdf").refusal
    assert "no such file" in run("show", "gone.xml").refusal
    assert "there are: sdf, urdf, usd, usda, usdc, xml" in run("import", "model.step").refusal
    assert "is for URDF" in _refused_floating(run, here)


def _refused_floating(run: CommandLine, here: Path) -> str:
    (here / "model.xml").write_text(_MJCF.format(_BODY, ""))
    return run("import", "model.xml", "--floating").refusal


def test_a_crash_of_the_compiler_is_one_line(
    run: CommandLine, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mbds_xsim.base.isolate import Task
    from mbds_xsim.simulate import registry

    (here / "model.xml").write_text(_MJCF.format(_BODY, ""))
    monkeypatch.setattr(registry, "Task", lambda *_: Task(__import__("os").abort, ()))

    assert "model.xml: the process crashed with SIGABRT" in run("show", "model.xml").refusal


def test_a_folder_above_is_named_to_be_read(run: CommandLine, here: Path) -> None:
    (here / "models").mkdir()
    (here / "models" / "model.xml").write_text(_MJCF.format("", '<include file="../parts.xml"/>'))
    (here / "parts.xml").write_text(
        f"<mujocoinclude><worldbody>{_BODY}</worldbody></mujocoinclude>"
    )

    assert run("import", "models/model.xml").code == 2
    assert run("import", "models/model.xml", "--folder", ".", "--out", "scene.toml").code == 0
    assert len(read_scene(here / "scene.toml").bodies) == 1


def test_an_import_is_a_scene_file_and_a_report(run: CommandLine, here: Path) -> None:
    joint = '<joint name="hip" type="ball" limited="true" range="0 30"/>'
    (here / "leg.xml").write_text(_MJCF.format(_BODY.replace("<joint/>", joint), ""))

    ended = run(
        "import", "leg.xml", "--out", "leg.toml", "--json", "leg.json", "--markdown", "leg.md",
        "--html", "leg.html",
    )  # fmt: skip

    assert ended.code == 0
    assert "hip:" in ended.out
    report = json.loads((here / "leg.json").read_text())
    assert (report["schema"], report["bodies"]) == ("mbds-xsim/import/1", 1)
    (limits,) = (fate for fate in report["fates"] if "range" in fate["properties"])
    assert limits["outcome"] == "dropped"
    assert "as the compiler resolves it" in (here / "leg.md").read_text()
    assert f"reach {read_scene(here / 'leg.toml').length:.3g} m, " in (here / "leg.md").read_text()
    assert "reference pose" not in (here / "leg.md").read_text()
    page = (here / "leg.html").read_text()
    assert all(word in page for word in ("at its reference pose", PARTS["ball"], "1 body", "hip:"))
    shown = run("show", "leg.xml", "--toml")
    assert shown.out == (here / "leg.toml").read_text()
    lost = sum(fate["moves"] and fate["outcome"] == "dropped" for fate in report["fates"])
    kept = "all that bears on the motion is kept"
    assert (f"{lost} of what bears" if lost else kept) in shown.err


def test_what_is_fixed_in_the_world_with_its_mass_is_named(run: CommandLine, here: Path) -> None:
    """A URDF does not say whether its root floats: a cart without --floating hangs in the air."""
    body = _SLIDES.partition('<link name="b">')[2].partition("</inertial>")[0] + "</inertial>"
    heavy = _SLIDES.format("0 1 0").replace('<link name="a"/>', f'<link name="a">{body}</link>')
    for name, text in (("light", _SLIDES.format("0 1 0")), ("heavy", heavy)):
        (here / f"{name}.urdf").write_text(text)

    assert "fixed in the world" not in run("import", "light.urdf").out
    assert "freedom; fixed in the world: a" in run("import", "heavy.urdf").out
    assert "fixed" not in run("import", "heavy.urdf", "--floating").out


@pytest.mark.parametrize(
    ("low", "high", "named"),
    [(-90, 90, True), (0, 90, True), (-12.5, 12.5, False), (-1e4, 1e4, False)],
)
def test_limits_of_many_turns_are_named(
    low: float, high: float, named: bool, run: CommandLine, here: Path
) -> None:
    """Limits of a URDF in degrees are allowed, and hold nothing."""
    stops = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
    text = _SLIDES.format("0 1 0").replace("prismatic", "revolute").replace("</joint>", stops)
    (here / "arm.urdf").write_text(text)

    words = f"limits in radians, of over two turns: j, {low:g} to {high:g}"
    assert (words in " ".join(run("import", "arm.urdf").out.split())) == named


@pytest.mark.parametrize(("span", "named"), [("-30 -24", True), ("-.9 -.4", False)])
def test_a_target_past_its_joint_s_limits_is_named(
    span: str, named: bool, run: CommandLine, here: Path
) -> None:
    """MJCF's limits of hinges are in degrees, its ranges of commands are not."""
    body = '<body><joint name="j" range="-60 60"/><geom size=".1"/></body>'
    servo = f'<actuator><position joint="j" kp="9" ctrlrange="{span}"/></actuator>'
    (here / "arm.xml").write_text(_MJCF.format(body, servo))

    words = "a servo's target past its joint's limits -1.0472 to 1.0472: j, -24"
    assert (words in " ".join(run("import", "arm.xml").out.split())) == named


@pytest.mark.parametrize("ending", ["xml", "urdf", "sdf", "usda"])
def test_a_name_that_is_not_utf8_is_refused(ending: str, run: CommandLine, here: Path) -> None:
    """Readers accept no such name, and a scene file could not contain it."""
    model = here / f"{os.fsdecode(bytes([255]))}.{ending}"
    model.write_text(_MJCF.format(_BODY, ""))
    ended = run("import", str(model), "--out", "scene.toml")

    assert "got a path that is not UTF-8" in ended.refusal
    assert list(here.iterdir()) == [model]

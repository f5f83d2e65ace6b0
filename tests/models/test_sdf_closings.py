"""Joints of SDF that close loops are read, with a report on what they lose by that."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.imported import Imported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.simulate.registry import read_model

pytest.importorskip("dartpy")

_INERTIA = (
    "<inertial><pose>0.1 0.2 0.3 0 0 0</pose><mass>2</mass><inertia><ixx>1</ixx><iyy>2</iyy>"
    "<izz>2.5</izz><ixy>0.1</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
)
_LINK = '<link name="{}"><pose>{}</pose>' + _INERTIA + "</link>"
_JOINT = (
    '<joint name="{}" type="{}"><parent>{}</parent><child>{}</child><pose>{}</pose>'
    "<axis><xyz>0 1 0</xyz>{}</axis></joint>"
)
_FIRST = _JOINT.format("a", "revolute", "world", "crank", "0 0 0 0 0 0", "")
_OPEN = (
    "<pose>0 0 5 0 0 0.4</pose>"
    + _LINK.format("crank", "0 0 0 0 0 0")
    + _LINK.format("coupler", "0 0 0.2 0 0 0")
    + _LINK.format("rocker", "0.5 0 0.2 0.3 0 0")
    + _FIRST
    + _JOINT.format("b", "revolute", "crank", "coupler", "0 0 0 0 0 0", "")
    + _JOINT.format("c", "revolute", "coupler", "rocker", "0 0 0 0 0 0", "")
)
_SPAN = "<limit><lower>-1</lower><upper>2</upper></limit>"


def _read(here: Path, *inside: str) -> Imported:
    """Read models with these elements, called by numbers."""
    models = "".join(f'<model name="{k}">{each}</model>' for k, each in enumerate(inside))
    (here / "model.sdf").write_text(f'<sdf version="1.7"><world name="w">{models}</world></sdf>')
    return read_model(here / "model.sdf")


def _pin(kind: str, more: str = "", name: str = "d") -> str:
    return _JOINT.format(name, kind, "world", "rocker", "0.1 0 -0.3 0 0 0", more)


@pytest.mark.parametrize(
    ("kind", "laws", "lost"),
    [
        ("revolute", "", []),
        ("revolute", "<use_parent_model_frame>True</use_parent_model_frame>", []),
        ("ball", "", []),
        ("revolute", f"{_SPAN}<dynamics><damping>0.1</damping></dynamics>", ["damping", "lower"]),
    ],
)
def test_a_joint_that_closes_a_loop_is_read(
    here: Path, kind: str, laws: str, lost: list[str]
) -> None:
    """DART's parser keeps the first joint of a link, and skips any other."""
    imported = _read(here, _OPEN + _pin(kind, laws))

    mechanism = Mechanism.of(imported.scene)
    (loop,) = mechanism.loops
    turn, lean = (
        rotation.matrix(rotation.from_vector(np.array(v))) for v in ([0, 0, 0.4], [0.3, 0, 0])
    )
    anchor = np.array([0, 0, 5]) + turn @ ([0.5, 0, 0.2] + lean @ [0.1, 0, -0.3])
    assert (loop.name, loop.parent, loop.child) == ("d", -1, 2)
    np.testing.assert_allclose(loop.anchor, anchor, atol=1e-12)
    if kind == "revolute":
        axis = turn @ ([0, 1, 0] if "model_frame" in laws else lean @ [0, 1, 0])
        np.testing.assert_allclose(loop.axis, axis, atol=1e-12)
    dropped = [f for f in imported.fates if f.outcome == "dropped" and f.moves]
    assert [(fate.element, fate.places) for fate in dropped] == [(key, ("d",)) for key in lost]
    kept = {fate.element for fate in imported.fates if fate.outcome == "kept"}
    assert not kept & {"damping", "lower", "upper"}, "both dropped, and kept as none or zero"


@pytest.mark.parametrize(("kind", "child"), [("universal", "rocker"), ("fixed", "nothing")])
def test_a_skipped_joint_that_cannot_close_a_loop_is_told(
    here: Path, kind: str, child: str
) -> None:
    more = "<axis2><xyz>0 0 1</xyz></axis2>" if kind == "universal" else ""
    pin = _JOINT.format("d", kind, "world", child, "0 0 0 0 0 0", "")
    imported = _read(here, _OPEN + pin.replace("</joint>", f"{more}</joint>"))

    told = [f for f in imported.fates if f.element == "joint" and f.outcome == "dropped"]
    assert [fate.places for fate in told] == [("d",)]


def test_a_joint_that_closes_a_loop_may_have_any_name(here: Path) -> None:
    """DART calls the free joint of a link without one "root"."""
    floating = _OPEN.replace(_FIRST, "")
    imported = _read(here, floating + _pin("ball", name="root"))

    assert [joint.name for joint in imported.scene.joints] == ["b", "c", "root"]


def test_a_joint_without_axis_loses_nothing_by_closing_a_loop(here: Path) -> None:
    dropped = [f for f in _read(here, _OPEN + _pin("fixed", _SPAN)).fates if f.outcome == "dropped"]

    assert dropped == []


def test_an_axis_that_closes_a_loop_and_is_no_direction_is_named(here: Path) -> None:
    pin = _pin("revolute").replace("0 1 0", "0 0 0")

    with pytest.raises(InputError, match="joint 'd': axis: got"):
        _read(here, _OPEN + pin)


def test_a_joint_that_follows_one_that_closes_a_loop_follows_none_of_another_model(
    here: Path,
) -> None:
    follower = _OPEN.replace("</axis>", '<mimic joint="d"/></axis>', 1)
    other = _OPEN.replace('<joint name="a"', '<joint name="d"')
    imported = _read(here, follower + _pin("revolute"), other)

    assert not imported.scene.couplings
    assert [(f.outcome, f.places) for f in imported.fates if f.element == "mimic"] == [
        ("dropped", ("a",))
    ]


def test_a_joint_between_links_that_are_one_body_closes_no_loop(here: Path) -> None:
    tip = _LINK.format("tip", "0 0 0 0 0 0")
    fixed, again = (
        _JOINT.format(name, kind, "crank", "tip", "0 0 0 0 0 0", "")
        for name, kind in (("f", "fixed"), ("d", "revolute"))
    )
    imported = _read(here, _OPEN + tip + fixed + again)

    assert imported.facts.loops == 0
    assert [(f.outcome, f.moves) for f in imported.fates if f.places == ("d",)] == [
        ("dropped", False)
    ]

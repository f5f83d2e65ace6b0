"""Campaign: models with anything in them are read, or refused in one deliberate line."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest
from hypothesis import strategies as st

from mbds_xsim.simulate.registry import read_model
from tests.fuzz.campaign import fuzz, refused

pytest.importorskip("mujoco")

_SOUND = [
    *sorted((Path(__file__).parents[1] / "models" / "losses").iterdir()),
    Path(__file__).with_name("grounded.sdf"),
]
_VALUES = st.one_of(
    st.sampled_from(["", " ", "0", "-1", "nan", "inf", "1e300", "1e-300", "1 2", "0 0 0", "true"]),
    st.sampled_from(["world", "\x7f", "é" * 300, "1,2,3", "../../x", "a\nb", "${a}", "fixed"]),
    st.floats().map(repr),
    st.text(st.characters(min_codepoint=32, exclude_categories=["Cs"]), max_size=8),
)
_ACCIDENT = re.compile(r"^\S+: (\w+(Error|Exception|Warning)\b|the process crashed)")


def _elements(root: Element) -> list[Element]:
    return list(root.iter())


@st.composite
def changed(draw: st.DrawFn) -> tuple[str, str]:
    """Draw a sound model with up to four of its elements and attributes changed or moved."""
    path = draw(st.sampled_from(_SOUND))
    root = ElementTree.parse(path).getroot()
    for _ in range(draw(st.integers(1, 4))):
        element = draw(st.sampled_from(_elements(root)))
        match draw(st.sampled_from(["set", "set", "set", "drop", "twice", "add", "move", "tag"])):
            case "set" if element.attrib:
                element.set(draw(st.sampled_from(sorted(element.attrib))), draw(_VALUES))
            case "drop" if len(element):
                element.remove(draw(st.sampled_from(list(element))))
            case "twice" if len(element):
                element.append(copy.deepcopy(draw(st.sampled_from(list(element)))))
            case "add":
                element.set(
                    draw(st.sampled_from(["name", "ref", "limited", "type"])), draw(_VALUES)
                )
            case "move" if len(element):
                other = draw(st.sampled_from(_elements(root)))
                other.append(copy.deepcopy(draw(st.sampled_from(list(element)))))
            case "tag":
                element.tag = draw(st.sampled_from([each.tag for each in _elements(root)]))
            case _:
                continue
    return path.suffix, ElementTree.tostring(root, encoding="unicode")


@fuzz("robot", model=changed())
def test_a_changed_model_is_read_or_refused(model: tuple[str, str], tmp_path_factory: Any) -> None:
    suffix, text = model
    path = tmp_path_factory.getbasetemp() / f"changed{suffix}"
    path.write_text(text, "utf-8")

    line = refused(lambda: read_model(path, ground="<collision" in text))

    assert "\n" not in line
    assert not _ACCIDENT.match(line.removeprefix(str(path.parent))), line

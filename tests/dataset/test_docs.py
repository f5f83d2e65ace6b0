"""The page about the layout lists the datasets as the program has them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import h5py
import pytest

from mbds_xsim import reference
from mbds_xsim.dataset.foreign import FACTS
from mbds_xsim.dataset.gate import COLUMNS
from mbds_xsim.dataset.layout import FIELDS, VERSION
from mbds_xsim.dataset.table import groups
from mbds_xsim.simulate.registry import load_scene

from .conftest import Make

PAGE = Path(__file__).parents[2] / "docs" / "dataset-layout.md"
BEGIN, END = "<!-- fields -->\n", "<!-- end of fields -->"


def _tree() -> str:
    """The annotated tree: python tests/dataset/test_docs.py writes it into the page."""
    lines, group = [], ""
    for field in FIELDS.values():
        head, _, name = field.name.rpartition("/")
        if head and head != group:
            lines.append(f"{head}/")
        group = head
        shape = ", ".join(field.axes)
        unit = f" [{field.unit}]" if field.unit not in ("", "1") else ""
        kinds = "" if "shard" in field.kinds else f" ({', '.join(field.kinds)} only)"
        label = ("    " if head else "") + name
        kind = field.dtype.lstrip("<|")
        lines.append(f"{label:<22} {kind:<5} ({shape})")
        lines.append(f"{'':<28} {field.meaning}{unit}{kinds}")
    return "```\n" + "\n".join(lines) + "\n```\n"


def test_the_tree_is_the_layout_s() -> None:
    text = PAGE.read_text("utf-8")
    assert text[text.index(BEGIN) + len(BEGIN) : text.index(END)] == _tree()


def test_every_attribute_is_explained(whole: Path) -> None:
    text = PAGE.read_text("utf-8")
    table = text[text.index("Attributes of a file:") : text.index("There are no times")]
    with h5py.File(whole / "1pendulum/mujoco-matched.h5") as file:
        missing = [key for key in file.attrs if f"`{key}`" not in table]
    assert missing == []
    assert f"`mbds-xsim data` and {VERSION};" in table


def test_columns_are_checks_of_the_page_about_checks() -> None:
    page = (PAGE.parent / "checks.md").read_text("utf-8").lower()
    assert [name for name in COLUMNS if name not in page] == []


def test_columns_of_an_audit_are_explained() -> None:
    """The page explains every array with its first column, and every fact."""
    page = (PAGE.parent / "data-commands.md").read_text("utf-8")
    table = page[page.index("| array |") : page.index("`time` and one of")]
    for group in groups(load_scene("particlecar")):
        row = next(line for line in table.splitlines() if f"`{group.name}`" in line)
        assert f"`{group.columns.flat[0]}`" in row
    facts = page[page.index("| fact |") : page.index("**Inputs.**")]
    assert [fact for fact in FACTS if f"`{fact}`" not in facts] == []


def _code(page: str) -> str:
    text = (PAGE.parent / page).read_text("utf-8")
    return "\n".join(re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S))


def test_own_motions_are_audited_as_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def simulated(*about: Any) -> tuple[Any, Any]:
        motion = reference.solve(*about)
        return motion.position, motion.orientation

    monkeypatch.chdir(tmp_path)
    exec(_code("data-commands.md"), {"my_simulator": simulated})
    assert capsys.readouterr().out.split() == ["pass"]


def test_data_are_loaded_as_the_page_says(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "data", settings="matched,native")
    monkeypatch.chdir(tmp_path)
    code = _code("load-data.md").replace("6pendulum", "1pendulum").replace("512", "32")
    exec(code.replace(', split="test"', ""), {})
    assert (tmp_path / "apart.png").is_file()


if __name__ == "__main__":
    page = PAGE.read_text("utf-8")
    head, rest = page.split(BEGIN)
    PAGE.write_text(head + BEGIN + _tree() + END + rest.split(END)[1], "utf-8")

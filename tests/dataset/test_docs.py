"""The page about the layout lists the datasets as the program has them."""

from __future__ import annotations

from pathlib import Path

import h5py

from mbds_xsim.dataset.foreign import FACTS
from mbds_xsim.dataset.gate import COLUMNS
from mbds_xsim.dataset.layout import FIELDS, VERSION
from mbds_xsim.dataset.table import groups
from mbds_xsim.simulate.registry import load_scene

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


if __name__ == "__main__":
    page = PAGE.read_text("utf-8")
    head, rest = page.split(BEGIN)
    PAGE.write_text(head + BEGIN + _tree() + END + rest.split(END)[1], "utf-8")

"""Names in a scene are plain text: in terminals, logs, Markdown, CSV, cards and pages."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbds_xsim.base.files import read_file
from mbds_xsim.base.text import as_code, csv_text, in_markdown, sentence
from mbds_xsim.learn.shift.result import Shift
from mbds_xsim.report.files import to_html, to_markdown
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.studies.shift import present as shifts
from mbds_xsim.studies.tradeoff import present as tradeoff
from mbds_xsim.studies.tradeoff import read_tradeoff
from tests.command_line import CommandLine

_REPORTS = Path(__file__).parents[2] / "reports"
_EVIL = '[red]a[/x] $\\bad$ \x1b[31m\x9b2J\u202e | `b` <script>alert(1)</script> ![i](u) & "c"'
_NAME = _EVIL.replace("\x1b", "").replace("\x9b", "")  # names may not have these
_SCENE = Scene(
    name=f"=cmd() {_NAME}",
    description=f"{_EVIL}\n# big\n\n| --- | --- |",
    source=_EVIL,
    bodies=(
        Body(name=f"=b {_NAME}", inertia=Inertia(1.0, (0.1, 0.1, 0.1)), position=(0.0, 0.0, -1.0)),
    ),
    joints=(Joint(f"j {_NAME}", "hinge", "world", f"=b {_NAME}", (0.0, 0.0, 0.0), axis=(0, 1, 0)),),
    length=1.0,
    noise=0.0,
    clock=Clock(frame=0.02, steps=10),
    anchors=((0.0, 0.0, 0.0),),
)
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")

_MUJOCO = ("--engines", "mujoco", "--workers", "1")
_FORMS = ("--json", "out.json", "--html", "out.html", "--markdown", "out.md")
_DATA = "data/*/mujoco-matched.h5"
_COMMANDS = (
    ("show", "evil.toml", "--png", "out.png"),
    ("show", "evil.toml", "--json", "-"),
    ("validate", "evil.toml", *_MUJOCO, *_FORMS),
    ("validate", "evil.toml", "--engines", "mujoco", "--method", "RK5"),
    ("diff", "out.json", "out.json", "--markdown", "out.md"),
    ("plan", "evil.toml", *_MUJOCO, "--sample", "2"),
    ("generate", "evil.toml", *_MUJOCO, "--trajectories", "1", "--out", "data"),
    ("verify", "data", "--workers", "1"),
    ("inspect", "data", "--png", "out.png"),
    ("export", "data", "--out", "csv", "--format", "csv"),
    ("audit", _DATA),
    ("audit", _DATA, "--scene", "2pendulum"),
    ("validate", "no\x1b[31m[/x].toml"),
)  # fmt: skip


@pytest.fixture
def written(here: Path) -> Path:
    save_scene(_SCENE, here / "evil.toml")
    return here


@pytest.mark.slow
def test_no_command_obeys_the_text_of_a_scene(run: CommandLine, written: Path) -> None:
    for words in _COMMANDS:
        paths = [str(next(written.glob(word))) if "*" in word else word for word in words]
        ended = run(*paths)

        assert ended.code in (0, 1) or words[-1] in ("RK5", "2pendulum", words[1]), ended.err
        assert not _OBEYED.search(ended.out + ended.err), words
        if words[0] in ("show", "validate", "verify", "inspect", "audit") and not ended.code:
            assert "[red]a[/x]" in ended.out, words
        for file in written.glob("**/*.*"):
            _check(file)


def test_texts_of_studies_are_escaped() -> None:
    stored = read_tradeoff(_REPORTS / "tradeoff" / "2ladder.json")
    evil = msgspec.structs.replace(
        stored, scene=_EVIL, description="", left_out={_EVIL: f"{_EVIL}\n# big"}
    )
    content = read_file(_REPORTS / "shift" / "6pendulum.json.gz")
    shift = msgspec.json.decode(content, type=Shift)

    shift = msgspec.structs.replace(shift, scene=_EVIL, left_out={"": _EVIL})
    reports = [tradeoff.present(evil), shifts.present(shift)]
    markdown = to_markdown(reports)
    _check_markdown(markdown)
    assert "<script>alert" not in markdown + to_html(reports, _EVIL)


@given(st.text())
def test_a_cell_of_csv_is_text_and_numbers_stay(text: str) -> None:
    ((cell, number),) = csv.reader(io.StringIO(csv_text([[text, -1.5e-3]]), newline=""))

    assert not cell.lstrip().startswith(("=", "+", "-", "@")) or float(cell) is not None
    assert number == "-0.0015"
    assert not _OBEYED.search(cell)


@given(st.text())
def test_a_code_span_ends_where_it_should(text: str) -> None:
    code = as_code(text)
    fence = re.match("`+", code)

    assert fence
    assert code.endswith(fence[0])
    assert not re.search(f"(?<!`){fence[0]}(?!`)", code[len(fence[0]) : -len(fence[0])])


@pytest.mark.parametrize(
    ("name", "written"),
    {
        "_a_ and __b__": "&#95;a&#95; and &#95;&#95;b&#95;&#95;",
        "___": "&#95;&#95;&#95;",
        "_ _ _": "&#95; &#95; &#95;",
        "R_ij, mbd__node, größe_2": "R_ij, mbd__node, größe_2",
        "1. rod": "&#49;. rod",
        "12) rod": "&#49;2) rod",
        "1.": "&#49;.",
        "1.5 rods": "1.5 rods",
        "[a] b": "&#91;a] b",
    }.items(),
)
def test_names_are_no_markup_of_markdown(name: str, written: str) -> None:
    assert in_markdown(name) == written


def test_brackets_of_a_name_do_not_end_the_description_of_a_picture() -> None:
    stored = read_tradeoff(_REPORTS / "tradeoff" / "2ladder.json")
    named = msgspec.structs.replace(stored, scene="a]b[c")
    report = dataclasses.replace(tradeoff.present(named), picture="a.png")

    (line,) = [line for line in to_markdown([report]).splitlines() if line.startswith("![")]

    assert line.startswith("![a&#93;b&#91;c")
    assert line.endswith("](a.png)")
    assert (line.count("["), line.count("]")) == (1, 1)


def test_sentences_and_results_are_copied_whole() -> None:
    copied = in_markdown(("a", {"b|": [1.5, "# c"]}, None))

    assert copied == ("a", {"b&#124;": [1.5, "&#35; c"]}, None)
    assert sentence("") == ""
    assert sentence("a chain") == "A chain. "


def _check(file: Path) -> None:
    """Read a file as its readers do."""
    if file.suffix not in (".md", ".csv", ".html"):
        return
    text = file.read_text("utf-8")
    assert not _OBEYED.search(text), file
    if file.suffix != ".csv":
        assert "<script>alert" not in text, file
    if file.suffix == ".md":
        _check_markdown(text)
    if file.suffix == ".csv":
        cells = [cell for row in csv.reader(text.splitlines()) for cell in row]
        assert not [cell for cell in cells if cell.startswith(("=", "+", "@"))], file


def _check_markdown(text: str) -> None:
    assert "![i](u)" not in text
    assert "\n# big" not in text
    assert re.findall("(?<!`)`b`", text) == []
    for table in _tables(text):
        assert len({len(line.split("|")) for line in table}) == 1, table


def _tables(text: str) -> Iterator[list[str]]:
    for part in re.split(r"\n(?!\|)", text):
        lines = [line for line in part.split("\n") if line.startswith("|")]
        if lines:
            yield lines

"""Files that are compared: bad ones, other scenes, and names of any kind."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from mbds_xsim.commands.shared import command_line
from tests.cli import stored
from tests.cli.stored import Compare, Edit
from tests.command_line import CommandLine


def test_the_command_that_is_told_compares_again(run: CommandLine, here: Path) -> None:
    (here / "old one.json").write_text(json.dumps(stored.match()))
    (here / "new.json").write_text(json.dumps(stored.match()))

    run("diff", "old one.json", "new.json", "--factor", "3", "--markdown", "diff.md")

    assert "`mbds-xsim diff 'old one.json' new.json --factor 3.0`" in (here / "diff.md").read_text()


_FILES: dict[str, tuple[bytes, str]] = {
    "missing": (b"", "cannot read new.json: No such file"),
    "empty": (b" ", "is not JSON, or was cut short"),
    "truncated": (stored.KEPT.read_bytes()[:-100], "is not JSON, or was cut short"),
    "not text": (b"\x89PNG\r\n\x1a\n\xff\xfe", "is not JSON, or was cut short"),
    "nested without end": (b"[" * 100_000, "is not JSON, or was cut short"),
    "foreign": (b'{"name": "x"}', "has no schema; compared are mbds-xsim/<command>/1"),
    "a number": (b"3", "has no schema"),
    "an empty list": (b"[]", "holds an empty list"),
    "a schema of later": (b'{"schema": "mbds-xsim/validate/2"}', "schema 'mbds-xsim/validate/2'"),
    "a schema of no text": (b'{"schema": [1]}', "schema [1]"),
    "hollow": (b'{"schema": "mbds-xsim/validate/1"}', "missing required field `scene`"),
    "a number beyond all": (
        b'{"schema": "mbds-xsim/audit/1", "gap_m": 1' + b"0" * 400 + b"}",
        "is not what mbds-xsim/audit/1 stands for: int too large",
    ),
    "no releases": (
        json.dumps(stored.history() | {"releases": []}).encode(),
        "is not what mbds-xsim/releases/1 stands for: tuple index out of range",
    ),
    "another command's": (json.dumps(stored.match()).encode(), "give two of the same"),
}


@pytest.mark.parametrize("kind", _FILES)
def test_bad_files_are_one_line(run: CommandLine, here: Path, kind: str) -> None:
    content, message = _FILES[kind]
    if content:
        (here / "new.json").write_bytes(content)

    ended = run("diff", str(stored.KEPT), "new.json", "--json", "diff.json")

    assert ended.code == 2
    assert message in ended.err
    assert ended.err.count("\n") == 1
    assert not (here / "diff.json").exists()


def test_what_has_no_end_is_not_read_to_it(run: CommandLine) -> None:
    ended = run("diff", "/dev/zero", "/dev/zero")

    assert ended.code == 2
    assert ended.err == (
        "mbds-xsim: /dev/zero: got more than 100 MB, the largest results take 10 MB\n"
    )


def test_a_scene_of_other_physics_is_refused(compare: Compare) -> None:
    result = stored.match() | {"fingerprint": "a" * 16}

    other, _ = compare(result, lambda new: new.update(fingerprint="b" * 16))
    unknown, _ = compare(result, lambda new: new.update(fingerprint=""))

    assert other.code == 2
    assert "pair is not the same scene in both files: fingerprint is aaaa" in other.err
    assert unknown.code == 0


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda data: data.update(scene="2ladder"), "is about 3ladder and new.json about 2ladder"),
        (lambda data: data.update(length_m=2.0), "not the same scene in both files: length [m]"),
        (lambda data: data["engines"].append(data["engines"][0]), "has 'dart matched' twice"),
        (lambda data: data["engines"][0].update(step_s="x"), "$.engines[0].step_s"),
    ],
)
def test_other_scenes_are_refused(compare: Compare, edit: Edit, said: str) -> None:
    ended, data = compare(stored.validation(), edit)

    assert (ended.code, data) == (2, {})
    assert said in ended.err
    assert ended.err.count("\n") == 1


def test_names_of_files_that_are_no_utf_8_are_told(run: CommandLine, here: Path) -> None:
    name = os.fsdecode(b"\xff.json")
    (here / name).write_text(json.dumps(stored.match()))

    ended = run("diff", name, name, "--json", "diff.json", "--markdown", "diff.md")

    assert ended.code == 0
    assert json.loads((here / "diff.json").read_text())["old"] == "\\udcff.json"


def test_a_command_with_such_a_name_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["mbds-xsim", "validate", os.fsdecode(b"\xff.toml")])

    assert command_line().encode() == b"mbds-xsim validate '\\udcff.toml'"

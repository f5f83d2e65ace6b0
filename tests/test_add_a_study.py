"""The example study of the page on adding a study does what the page says."""

from __future__ import annotations

import importlib
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from mbds_xsim.report.files import to_markdown
from tests import test_layout as layout

_PAGE = Path(__file__).parents[1] / "docs" / "add-a-study.md"
_MOST_LINES = 120


@pytest.fixture
def example(tmp_path: Path) -> Path:
    path = tmp_path / "gravity.py"
    path.write_text(_block("python"), "utf-8")
    return path


def _block(kind: str) -> str:
    (text,) = re.findall(rf"^```{kind}\n(.*?)^```$", _PAGE.read_text("utf-8"), re.M | re.S)
    return str(text)


@pytest.mark.slow
def test_the_example_answers_its_question_and_measures_once(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = shlex.split(_block("sh"))
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(example.parent)
    gravity = importlib.import_module("gravity")
    try:
        monkeypatch.setattr(gravity, "error", math.factorial)
        failed = gravity.main(workers=2)
        printed = subprocess.check_output(
            [sys.executable, *command[1:]], cwd=example.parent, text=True
        )
        monkeypatch.setattr(gravity, "error", None)
        again = gravity.main(workers=0)
    finally:
        sys.modules.pop("gravity", None)

    table = to_markdown([again])
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| mujoco")]
    assert shlex.split(again.command) == command
    assert "mujoco Euler at 1.6 m/s²: TypeError" in failed.conclusion
    assert [row[0] for row in rows] == ["| mujoco Euler", "| mujoco RK4"]
    euler, rk4 = (float(row[-1].rstrip(" |")) for row in rows)
    assert 0.0 < euler < rk4  # an error of higher order grows faster
    assert again.conclusion in printed


def test_the_example_keeps_the_rules_of_the_package(
    example: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(layout._MODULES, "mbds_xsim.studies.gravity", example)

    layout.test_no_class_name_stands_twice()
    layout.test_docstrings_stand_alone()
    assert len(_block("python").splitlines()) <= _MOST_LINES

"""The example study of the page on adding a study does what the page says."""

from __future__ import annotations

import importlib
import os
import re
import sys
from pathlib import Path

import pytest

from mbds_xsim.report.files import to_markdown

_PAGE = Path(__file__).parents[1] / "docs" / "add-a-study.md"
_MOST_LINES = 120


@pytest.mark.slow
def test_the_example_answers_its_question_and_measures_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```$", _PAGE.read_text("utf-8"), re.M | re.S)
    (tmp_path / "gravity.py").write_text(code, "utf-8")
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.getcwd()]))
    monkeypatch.syspath_prepend(tmp_path)
    gravity = importlib.import_module("gravity")
    try:
        first = gravity.main(workers=2)
        monkeypatch.setattr(gravity, "error", None)
        again = gravity.main(workers=0)
    finally:
        sys.modules.pop("gravity", None)

    table = to_markdown([first])
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| mujoco")]
    assert len(code.splitlines()) <= _MOST_LINES
    assert [row[0] for row in rows] == ["| mujoco Euler", "| mujoco RK4"]
    euler, rk4 = (float(row[-1].rstrip(" |")) for row in rows)
    assert 0.0 < euler < rk4  # an error of higher order grows faster
    assert to_markdown([again]) == table

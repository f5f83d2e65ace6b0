"""What the tutorials say happens, happens."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tutorial import walk


@pytest.mark.slow
@pytest.mark.usefixtures("in_process", "search")
@pytest.mark.parametrize("page", ["validate.md", "data.md", "robot.md"])
def test_a_tutorial_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    walk(page)

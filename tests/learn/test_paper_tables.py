"""The page of the paper's tables has every cell, with the figures of the stored studies."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper_tables import main

_REPORTS = Path(__file__).parents[2] / "reports"
_CELLS = {1: 8 * 4, 2: 8 * 4, 3: 5 * 4, 4: 3 * 4}


def test_every_cell_is_a_figure_or_says_why_there_is_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main([_REPORTS / "shift", _REPORTS / "lite"])
    page = capsys.readouterr().out

    for number, table in enumerate(page.split("\n## ")[1:], 1):
        rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line[:2] == "| "]
        heads, rows = rows[0], rows[2:]
        assert len(rows) == _CELLS[number]
        for row in rows:
            for head, text in zip(heads[2:], row[2:], strict=True):
                words = () if "paper" in head else ("refused", "no study yet")
                assert text in words or float(text.removesuffix(" *")) > 0
    assert "- scene 'balldrop': got 1 contact spheres" in page


def test_a_cell_is_the_mean_at_home_of_the_study_with_most_steps(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main([_REPORTS / "shift", _REPORTS / "lite"])
    first = capsys.readouterr().out.split("\n## ")[1]
    (line,) = [line for line in first.splitlines() if line.startswith("| 6pendulum | LGNN")]

    study = json.loads(gzip.decompress((_REPORTS / "lite/6pendulum.json.gz").read_bytes()))
    errors = [
        cell["mse"][study["frames"].index(1)]
        for cell in study["cells"]
        if (cell["model"], cell["interval"]) == ("lgnn", "all") and cell["training"] == cell["test"]
    ]
    assert float(line.strip("| ").split(" | ")[-1]) == pytest.approx(np.mean(errors), rel=0.05)

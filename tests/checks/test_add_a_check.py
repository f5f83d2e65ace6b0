"""The example check of docs/add-a-check.md does what the page says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from mbds_xsim.checks.record import Record
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_scene

_PAGE = Path(__file__).parents[2] / "docs" / "add-a-check.md"


def _record(scene: Scene) -> Record:
    batch = draw_batch(scene, [0, 1])
    return Record(scene, batch, solve(scene, batch))


def test_the_example_finds_who_rises_too_high() -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```$", _PAGE.read_text("utf-8"), re.M | re.S)
    names: dict[str, Any] = {}
    exec(code, names)
    height, record = names["height"], _record(load_scene("balldrop"))

    finding = height.finding(record)

    highest = record.trajectory.position[..., 2].max(axis=(1, 2))
    np.testing.assert_allclose(finding.figure, highest)
    assert finding.passed.tolist() == (highest <= 10.0).tolist()
    assert height(_record(load_scene("1pendulum"))) is None

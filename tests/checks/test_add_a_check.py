"""The example check of docs/add-a-check.md does what the page says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbds_xsim.checks.record import Record
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import load_scene

_PAGE = Path(__file__).parents[2] / "docs" / "add-a-check.md"
_CODE = re.findall(r"^```python\n(.*?)^```$", _PAGE.read_text("utf-8"), re.M | re.S)


def _record(scene: Scene) -> Record:
    batch = draw_batch(scene, [0, 1])
    return Record(scene, batch, solve(scene, batch))


def test_the_example_finds_who_rises_too_high() -> None:
    names: dict[str, Any] = {}
    exec(_CODE[0], names)
    height, record = names["height"], _record(load_scene("balldrop"))

    finding = height.finding(record)

    highest = record.trajectory.position[..., 2].max(axis=(1, 2))
    np.testing.assert_allclose(finding.figure, highest)
    assert finding.passed.tolist() == (highest <= 10.0).tolist()
    assert height(_record(load_scene("1pendulum"))) is None


@pytest.mark.usefixtures("here")
def test_a_script_calls_it_on_a_published_set(capsys: pytest.CaptureFixture[str]) -> None:
    choice = Choice.parse(engines="mujoco", profiles="matched")
    request = Request((load_scene("balldrop"),), choice, 10, Path("data"))
    generate(request, workers=0)
    exec("\n".join(_CODE), {})
    assert re.match(r"\[ *True.*\] height: \d", capsys.readouterr().out.splitlines()[-1])

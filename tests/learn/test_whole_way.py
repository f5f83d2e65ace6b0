"""The tutorial on robustness: data of two engines, models, the change of engine, a page."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import pytest

from benchmarks.shift_summary import rows_of
from mbds_xsim.learn.model_file import read_facts
from mbds_xsim.learn.shift.result import Shift
from tests.tutorial import walk

ENGINES = ("mujoco", "pybullet")


@pytest.mark.slow
def test_generate_train_shift_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    walk("shift.md")
    trained = sorted(Path("models").rglob("*.pt"))
    assert [path.stem for path in trained] == ["mujoco-s0", "pybullet-s0"]
    assert {read_facts(path)["ended"] for path in trained} == {"steps"}
    shift = msgspec.json.decode(Path("shift.json").read_bytes(), type=Shift)
    at = shift.frames.index(10)
    cells = {(c.model, c.training, c.test): c for c in shift.cells if c.interval == "all"}
    formulas = ("hold", "constant_velocity", "constant_acceleration")
    for domain in (f"{engine}-native" for engine in ENGINES):
        trivial = min(cells[name, "nothing", domain].mse[at] or math.inf for name in formulas)
        own = cells["gns", domain, domain]
        error = own.mse[at]
        print(f"{domain}: {error} m², the best formula {trivial} m²")
        assert own.diverged[at] == 0
        assert error is not None
        assert error < 0.3 * trivial
    assert all(answer.answer for answer in shift.answers)
    ((scene, variant, model, beside_formula, *_),) = rows_of(shift, shift.scene)
    assert (scene, variant, model) == ("[1pendulum](1pendulum.md), t = 10", "native", "gns")
    assert float(beside_formula) < 0.3
    text = Path("shift.html").read_text()
    assert "1pendulum" in text
    assert text.count("<svg") >= len(shift.frames)
    viewer = text.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    assert json.loads(viewer)["frames"] > 10

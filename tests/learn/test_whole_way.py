"""The whole way through the commands: data of two engines, models, the change of engine, a page."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import pytest

from benchmarks.shift_summary import rows_of
from mbds_xsim.commands import app
from mbds_xsim.learn.saved import read_facts
from mbds_xsim.learn.shift.result import Shift

ENGINES = ("mujoco", "pybullet")


def _run(*words: str | Path) -> None:
    assert not app([str(word) for word in words], standalone_mode=False)


@pytest.mark.slow
def test_generate_train_shift_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    data, models = tmp_path / "data", tmp_path / "models"
    _run(
        "generate", "1pendulum", "--engines", ",".join(ENGINES), "--settings", "native",
        "--trajectories", "90", "--workers", "1", "--out", data,
    )  # fmt: skip
    _run(
        "train", data, "--models", "gns", "--on", "each", "--seeds", "1", "--profile",
        "smoke", "--workers", "1", "--out", models,
    )  # fmt: skip
    trained = sorted(models.rglob("*.pt"))
    assert [path.stem for path in trained] == ["mujoco-s0", "pybullet-s0"]
    assert {read_facts(path)["ended"] for path in trained} == {"steps"}
    page, told = tmp_path / "shift.html", tmp_path / "shift.json"
    _run("shift", models, data, "--workers", "1", "--html", page, "--json", told)
    shift = msgspec.json.decode(told.read_bytes(), type=Shift)
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
    text = page.read_text()
    assert "1pendulum" in text
    assert text.count("<svg") >= len(shift.frames)
    viewer = text.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    assert json.loads(viewer)["frames"] > 10

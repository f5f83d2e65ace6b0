"""Trade-offs of a small scene at few steps."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import timed
from tests.study.tradeoffs import shortened


@pytest.fixture
def few_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep rows and references apart, and try few steps."""
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff.COUNTS", (1, 2, 5, 10, 20))
    monkeypatch.setattr("mbds_xsim.studies.tradeoff._THIN", (5,))
    monkeypatch.setattr(timed, "_ENOUGH", 0.01)


@pytest.fixture
def scene() -> Scene:
    """A smooth scene, cut short."""
    return shortened("2pendulum", 20)

"""The survey of published models goes on where it was, and explains every failed verdict."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from benchmarks.models_in_the_wild import Cause, SurveyRow

ROOT = Path(__file__).parents[2]
PENDULUM = """\
<mujoco><worldbody><body pos="0 0 1"><joint type="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" size="0.05 0.2" pos="0 0 -0.2"/></body></worldbody></mujoco>
"""


def survey(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.models_in_the_wild", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)


def test_every_failed_verdict_has_a_cause_and_every_cause_a_verdict() -> None:
    stored = ROOT / "reports" / "wild"
    rows = msgspec.json.decode((stored / "models.json").read_bytes(), type=list[SurveyRow])
    by_hand = (stored / "causes.toml").read_bytes()
    causes = msgspec.toml.decode(by_hand, type=dict[str, list[Cause]])["causes"]
    failed = [
        (row, engine)
        for row in rows
        for engine, verdict in row.verdicts.items()
        if verdict in ("fail", "crashed")
    ]
    assert not [
        (row.path, engine)
        for row, engine in failed
        if not any(cause.explains(row, engine) for cause in causes)
    ]
    assert not [
        cause.models
        for cause in causes
        if not any(cause.explains(row, engine) for row, engine in failed)
    ]


@pytest.mark.slow
def test_survey_of_a_folder_goes_on_where_it_was(tmp_path: Path) -> None:
    packages, found = tmp_path / "packages", tmp_path / "found.json"
    (packages / "arms").mkdir(parents=True)
    (packages / "arms" / "pendulum.xml").write_text(PENDULUM)
    (packages / "arms" / "broken.xml").write_text(PENDULUM.replace("hinge", "hedge"))
    first = survey(packages, found, "--validate", 1)
    broken, pendulum = msgspec.json.decode(found.read_bytes(), type=list[SurveyRow])
    assert "hedge" in broken.refused
    assert pendulum.verdicts == dict.fromkeys(("mujoco", "pybullet", "dart", "exudyn"), "pass")
    assert pendulum.readers["mujoco"] == "alike"
    assert "validated 1/1 arms/pendulum.xml" in first.stderr

    again = survey(packages, found, "--validate", 1)
    assert not again.stderr
    (tmp_path / "causes.toml").write_text("causes = []\n")
    assert "1 of 2 files are imported" in survey(found).stdout

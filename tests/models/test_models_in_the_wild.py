"""The survey of published models resumes where it was, and explains every failed verdict."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from benchmarks.survey import Cause, SurveyRow, linked, write_wheels
from mbds_xsim.scene.imported import Fate
from mbds_xsim.studies.readers import Difference

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


def test_every_model_has_a_section_of_its_own_that_the_table_links_to(tmp_path: Path) -> None:
    difference = Difference("inertia", "links", 2, 3, "shank", "0.1", "0.2")
    rows = [
        SurveyRow("1", "arms", "arms/a_1/r.urdf", "URDF", bodies=2, degrees_of_freedom=2, kept=5,
                  lost=(Fate("mesh", (), "dropped", "a reason", True, count=4),),
                  readers={"mujoco": "alike", "pybullet": "inertia"}, moved_m={"pybullet": 0.02},
                  differences={"pybullet": (difference,)},
                  verdicts={"mujoco": "pass", "dart": "fail"}, reasons={"dart": "energy: 2"}),
        SurveyRow("2", "arms", "arms/b/r.urdf", refused="no such mesh"),
        SurveyRow("3", "legs", "legs/b/r.urdf", "URDF", bodies=1),
    ]  # fmt: skip
    causes = [Cause("arms/*", "dart", "energy", "too long a step")]

    write_wheels(rows, causes, tmp_path)

    links = [re.search(r"\]\((\w+\.md)#(\S+)\)$", linked(row)) for row in rows]
    targets = [(link[1], link[2]) for link in links if link]
    assert targets == [("arms.md", "a_1rurdf"), ("arms.md", "brurdf"), ("legs.md", "brurdf")]
    arms, legs = ((tmp_path / name).read_text() for name in ("arms.md", "legs.md"))
    assert arms.count("\n## ") == 2
    for line in (
        "- dropped, 4 × mesh: a reason",
        "- mujoco's own reader: as the file says",
        "- pybullet's own reader: inertia of 2 of 3 links (shank has 0.1, the file says 0.2); "
        "after 1 s bodies are 20 mm off",
        "- dart's own reader: not run",
        "- passes in: mujoco",
        "- in dart: fail; energy: 2; too long a step",
        "- not imported: no such mesh",
    ):
        assert f"{line}\n" in arms
    assert "- kept and lost: not run\n" in legs
    assert "- verdicts: not run\n" in legs


def test_no_two_models_of_a_wheel_share_a_link() -> None:
    stored = (ROOT / "reports" / "wild" / "models.json").read_bytes()
    rows = msgspec.json.decode(stored, type=list[SurveyRow])

    targets = [linked(row).rpartition("(")[2] for row in rows]
    assert len({*targets}) == len(rows)


@pytest.mark.slow
def test_survey_of_a_folder_goes_on_where_it_was(tmp_path: Path) -> None:
    packages, output = tmp_path / "packages", tmp_path / "found.json"
    (packages / "arms").mkdir(parents=True)
    (packages / "arms" / "pendulum.xml").write_text(PENDULUM)
    (packages / "arms" / "broken.xml").write_text(PENDULUM.replace("hinge", "hedge"))
    first = survey(packages, output, "--validate", 1)
    broken, pendulum = msgspec.json.decode(output.read_bytes(), type=list[SurveyRow])
    assert "hedge" in broken.refused
    assert pendulum.verdicts == dict.fromkeys(("mujoco", "pybullet", "dart", "exudyn"), "pass")
    assert pendulum.readers["mujoco"] == "alike"
    assert "validated 1/1 arms/pendulum.xml" in first.stderr

    again = survey(packages, output, "--validate", 1)
    assert not again.stderr
    (tmp_path / "causes.toml").write_text("causes = []\n")
    assert "1 of 2 files are imported" in survey(output).stdout
    assert "- passes in: mujoco, pybullet, dart, exudyn\n" in (tmp_path / "arms.md").read_text()

"""Every command on the page about failure modes gives the result that the page states."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from mbds_xsim.base.isolate import HERE, Crash, Task, run_tasks
from mbds_xsim.studies.stability.studies import study_named
from mbds_xsim.studies.stability.survey import SurveyPlan, survey

_PAGE = Path(__file__).parents[2] / "docs" / "failure-modes.md"
_TOLD = re.compile(
    r"^\$ mbds-xsim stability (?P<words>.+)\noutcome: (?P<outcome>.+)(?:\nwho told: (?P<told>.+))?",
    re.MULTILINE,
)
_CLAIMS = [match.groupdict() for match in _TOLD.finditer(_PAGE.read_text("utf-8"))]


def _options(words: str) -> dict[str, str]:
    parts = shlex.split(words)
    return {"study": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def _plan(words: str) -> SurveyPlan:
    asked = _options(words)
    study = study_named(asked["study"])
    return SurveyPlan(
        study,
        (asked["--engines"],),
        tuple(filter(None, asked.get("--methods", "").split(","))),
        profiles=(asked["--settings"],),  # type: ignore[arg-type]
        values=(study.parse(asked["--value"]),),
        counts=(round(0.1 / float(asked["--step"])),),
        conduct=HERE,
    )


def test_the_page_lists_enough_and_one_silent_mode_an_engine() -> None:
    silent = {
        _options(claim["words"])["--engines"]
        for claim in _CLAIMS
        if claim["told"] in ("nobody", "adapter")
    }
    headings = re.findall(r"^## \d+\. ", _PAGE.read_text("utf-8"), re.MULTILINE)

    assert len(headings) >= 8
    assert silent == {"mujoco", "pybullet", "dart", "exudyn"}
    assert len(_CLAIMS) == _PAGE.read_text("utf-8").count("$ mbds-xsim stability")


@pytest.mark.slow
def test_every_command_comes_to_what_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path))
    tasks = [Task(survey, (_plan(claim["words"]),), 60.0) for claim in _CLAIMS]

    sweeps = run_tasks(tasks, workers=2)

    for claim, sweep in zip(_CLAIMS, sweeps, strict=True):
        if isinstance(sweep, Crash):  # a process that dies ends the study in it
            assert (claim["outcome"], claim["told"]) == ("crashed", "process"), sweep
            continue
        (cell,) = sweep.cells
        reporter = cell.told if cell.failed or cell.outcome == "off course" else None
        assert (cell.outcome, reporter) == (claim["outcome"], claim["told"]), claim["words"]

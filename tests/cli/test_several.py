"""Commands on several scenes, studies or engines check all of them before they measure any."""

from __future__ import annotations

import pytest

from mbds_xsim.commands import sweeps
from mbds_xsim.report.progress import StudyBar
from mbds_xsim.studies import ablate
from mbds_xsim.studies.stability.survey import SurveyPlan
from tests.command_line import CommandLine


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("tradeoff 2pendulum balldrop --engines pinocchio", "no engine can do balldrop"),
        ("match 5pendulum balldrop --engines mujoco-warp", "can be matched on balldrop"),
        ("ablate 2pendulum balldrop --engines pinocchio", "cannot do sphere on the ground"),
        ("stability spin friction --engines pinocchio", "nothing to run in friction"),
        ("stability --engines reference", "chooses its steps"),
        ("releases mujoco typo", "no engine is called 'typo'"),
    ],
)
def test_all_are_checked_before_any_is_measured(
    line: str, told: str, run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StudyBar, "__enter__", _begun)
    monkeypatch.setattr(ablate, "validate_with_evidence", _begun)

    ended = run(*line.split())

    assert (ended.code, ended.out.count("\n")) == (2, ended.out.count("left out: "))
    assert told in ended.err


def _begun(*_: object, **__: object) -> None:
    raise AssertionError("the first is being measured")


def test_studies_that_no_method_can_do_are_left_out_unless_they_are_named(
    run: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []
    monkeypatch.setattr(sweeps, "_mapped", lambda plan, *_, **__: ran.append(_name(plan)))
    monkeypatch.setattr(sweeps, "_write", lambda *_: None)

    ended = run("stability", "--engines", "pinocchio", "--quick")

    assert (ended.code, ended.err) == (0, "")
    assert {"scenes", "stiffness", "links"} < set(ran)
    assert "left out: nothing to run in friction: pinocchio" in ended.out
    assert not {"wheels", "throw", "friction", "restitution"} & set(ran)


def _name(plan: SurveyPlan) -> str:
    return plan.study.name

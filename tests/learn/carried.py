"""Trainings that are carried out in this process, without progress, or only in part."""

from __future__ import annotations

import pytest

from mbds_xsim.base.isolate import run_tasks
from mbds_xsim.learn.curves import LearningCurve, write_curve
from mbds_xsim.learn.runs import TrainingRequest
from mbds_xsim.learn.trainings import TrainingOutcome, carry, planned


class Deaf:
    """Progress sink that discards everything."""

    def begin(self, done: int, most_steps: object) -> None:
        pass

    def reached(self, name: str, step: int, error: float, *, before: bool) -> None:
        pass

    def ended(self, name: str, most_steps: int, how: str) -> None:
        pass


def carry_out(request: TrainingRequest) -> TrainingOutcome:
    return carry(planned(request), workers=0, carrier=run_tasks, progress=Deaf())


def interrupt(request: TrainingRequest) -> None:
    """Carry out a request until its first run has taken eight steps."""

    def halt(curve: LearningCurve) -> bytes:
        if curve.points[-1].step == 8:
            raise KeyboardInterrupt
        return write_curve(curve)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mbds_xsim.learn.runs.write_curve", halt)
        with pytest.raises(KeyboardInterrupt):
            carry_out(request)

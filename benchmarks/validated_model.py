"""Validate one model for the survey of models in the wild, and print the verdicts as JSON.

    python -m benchmarks.validated_model MODEL FOLDER

Runs half a second of motion from three starts in four engines at their presets, without a search
for better settings. FOLDER holds the model's files. The reference and each engine have a process of
their own and a minute of its processor time, so that a slow one does not cost others their verdict.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.isolate import Conduct, Crash, Task, run_tasks
from mbds_xsim.measure.campaign import reference_of, run_campaign
from mbds_xsim.measure.judge import judge
from mbds_xsim.measure.runner import Account
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.choice import Choice, Matched
from mbds_xsim.simulate.registry import load_adapter, read_model

ENGINES = ("mujoco", "pybullet", "dart", "exudyn")
_FRAMES = 25
_LIMIT = 60.0  # [s] of each process's own time, so that a busy machine makes no difference


class Verdicts(msgspec.Struct):
    """Verdicts on a model, by engine."""

    verdicts: dict[str, str] = {}
    """One of pass, fail, refused, timed out, crashed, or no truth if the reference has none."""
    reasons: dict[str, str] = {}
    """Reasons for not passing."""
    reference: str = ""
    """Reason why the reference is missing, or ends before the half second is over."""


def verdicts_on(path: Path, folder: Path) -> Verdicts:
    """Validate a model and return the verdicts."""
    scene = read_model(path, folder=folder).scene
    clock = msgspec.structs.replace(scene.clock, steps=_FRAMES)
    scene = msgspec.structs.replace(scene, clock=clock, name="model", description="", source="")
    batch = draw_batch(scene, range(3))
    # The truth is cached, so that the engines' processes find it.
    (truth,) = _apart([Task(reference_of, (scene, batch, True), _LIMIT)])
    if isinstance(truth, Crash):
        return Verdicts(dict.fromkeys(ENGINES, "no truth"), {}, truth.reason)
    failures = [failure.reason for failure in truth.trajectory.failures if failure is not None]
    result = Verdicts(reference=failures[0] if failures else "")
    judged = _apart([Task(verdict_of, (name, scene, batch), _LIMIT) for name in ENGINES])
    for name, answer in zip(ENGINES, judged, strict=True):
        crash = isinstance(answer, Crash)
        verdict, reason = (answer.kind, answer.reason) if crash else answer
        result.verdicts[name] = verdict
        if reason:
            result.reasons[name] = reason
    return result


def _apart(tasks: list[Task]) -> list[Any]:
    """Run tasks one after the other, each in a process that finds this module."""
    return run_tasks(tasks, workers=1, packages=Path(__file__).parents[1])


def verdict_of(name: str, scene: Scene, batch: Batch) -> tuple[str, str]:
    """Run an engine at its preset; return the verdict, and why it does not pass.

    Raises:
        InputError: The engine cannot simulate the scene.
    """
    adapter = load_adapter(name)
    settings = adapter.settings(scene, "matched")
    adapter.check(scene, settings)
    count = settings.substeps(scene.clock.frame)
    matched = {name: Matched(settings.method, count, dict(settings.options))}
    contenders, _ = Choice((name,), settings={"matched": matched}).contenders(scene)
    (outcome,), reference = run_campaign(scene, batch, contenders, Conduct(0), Account(float))
    row = judge(outcome, reference).result
    return row.verdict, "".join(row.reasons[:1])


def main(model: str, folder: str) -> None:
    """Validate a model and print its verdicts."""
    from benchmarks.validated_model import verdicts_on  # by a name that other processes know

    sys.stdout.buffer.write(msgspec.json.encode(verdicts_on(Path(model), Path(folder))))


if __name__ == "__main__":
    main(*sys.argv[1:])

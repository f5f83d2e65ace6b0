"""Find the smallest errors of a mass and of gravity that `validate` catches, engine by engine.

    PYTHONPATH=tests python -m benchmarks.smallest_fault [SCENE ...]

Everything is as `validate` does by default, one engine at a time, except that the native model is
not read back: the verdict is on the motion alone. If an engine fails without a fault, its step is
halved until it passes.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator

from faults.bench import ENGINES
from faults.changes import gravity, heavier
from faults.planting import Change, planted

from mbds_xsim.base.isolate import HERE
from mbds_xsim.measure.result import EngineResult
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.studies.validate import validate_with_evidence

SCENES = ("5pendulum", "2ladder")

_BODIES = {"pendulum": "link2", "ladder": "rung1"}
_EARTH = 9.81
_LARGEST = 0.1
_REFINEMENTS = 5
_HALVINGS = 3  # bisections of the last decade in log scale: down to a factor of 10^(1/8), a third


def table(scenes: tuple[str, ...] = SCENES) -> Iterator[str]:
    """Yield the lines of a table in Markdown."""
    yield "| scene | engine | method | step | mass of one body, relative | gravity, relative |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name in scenes:
        scene = registry.load_scene(name)
        body = next(body for family, body in _BODIES.items() if name.endswith(family))
        for engine in ENGINES:
            choice = _passing(scene, engine)
            row = _verdict(scene, choice, None)
            mass = _smallest(scene, choice, functools.partial(heavier, body))
            pull = _smallest(scene, choice, lambda share: gravity(_EARTH * (1 + share)))
            step = f"{1e3 * row.step_s:.4g} ms" + (" (halved)" if choice.step else "")
            figures = f"{_figure(mass)} of {body} | {_figure(pull)}"
            yield f"| {name} | {engine} | {row.method} | {step} | {figures} |"


def _passing(scene: Scene, engine: str) -> Choice:
    choice = Choice.parse(engines=engine)
    for _ in range(_REFINEMENTS):
        row = _verdict(scene, choice, None)
        if row.verdict == "pass":
            return choice
        choice = dataclasses.replace(choice, step=row.step_s / 2)
    raise SystemExit(f"{engine} fails on {scene.name} without a fault: {row.reasons}")


def _smallest(scene: Scene, choice: Choice, change: Callable[[float], Change]) -> float | None:
    """Step down by decades to a share that passes, then bisect; None if the largest passes."""

    def caught(share: float) -> bool:
        return _verdict(scene, choice, change(share)).verdict == "fail"

    upper = _LARGEST
    if not caught(upper):
        return None
    while caught(upper / 10):
        upper /= 10
    lower = upper / 10
    for _ in range(_HALVINGS):
        middle = (upper * lower) ** 0.5
        upper, lower = (middle, lower) if caught(middle) else (upper, middle)
    return upper


def _verdict(scene: Scene, choice: Choice, change: Change | None) -> EngineResult:
    with planted(change, *choice.engines):
        validation, _ = validate_with_evidence(scene, choice=choice, conduct=HERE, readback=False)
    return validation.engines[0]


def _figure(share: float | None) -> str:
    return f"{share:.1e}" if share is not None else f"above {_LARGEST:g}"


if __name__ == "__main__":
    for line in table(tuple(sys.argv[1:]) or SCENES):
        print(line, flush=True)

"""Validate one model for the survey of models in the wild, and print the verdicts as JSON.

    python -m benchmarks.validated_model MODEL FOLDER

Half a second of motion from three starts, in four engines at their presets: without a search for
better settings, and without runs at other steps. FOLDER is the one that the model's files are in.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from pathlib import Path

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct
from mbds_xsim.measure.campaign import run_campaign
from mbds_xsim.measure.judge import judge
from mbds_xsim.measure.runner import Account
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice, Matched
from mbds_xsim.simulate.registry import load_adapter, read_model

ENGINES = ("mujoco", "pybullet", "dart", "exudyn")
_FRAMES = 25
_LIMIT = 60  # [s] of processor time: how busy a machine is does not matter


class Verdicts(msgspec.Struct):
    """What the engines make of a model, by engine."""

    verdicts: dict[str, str] = {}
    """pass, fail, refused or no result."""
    reasons: dict[str, str] = {}
    """Why it does not pass."""
    reference: str = ""
    """Why there is no truth to hold them against, before the half second is over."""


def verdicts_on(path: Path, folder: Path) -> Verdicts:
    """Validate a model in a process of its own, which may crash, and ends after some time."""
    words = [sys.executable, "-m", "benchmarks.validated_model", str(path), str(folder)]
    ended = subprocess.run(words, capture_output=True)
    if not ended.returncode:
        return msgspec.json.decode(ended.stdout, type=Verdicts)
    last = ended.stderr.decode(errors="replace").strip().splitlines()[-1:]
    late = ended.returncode == -signal.SIGXCPU
    why = f"not done within {_LIMIT} s of processor time" if late else "".join(last)
    return Verdicts(dict.fromkeys(ENGINES, "no result"), dict.fromkeys(ENGINES, why))


def _validated(scene: Scene) -> Verdicts:
    found, given = Verdicts(), {}
    for name in ENGINES:
        adapter = load_adapter(name)
        settings = adapter.settings(scene, "matched")
        try:
            adapter.check(scene, settings)
        except InputError as error:
            found.verdicts[name], found.reasons[name] = "refused", str(error)
            continue
        count = settings.substeps(scene.clock.frame)
        given[name] = Matched(settings.method, count, dict(settings.options))
    if not given:
        return found
    contenders, _ = Choice(tuple(given), given={"matched": given}).contenders(scene)
    batch, spent = draw_batch(scene, range(3)), Account(float)
    outcomes, reference = run_campaign(
        scene, batch, contenders, conduct=Conduct(0, cache=False), spent=spent
    )
    for outcome in outcomes:
        row = judge(scene, batch, outcome, reference).result
        found.verdicts[row.engine] = row.verdict
        if row.reasons:
            found.reasons[row.engine] = row.reasons[0]
    ended = [failure for failure in reference.trajectory.failures if failure is not None]
    found.reference = ended[0].reason if ended else ""
    return found


def main(model: str, folder: str) -> None:
    """Validate and print."""
    resource.setrlimit(resource.RLIMIT_CPU, (_LIMIT, _LIMIT + 5))
    scene = read_model(Path(model), folder=Path(folder)).scene
    clock = msgspec.structs.replace(scene.clock, steps=_FRAMES)
    verdicts = _validated(msgspec.structs.replace(scene, clock=clock))
    sys.stdout.buffer.write(msgspec.json.encode(verdicts))


if __name__ == "__main__":
    main(*sys.argv[1:])

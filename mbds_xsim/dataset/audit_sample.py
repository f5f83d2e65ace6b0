"""The trajectories that are held against the reference too, which costs too much for all."""

from __future__ import annotations

import dataclasses
import time

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import reference
from mbds_xsim.campaign import RTOL, Outcome, ReferenceOutcome, other_steps
from mbds_xsim.checks import Finding, agreement
from mbds_xsim.checks.consistency import LEAST_SPAN
from mbds_xsim.choice import Contender
from mbds_xsim.convergence import convergence, further_step, smooth
from mbds_xsim.engine import Settings
from mbds_xsim.isolate import Crash
from mbds_xsim.judge import error_findings, failed_lines
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Scene
from mbds_xsim.simulate import Simulation, simulate
from mbds_xsim.state import STATES, Batch, Trajectory

__all__ = ["AUDIT_SAMPLE", "limit_faults", "sample_findings", "sampled"]

_EVERY = 15_000
_COUNT = 3  # one of each interval

AUDIT_SAMPLE = f"index mod {_EVERY} < {_COUNT}"
"""As the files say it."""

_BRIEF = LEAST_SPAN
"""Steps over which one trajectory of any other shard is held against the reference, which over all
steps costs as much as simulating a whole shard does in the fastest engine."""
_GROWTH = 10.0
"""Taken for the sensitivity over so few steps: of the paper's scenes it is 3 at most."""


def sampled(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the trajectories of the sample."""
    return np.flatnonzero(index % _EVERY < _COUNT)


def sample_findings(
    scene: Scene, batch: Batch, trajectory: Trajectory, held: ReferenceOutcome
) -> list[Finding]:
    """Hold trajectories against the reference, as `mbds-xsim validate` does.

    Stored solutions would save time but not be the same to the last bit.
    """
    truth = held.trajectory
    error = agreement.particle_error(Mechanism.of(scene), trajectory, truth)
    return error_findings(scene, batch, error, truth, held.growth)


def limit_faults(
    scene: Scene,
    contender: Contender,
    batch: Batch,
    trajectory: Trajectory,
    held: ReferenceOutcome | None = None,
) -> list[str]:
    """Say in a line each where runs at other steps converge to anything but the reference.

    Args:
        scene: What was simulated.
        contender: By which engine, at which settings.
        batch: Starts and inputs of trajectories that came to their end.
        trajectory: What was recorded of them.
        held: Their reference; left out, that of their first steps is solved here, and no more
            of them is looked at.
    """
    if held is None:
        scene, batch, trajectory = _beginning(scene, batch, trajectory)
        held = _briefly(scene, batch)
    if not any(smooth(scene, held)):
        return []
    rows, settings = list(range(len(batch))), contender.settings
    outcome = Outcome(contender, rows=[rows], sample=rows)

    def run(step: float) -> None:
        other = Settings(settings.method, step, settings.options)
        made = _made(scene, batch, contender.engine, other)
        outcome.keep_step(step, batch, made)
        if isinstance(made, Crash):
            return
        own = made.rollout_s * step / settings.step
        outcome.parts[:] = [dataclasses.replace(made, trajectory=trajectory, rollout_s=own)]

    for step in other_steps(scene, settings):
        run(step)
    while (finer := further_step(scene, batch, outcome, held)) is not None:
        run(finer)
    return failed_lines(batch, convergence(scene, batch, outcome, held))


def _made(scene: Scene, batch: Batch, engine: str, settings: Settings) -> Simulation | Crash:
    """Run an engine at a step that nobody asked for: where it cannot, the shard is none the worse.

    The check then says what it can without.
    """
    try:
        return simulate(scene, batch, engine, settings)
    except Exception as error:
        return Crash(f"{type(error).__name__}: {error}")


def _beginning(
    scene: Scene, batch: Batch, trajectory: Trajectory
) -> tuple[Scene, Batch, Trajectory]:
    """Give the first steps of trajectories, as of a scene that ends then."""
    steps = min(_BRIEF, batch.steps)
    clock = msgspec.structs.replace(scene.clock, steps=steps)
    kept = {key: getattr(trajectory, key)[:, : steps + 1] for key in STATES}
    brief = dataclasses.replace(trajectory, time=trajectory.time[: steps + 1], **kept)
    return msgspec.structs.replace(scene, clock=clock), batch.truncated(steps), brief


def _briefly(scene: Scene, batch: Batch) -> ReferenceOutcome:
    begin = time.perf_counter()
    truth = reference.solve(scene, batch, rtol=RTOL, cache=False)
    growth = np.full(truth.position.shape[:2], _GROWTH)
    return ReferenceOutcome(truth, growth, RTOL, 0, time.perf_counter() - begin)

"""Engines as models: each starts from the last known frame of every domain, and goes on.

Unlike the published motions, which part from frame 0 on, these share the window with a learned
model: their distance from the domain is what a model that knows its engine by heart would get
wrong. An engine on its own domain tells what restarting alone costs (velocities that belong to
another time than positions, solvers that start cold).
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from mbds_xsim.dataset.facts import attributes_of
from mbds_xsim.dataset.points import Points
from mbds_xsim.engine import Settings
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.learn.shift.domains import Domain, Paired, Recorded
from mbds_xsim.learn.shift.measure import Figures, measure, read_figures
from mbds_xsim.learn.shift.meter import Meter
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.reference.cache import directory
from mbds_xsim.registry import load_adapter
from mbds_xsim.simulate import simulate
from mbds_xsim.state import Batch
from mbds_xsim.versions import MODELS

__all__ = ["restarted"]

Array = NDArray[np.float64]

_LAST = HISTORY - 1
_TIMEOUT = 4 * 3600.0  # of a few jobs [s]
_TOGETHER = 3  # jobs a process: starting one takes seconds, and one engine may take longest by far


@dataclass(frozen=True)
class _Job:
    """One engine on one domain."""

    engine: Recorded
    domain: Domain
    horizon: int

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.engine.name} on {self.domain.name}"

    @functools.cached_property
    def path(self) -> Path:
        """Where its figures are kept."""
        adapter = load_adapter(self.engine.engine)
        versions = (MODELS, adapter.version(), adapter.revision)
        rows = getattr(self.domain, "rows", ())
        what = (self.engine.content, versions, self.domain.content, rows, self.horizon)
        key = hashlib.sha256(repr(what).encode()).hexdigest()
        return directory() / "shift" / key[:2] / f"{key[2:]}.npz"


def restarted(
    test: Paired,
    domains: Sequence[Domain],
    horizon: int,
    *,
    cache: bool = True,
    workers: int | None = None,
    meter: Meter | None = None,
) -> tuple[dict[tuple[str, str], Figures], dict[str, str]]:
    """Let every engine go on from every domain; with `cache` what was done is not done again.

    Returns:
        Figures by engine and domain, and why there are none, by engine or by engine and domain.
    """
    jobs: list[_Job] = []
    missing: list[_Job] = []
    lost: dict[str, str] = {}
    for engine in test.domains:
        each = [_Job(engine, domain, horizon) for domain in domains]
        try:
            # All places are named here: tasks take them along.
            missing += [job for job in each if not cache or read_figures(job.path) is None]
        except Exception as error:  # an engine that is not installed, or does not load
            lost[engine.name] = str(error)
        else:
            jobs += each
    if meter is not None and missing:
        meter.begin(len(missing))
    lost |= _run(test.batch, missing, workers, meter)
    found = {(job.engine.name, job.domain.name): read_figures(job.path) for job in jobs}
    return {pair: figures for pair, figures in found.items() if figures is not None}, lost


def _run(
    inputs: Batch, jobs: Sequence[_Job], workers: int | None, meter: Meter | None
) -> dict[str, str]:
    """Carry jobs out, and say which could not be.

    A process that crashed takes the jobs behind along: each of them is tried once more, alone.
    """

    def tell(job: _Job) -> None:
        if meter is not None:
            meter.advance(job.name)

    shares = list(_shares(jobs))
    answers = _round(inputs, shares, workers, tell)
    alone = []
    for share, answer in zip(shares, answers, strict=True):
        for job in share if isinstance(answer, Crash) else ():
            if read_figures(job.path) is None:
                alone.append([job])
            else:
                tell(job)
    lost = {}
    for (job,), answer in zip(alone, _round(inputs, alone, workers, tell), strict=True):
        if isinstance(answer, Crash):
            lost[job.name] = answer.reason
            tell(job)
    return lost


def _round(
    inputs: Batch, shares: Sequence[list[_Job]], workers: int | None, tell: Callable[[_Job], None]
) -> list[Any]:
    def finished(place: int, answer: object) -> None:
        if not isinstance(answer, Crash):
            for job in shares[place]:
                tell(job)

    tasks = [Task(_carry_out, (inputs, share), _TIMEOUT) for share in shares]
    return run_tasks(tasks, workers=workers, finished=finished)


def _shares(jobs: Sequence[_Job]) -> Iterator[list[_Job]]:
    """Deal jobs out, a few of one engine to a process."""
    for _, group in itertools.groupby(jobs, key=lambda job: job.engine.name):
        each = list(group)
        yield from (each[k : k + _TOGETHER] for k in range(0, len(each), _TOGETHER))


def _carry_out(inputs: Batch, jobs: Sequence[_Job]) -> None:
    for job in jobs:
        motions = job.domain.motions(torch.float64)
        predicted = _predicted(job, motions, inputs)
        error = measure(motions, predicted)
        figures = Figures(error.error, error.energy, error.gap, error.error[:, 0])
        figures.write(job.path)


def _predicted(job: _Job, motions: Motions, inputs: Batch) -> torch.Tensor:
    """Positions from frame `HISTORY` on, shape (trajectory, frame, particle, 3)."""
    assert motions.body is not None
    state = motions.body[:, _LAST].numpy()
    known = np.flatnonzero(np.isfinite(state).all(axis=(1, 2)))
    start = _start(state[known], inputs[known], job.horizon)
    scene = motions.graph.scene
    trajectory = simulate(scene, start, job.engine.engine, _settings(job.engine)).trajectory
    position, _ = Points.of(scene).motion(trajectory)
    whole = torch.full((len(state), job.horizon, motions.graph.particle_count, 3), torch.nan)
    whole = whole.double()
    whole[known] = motions.graph.embed(torch.from_numpy(position[:, 1:]))
    return whole


def _start(state: Array, inputs: Batch, horizon: int) -> Batch:
    return Batch(
        index=inputs.index,
        position=state[..., :3].copy(),
        orientation=state[..., 3:7].copy(),
        velocity=state[..., 7:10].copy(),
        angular_velocity=state[..., 10:].copy(),
        force=inputs.force[:, _LAST : _LAST + horizon],
        torque=inputs.torque[:, _LAST : _LAST + horizon],
    )


def _settings(engine: Recorded) -> Settings:
    told = attributes_of(engine.path)
    return Settings(told["method"], told["step_s"], msgspec.json.decode(told["options"]))

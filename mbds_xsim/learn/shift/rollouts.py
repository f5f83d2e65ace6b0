"""Roll models and engines out on domains, side by side; what was done is kept and not done again.

Engines are models too: each starts from the last known frame of every domain, and goes on. Unlike
the published motions, which part from frame 0 on, these share the window with a learned model:
their distance from the domain is what a model that knows its engine by heart would get wrong. An
engine on its own domain tells what restarting alone costs (velocities that belong to another time
than positions, solvers that start cold).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch

from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import USUAL, Conduct, Crash, Task, run_tasks
from mbds_xsim.base.versions import MODELS
from mbds_xsim.dataset.hdf5 import attributes_of
from mbds_xsim.dataset.points import Points
from mbds_xsim.learn.model import LearnedModel
from mbds_xsim.learn.particles import RolloutFigures, figures_on, measure, read_figures
from mbds_xsim.learn.recipe import process_count, put
from mbds_xsim.learn.shift.domains import Domain, Paired, Recorded
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.learn.window import HISTORY, Motions
from mbds_xsim.reference.cache import directory
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.simulate.timed import simulate

_TIMEOUT = 4 * 3600.0  # of the work of a process [s]
_MODELS = 6  # a process: starting one takes seconds
_RESTARTS = 3  # a process: one engine may take longest by far
_ROWS = 512  # trajectories at a time: few of one domain alone leave most of a step to its calls
_STRIDE = 8  # frames from a start of one-step predictions to the next
Paths = dict[tuple[TrainedModel, str], Path]
"""Where the figures of a model on a domain are kept."""


@dataclass(frozen=True)
class RolloutPlan:
    """What to predict, and where."""

    horizon: int
    """Frames of a rollout."""
    stride: int = _STRIDE
    """Frames from a window of the teacher-forced prediction to the next."""
    device: str = "cpu"
    """Of the models."""


class Evaluated(Mapping[tuple[TrainedModel, str], RolloutFigures]):
    """Reads figures when they are asked for: those of a large study together fill the memory."""

    def __init__(self, paths: Paths, tested: int) -> None:
        self._paths, self.tested = paths, tested

    def __getitem__(self, key: tuple[TrainedModel, str]) -> RolloutFigures:
        figures = read_figures(self._paths[key])
        if figures is None:
            msg = f"{self._paths[key]}: cannot be read; remove it and run again"
            raise InputError(msg)
        return figures

    def __iter__(self) -> Iterator[tuple[TrainedModel, str]]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)


def evaluate(
    scene: Scene,
    models: Sequence[TrainedModel],
    domains: Sequence[Domain],
    plan: RolloutPlan,
    conduct: Conduct = USUAL,
) -> Evaluated:
    """Test every model on every domain; without `cache` what was done is done anew.

    InputError where a model cannot be tested; those tested before are kept.
    """
    # Named once: code that is edited meanwhile must not make the tasks look elsewhere.
    paths = {(m, d.name): _path(d, m.model, m.content, plan) for m in models for d in domains}
    if not conduct.cache:
        for path in paths.values():
            path.unlink(missing_ok=True)
    missing = [m for m in models if not all(read_figures(paths[m, d.name]) for d in domains)]
    parts = [missing[k : k + _MODELS] for k in range(0, len(missing), _MODELS)]
    wanted = [{key: path for key, path in paths.items() if key[0] in part} for part in parts]
    if missing:
        conduct.meter.begin(len(missing))

    def finished(place: int, answer: object) -> None:
        del answer
        for model in parts[place]:
            conduct.meter.advance(f"{model.model} {model.training}")

    tasks = [Task(_test, (scene, part, domains, plan), _TIMEOUT) for part in wanted]
    answers = run_tasks(
        tasks, workers=process_count(conduct.workers, plan.device), finished=finished
    )
    for part, answer in zip(parts, answers, strict=True):
        if isinstance(answer, Crash):
            msg = f"testing {part[0].path or part[0].model} and others failed: {answer.reason}"
            raise InputError(msg if not answer.refused else answer.reason)
    return Evaluated(paths, len(missing))


def _test(scene: Scene, paths: Paths, domains: Sequence[Domain], plan: RolloutPlan) -> None:
    torch.set_num_threads(1)

    @functools.cache
    def load(trained: TrainedModel) -> LearnedModel:
        model = trained.load(scene)
        put(model, plan.device)
        return model

    together = max(1, _ROWS // len(domains[0].rows))
    for k in range(0, len(domains), together):
        # Outermost, so that the motions of one group alone are in memory.
        group = domains[k : k + together]
        motions = functools.cache(functools.partial(_joined, group, HISTORY + plan.horizon))
        for trained in dict.fromkeys(trained for trained, _ in paths):
            own = [paths[trained, domain.name] for domain in group]
            if all(map(read_figures, own)):
                continue
            model = load(trained)
            figures = figures_on(model, motions(model.dtype), **dataclasses.asdict(plan))
            for path, part in zip(own, figures.split(len(group)), strict=True):
                part.write(path)


def _joined(domains: Sequence[Domain], frames: int, dtype: torch.dtype) -> Motions:
    return Motions.joined([domain.motions(dtype).until(frames) for domain in domains])


def _path(domain: Domain, *what: object) -> Path:
    """Where figures on a domain are kept: by all that decides on them."""
    known = (MODELS, *what, domain.name, domain.content, domain.rows)
    key = hashlib.sha256(repr(known).encode()).hexdigest()
    return directory() / "shift" / key[:2] / f"{key[2:]}.npz"


@dataclass(frozen=True)
class Restart:
    """One engine that goes on from one domain."""

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
        versions = (adapter.version(), adapter.revision)
        return _path(self.domain, self.engine.content, versions, self.horizon, _STRIDE)


def restarted(
    test: Paired, domains: Sequence[Domain], horizon: int, conduct: Conduct = USUAL
) -> tuple[dict[tuple[str, str], RolloutFigures], dict[str, str]]:
    """Let every engine go on from every domain; with a cache what was done is not done again.

    Beside the figures stands why there are none, by engine or by engine and domain.
    """
    restarts: list[Restart] = []
    missing: list[Restart] = []
    lost: dict[str, str] = {}
    for engine in test.domains:
        each = [Restart(engine, domain, horizon) for domain in domains]
        try:
            # All places are named here: tasks take them along.
            for one in each if not conduct.cache else []:
                one.path.unlink(missing_ok=True)
            missing += [one for one in each if read_figures(one.path) is None]
        except Exception as error:  # an engine that is not installed, or does not load
            lost[engine.name] = str(error)
        else:
            restarts += each
    if missing:
        conduct.meter.begin(len(missing))
    lost |= _run(test.batch, list(_shares(missing)), conduct)
    kept = {(one.engine.name, one.domain.name): read_figures(one.path) for one in restarts}
    return {pair: figures for pair, figures in kept.items() if figures is not None}, lost


def _run(
    inputs: Batch, shares: Sequence[list[Restart]], conduct: Conduct, *, alone: bool = False
) -> dict[str, str]:
    """Carry restarts out, and say which could not be.

    A process that crashed takes those behind along: each of them is tried once more, alone.
    """
    lost: dict[Restart, str] = {}

    def finished(place: int, answer: object) -> None:
        for restart in shares[place]:
            if isinstance(answer, Crash) and read_figures(restart.path) is None:
                lost[restart] = answer.reason
            if alone or restart not in lost:
                conduct.meter.advance(restart.name)

    tasks = [Task(_go_on, (inputs, share), _TIMEOUT) for share in shares]
    run_tasks(tasks, workers=conduct.workers, finished=finished)
    failed = [restart for share in shares for restart in share if restart in lost]
    if alone or not failed:
        return {restart.name: lost[restart] for restart in failed}
    return _run(inputs, [[restart] for restart in failed], conduct, alone=True)


def _shares(restarts: Sequence[Restart]) -> Iterator[list[Restart]]:
    """Deal them out, a few of one engine to a process."""
    for _, group in itertools.groupby(restarts, key=lambda restart: restart.engine.name):
        each = list(group)
        yield from (each[k : k + _RESTARTS] for k in range(0, len(each), _RESTARTS))


def _go_on(inputs: Batch, restarts: Sequence[Restart]) -> None:
    for restart in restarts:
        motions = restart.domain.motions(torch.float64)
        figures = measure(motions, _predicted(restart, motions, inputs, restart.horizon))
        whole = dataclasses.replace(figures, one_step=_one_step(restart, motions, inputs))
        whole.write(restart.path)


def _one_step(restart: Restart, motions: Motions, inputs: Batch) -> Array:
    """Error of going on by one frame from all over the motions, as models do, (trajectory,) [m²].

    The first windows alone would have no contact in them.
    """
    errors = []
    for last in range(HISTORY - 1, HISTORY - 1 + restart.horizon, _STRIDE):
        after = _predicted(restart, motions, inputs, 1, last)[:, 0]
        apart = (after - motions.position[:, last + 1]).square().sum(-1).mean(-1)
        errors.append(apart.numpy())
    whole = np.stack(errors)
    known = np.isfinite(whole)
    count = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return np.where(known, whole, 0.0).sum(axis=0) / count


def _predicted(
    restart: Restart, motions: Motions, inputs: Batch, frames: int, last: int = HISTORY - 1
) -> torch.Tensor:
    """Positions of so many frames behind the last known one, (trajectory, frame, particle, 3)."""
    assert motions.body is not None
    state = motions.body[:, last].numpy()
    known = np.flatnonzero(np.isfinite(state).all(axis=(1, 2)))
    shape = (len(state), frames, motions.graph.particle_count, 3)
    whole = motions.position.new_full(shape, torch.nan)
    if not len(known):  # as of the truth, where no motion is unique any more
        return whole
    steps = slice(last, last + frames)
    placed, turned, moving, spinning = np.split(state[known], (3, 7, 10), axis=-1)
    acting = inputs.force[known, steps], inputs.torque[known, steps]
    start = Batch(inputs.index[known], placed, turned, moving, spinning, *acting)
    scene, about = motions.graph.scene, attributes_of(restart.engine.path)
    settings = Settings(about["method"], about["step_s"], msgspec.json.decode(about["options"]))
    trajectory = simulate(scene, start, restart.engine.engine, settings).trajectory
    position, _ = Points.of(scene).motion(trajectory)
    whole[known] = motions.graph.embed(torch.from_numpy(position[:, 1:]))
    return whole

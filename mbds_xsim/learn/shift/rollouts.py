"""Roll out models and engines on domains, in parallel; results are stored and reused.

Engines are tested like models: each goes on from the last known frame of every domain. Unlike the
published motions, which diverge from frame 0 on, these share the window with a learned model: their
distance from the domain is the error of a model that knows its engine perfectly. An engine on its
own domain shows what restarting alone costs (velocities that belong to another time than positions,
solvers that start cold).
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

_TIMEOUT = 4 * 3600.0  # time limit of a process [s]
_MODELS = 6  # per process: starting one takes seconds
_RESTARTS = 3  # per process: one engine may take longest by far
_ROWS = 512  # trajectories at a time: with few of them, calls take most of a step's time
_RESTART = 2  # version of what the figures of restarts stand for, apart from the models'
_STRIDE = 8  # frames between the starts of one-step predictions
Paths = dict[tuple[TrainedModel, str], Path]
"""Files with the figures of each model on each domain."""


@dataclass(frozen=True)
class RolloutPlan:
    """Length of predictions, and device."""

    horizon: int
    """Number of frames of a rollout."""
    stride: int = _STRIDE
    """Number of frames between the windows of teacher-forced predictions."""
    device: str = "cpu"
    """Device of the models."""


class Evaluated(Mapping[tuple[TrainedModel, str], RolloutFigures]):
    """Figures that are read on demand, because those of a large study fill the memory."""

    def __init__(self, paths: Paths, tested: int) -> None:
        self._paths, self.tested = paths, tested

    def __getitem__(self, key: tuple[TrainedModel, str]) -> RolloutFigures:
        figures = read_figures(self._paths[key])
        if figures is None:
            raise InputError(f"{self._paths[key]}: cannot be read; remove it and run again")
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
    """Test every model on every domain; without `conduct.cache` stored results are discarded.

    Raises InputError if a model cannot be tested; those tested before are kept.
    """
    # Named once: code that is edited meanwhile must not make the tasks look elsewhere.
    paths = {(m, d.name): _path(d, m.model, m.content, plan) for m in models for d in domains}
    if not conduct.cache:
        for path in paths.values():
            path.unlink(missing_ok=True)
    missing = [m for m in models if not all(read_figures(paths[m, d.name]) for d in domains)]
    parts = [missing[k : k + _MODELS] for k in range(0, len(missing), _MODELS)]
    part_paths = [{key: path for key, path in paths.items() if key[0] in part} for part in parts]
    if missing:
        conduct.meter.begin(len(missing))

    def finished(place: int, answer: object) -> None:
        del answer
        for model in parts[place]:
            conduct.meter.advance(f"{model.model} {model.training}")

    tasks = [Task(_test, (scene, part, domains, plan), _TIMEOUT) for part in part_paths]
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
        # Outermost loop, so that only the motions of one group are in memory.
        group = domains[k : k + together]
        motions = functools.cache(functools.partial(_joined, group, HISTORY + plan.horizon))
        for trained in dict.fromkeys(trained for trained, _ in paths):
            own = [paths[trained, domain.name] for domain in group]
            if all(map(read_figures, own)):
                continue
            model = load(trained)
            shown = motions(model.dtype)
            with trained.named_in_errors():
                figures = figures_on(model, shown, **dataclasses.asdict(plan))
            for path, part in zip(own, figures.split(len(group)), strict=True):
                part.write(path)


def _joined(domains: Sequence[Domain], frames: int, dtype: torch.dtype) -> Motions:
    return Motions.joined([domain.motions(dtype).until(frames) for domain in domains])


def _path(domain: Domain, *details: object) -> Path:
    """Return the file of figures on a domain, named by everything that decides them."""
    identity = (MODELS, *details, domain.name, domain.content, domain.rows)
    key = hashlib.sha256(repr(identity).encode()).hexdigest()
    return directory() / "shift" / key[:2] / f"{key[2:]}.npz"


@dataclass(frozen=True)
class Restart:
    """Engine that goes on from a domain."""

    engine: Recorded
    domain: Domain
    horizon: int

    @property
    def name(self) -> str:
        """Name for people."""
        return f"{self.engine.name} on {self.domain.name}"

    @functools.cached_property
    def path(self) -> Path:
        """File of its figures."""
        adapter = load_adapter(self.engine.engine)
        versions = (adapter.version(), adapter.revision)
        details = (self.engine.content, versions, self.horizon, _STRIDE, _RESTART)
        return _path(self.domain, *details)


def restarted(
    test: Paired, domains: Sequence[Domain], horizon: int, conduct: Conduct = USUAL
) -> tuple[dict[tuple[str, str], RolloutFigures], dict[str, str]]:
    """Let every engine go on from every domain; with a cache stored results are reused.

    Returns the figures, and the reasons for missing ones, by engine or by engine and domain.
    """
    restarts: list[Restart] = []
    missing: list[Restart] = []
    reasons: dict[str, str] = {}
    for engine in test.domains:
        each = [Restart(engine, domain, horizon) for domain in domains]
        try:
            # All files are named here, and tasks take the names along.
            for one in each if not conduct.cache else []:
                one.path.unlink(missing_ok=True)
            missing += [one for one in each if read_figures(one.path) is None]
        except Exception as error:  # an engine that is not installed, or does not load
            reasons[engine.name] = str(error)
        else:
            restarts += each
    if missing:
        conduct.meter.begin(len(missing))
    reasons |= _run(test.batch, list(_shares(missing)), conduct)
    results = {(one.engine.name, one.domain.name): read_figures(one.path) for one in restarts}
    return {pair: figures for pair, figures in results.items() if figures is not None}, reasons


def _run(
    inputs: Batch, shares: Sequence[list[Restart]], conduct: Conduct, *, alone: bool = False
) -> dict[str, str]:
    """Carry out restarts, and return the reasons for those that failed.

    A crash of a process also stops its later restarts: each of them is tried once more, alone.
    """
    reasons: dict[Restart, str] = {}

    def finished(place: int, answer: object) -> None:
        for restart in shares[place]:
            if isinstance(answer, Crash) and read_figures(restart.path) is None:
                reasons[restart] = answer.reason
            if alone or restart not in reasons:
                conduct.meter.advance(restart.name)

    tasks = [Task(_go_on, (inputs, share), _TIMEOUT) for share in shares]
    run_tasks(tasks, workers=conduct.workers, finished=finished)
    failed = [restart for share in shares for restart in share if restart in reasons]
    if alone or not failed:
        return {restart.name: reasons[restart] for restart in failed}
    return _run(inputs, [[restart] for restart in failed], conduct, alone=True)


def _shares(restarts: Sequence[Restart]) -> Iterator[list[Restart]]:
    """Yield the restarts of each process, a few of one engine."""
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
    """Return the one-frame error of restarts from all over the motions [m²], (trajectory,).

    Models are tested in the same way; the first windows alone would contain no contact. The error
    is infinite if a restart is lost, or refused, as from a state inside the ground.
    """
    assert motions.body is not None
    errors = []
    for last in range(HISTORY - 1, HISTORY - 1 + restart.horizon, _STRIDE):
        truth = motions.position[:, last + 1]
        try:
            predicted = _predicted(restart, motions, inputs, 1, last)[:, 0]
        except InputError:
            predicted = torch.full_like(truth, torch.nan)
        parts = (truth, motions.body[:, last])
        known = torch.stack([part.isfinite().flatten(1).all(1) for part in parts]).all(0)
        error = (predicted - truth).square().sum(-1).mean(-1)
        error = torch.where(error.isfinite(), error, torch.inf)
        errors.append(torch.where(known, error, torch.nan).numpy())
    whole = np.stack(errors)
    known = ~np.isnan(whole)
    count = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return np.where(known, whole, 0.0).sum(axis=0) / count


def _predicted(
    restart: Restart, motions: Motions, inputs: Batch, frames: int, last: int = HISTORY - 1
) -> torch.Tensor:
    """Return positions in `frames` frames after `last`, (trajectory, frame, particle, 3)."""
    assert motions.body is not None
    state = motions.body[:, last].numpy()
    known = np.flatnonzero(np.isfinite(state).all(axis=(1, 2)))
    shape = (len(state), frames, motions.graph.particle_count, 3)
    predicted = motions.position.new_full(shape, torch.nan)
    if not len(known):  # such as a reference that has ended before
        return predicted
    steps = slice(last, last + frames)
    centre, orientation, velocity, spin = np.split(state[known], (3, 7, 10), axis=-1)
    loads = inputs.force[known, steps], inputs.torque[known, steps]
    start = Batch(inputs.index[known], centre, orientation, velocity, spin, *loads)
    scene, about = motions.graph.scene, attributes_of(restart.engine.path)
    settings = Settings(about["method"], about["step_s"], msgspec.json.decode(about["options"]))
    trajectory = simulate(scene, start, restart.engine.engine, settings).trajectory
    position, _ = Points.of(scene).motion(trajectory)
    predicted[known] = motions.graph.embed(torch.from_numpy(position[:, 1:]))
    return predicted

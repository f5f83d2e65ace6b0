"""Trained models beside the engines of a trade-off: what they cost, and how far they are off.

A model has no step: it is a point, not a curve. It is shown the first six frames of the starts that
the engines have simulated, and its time is that of the frames that it predicts: alone, and in a
batch, each trajectory its share. Random forces are told to none, as when it was trained.
"""

from __future__ import annotations

import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.versions import CHECKS, MODELS
from mbds_xsim.checks import agreement
from mbds_xsim.learn.model import LearnedModel
from mbds_xsim.learn.model_file import read_model
from mbds_xsim.learn.particles import ParticleMotion, gap, particle_error, unexplained_energy
from mbds_xsim.learn.trained import Known, TrainedModel, carry_on, known_start, particle_motion
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.measure.identity import machine
from mbds_xsim.measure.store import Store
from mbds_xsim.reference.cache import directory, key_of
from mbds_xsim.scene.fingerprint import fingerprint
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.studies.tradeoff.bench import Meter
from mbds_xsim.studies.tradeoff.curves import point_of
from mbds_xsim.studies.tradeoff.point import WARM_UP, Seconds, Truth, horizon_of, timed
from mbds_xsim.studies.tradeoff.rows import Kind, Learned, Row, Tradeoff
from mbds_xsim.studies.tradeoff.truths import references

if TYPE_CHECKING:
    from torch import Tensor

Array = NDArray[np.float64]

AT_ONCE = 64
"""Trajectories of a batch."""

_ALONE, _BATCHED = "", f"{AT_ONCE} at a time"
_LIMIT = 1800.0  # of a model, all starts [s]
_TIMED = 25  # frames of a batch
_GUESS = 10.0  # time of a model before any is measured [s]


@dataclass(frozen=True, eq=False)
class ModelStarts:
    """The starts that models are tried on."""

    scene: Scene
    seed: int
    starts: Batch
    quiet: Batch
    """The same without the random forces."""
    truths: tuple[Truth, ...]

    @staticmethod
    def of(study: Tradeoff, scene: Scene, *, cache: bool, workers: int | None) -> ModelStarts:
        """Take the starts of a study, with their reference.

        InputError where the study is of another scene, or the reference ends too early.
        """
        if study.fingerprint != fingerprint(scene):
            msg = f"the stored trade-off of {study.scene} is not of {scene.name} as it is now"
            raise InputError(f"{msg}; measure the engines anew, without --onto")
        starts, quiet = (
            draw_batch(scene, study.trajectories, seed=study.seed, noise=noise)
            for noise in (True, False)
        )
        truths = tuple(references(scene, starts, cache=cache, workers=workers))
        known = min(horizon_of(truth.trajectory) for truth in truths)
        if known < HISTORY * scene.clock.frame * (1 - 1e-9):
            msg = f"{scene.name}: the reference ends within the {HISTORY} frames of a model's start"
            raise InputError(msg)
        return ModelStarts(scene, study.seed, starts, quiet, truths)


def with_models(
    study: Tradeoff,
    scene: Scene,
    models: Sequence[TrainedModel],
    *,
    workers: int | None = None,
    fresh: bool = False,
    cache: bool = True,
    meter: Meter | None = None,
    command: str = "",
) -> tuple[Tradeoff, list[Row]]:
    """Measure models on the starts of a study, and put them into it; their rows come beside it.

    Args:
        study: Of engines, measured or stored.
        scene: That it is of.
        models: Those of other scenes are left out, and the result says so.
        workers: Processes at a time; all cores when left out, none but this one for 0.
        fresh: Whether models that were measured earlier are measured again.
        cache: Whether reference solutions are kept.
        meter: Told of every model that is done.
        command: Of the whole, in place of the study's.

    Raises:
        InputError: The study is of another scene, or none of the models is of this one, or no
            reference is known that could give them their first frames.
    """
    able, left_out = models_of(scene, models)
    trial = ModelStarts.of(study, scene, cache=cache, workers=workers)
    rows = _rows(able, trial, workers=workers, fresh=fresh, meter=meter)
    measured = msgspec.structs.replace(
        study,
        models=tuple(_learned(*pair) for pair in zip(able, rows, strict=True)),
        left_out=study.left_out | left_out,
        command=command or study.command,
        versions=study.versions | {"torch": registry.package_version("torch")},
    )
    return measured, list(itertools.chain.from_iterable(rows))


def models_of(
    scene: Scene, models: Sequence[TrainedModel]
) -> tuple[list[TrainedModel], dict[str, str]]:
    """Find the models of a scene (InputError: none), and say which were trained on others."""
    able = [model for model in models if _is_of(model, scene)]
    others = Counter(model.scene.name for model in models if model not in able)
    left_out = {
        f"models of {name}": f"{count} trained on {name}, not on this {scene.name} or its frames"
        for name, count in others.items()
    }
    if not able:
        reasons = "; ".join(left_out.values())
        msg = f"no trained models of {scene.name}: {reasons}; name the folder of its models"
        raise InputError(msg)
    return able, left_out


def measure_model(trained: TrainedModel, trial: ModelStarts, expected: Sequence[Row]) -> list[Row]:
    """Predict the starts in this process, one by one, then a batch of them.

    Figures are put into the rows expected: of each start alone, then of each in the batch.
    """
    import torch

    torch.set_num_threads(1)
    begin = time.perf_counter()
    model, _ = read_model(trained.file, trial.scene)
    setup = time.perf_counter() - begin
    alone = []
    for k, (bare, truth) in enumerate(zip(expected, trial.truths, strict=False)):
        starts, quiet, solution = trial.starts[[k]], trial.quiet[[k]], truth.trajectory
        predicted, walls, cpus = _predicted(model, known_start(model, solution, quiet))
        motion = particle_motion(model.graph, quiet, solution, predicted)
        row = msgspec.structs.replace(bare, wall_s=walls, cpu_s=cpus, setup_s=setup)
        alone.append(_judged(row, motion, particle_motion(model.graph, starts, solution), truth))
    whole = Trajectory.joined([truth.trajectory for truth in trial.truths])
    batch = known_start(model, whole, trial.quiet).repeated(AT_ONCE).truncated(_TIMED)
    _, walls, cpus = _predicted(model, batch)
    return alone + [
        msgspec.structs.replace(row, key=bare.key, variation=_BATCHED, wall_s=walls, cpu_s=cpus)
        for row, bare in zip(alone, expected[len(alone) :], strict=True)
    ]


def _predicted(model: LearnedModel, known: Known) -> tuple[Tensor, Seconds, Seconds]:
    """Predict, and time it by the simulated second of one trajectory."""
    carry_on(model, known.truncated(WARM_UP))
    rows, frames = known.inputs.force.shape[:2]
    return timed(lambda: carry_on(model, known), rows * frames * model.graph.frame_s)


def _judged(row: Row, motion: ParticleMotion, due: ParticleMotion, truth: Truth) -> Row:
    """Add the figures; a prediction that is lost has failed, as a run that ends early has."""
    finite = np.isfinite(motion.position).all(axis=(1, 2))
    frame = motion.graph.frame_s
    if not finite.all():
        reason = f"not finite from {finite.argmin() * frame:.3g} s on"
        return msgspec.structs.replace(row, kind="failed", reason=reason)
    with np.errstate(all="ignore"):
        error = particle_error(motion, due)
        energy, open_by = unexplained_energy(motion, due), gap(motion)
    known = np.isfinite(error)
    weighted = agreement.growth_weighted(error[None, known], truth.growth[:, known])[0]
    horizon = horizon_of(truth.trajectory)
    return msgspec.structs.replace(
        row,
        horizon_s=horizon,
        error_m=float(error[round(horizon / frame)]),
        error_weighted_m=float(weighted),
        gap_m=_worst(open_by),
        energy=_worst(energy),
    )


def _worst(series: Array) -> float | None:
    known = np.abs(series[np.isfinite(series)])
    return float(known.max()) if len(known) else None


def _rows(
    models: Sequence[TrainedModel],
    trial: ModelStarts,
    *,
    workers: int | None,
    fresh: bool,
    meter: Meter | None,
) -> list[list[Row]]:
    """Take the rows of models from the store, and measure those that it lacks."""
    store = Store(directory() / "tradeoff" / f"{trial.scene.name}-models.jsonl", Row)
    # Named once: code that is edited meanwhile must not make tasks write elsewhere.
    expected = [_expected(model, trial) for model in models]
    kept = [all(row.key in store.rows for row in each) for each in expected]
    missing = [k for k, whole in enumerate(kept) if fresh or not whole]

    def finished(place: int, answer: list[Row] | Crash) -> None:
        bare = expected[missing[place]]
        for row in _crashed(bare, answer) if isinstance(answer, Crash) else answer:
            store.add(row)
        if meter is not None:
            model = models[missing[place]]
            meter.advance(f"{model.kind} {model.run} {model.variant}")

    if meter is not None:
        meter.forecast(_GUESS * len(missing))
    tasks = [Task(measure_model, (models[k], trial, expected[k]), _LIMIT) for k in missing]
    run_tasks(tasks, workers=workers, finished=finished)
    return [[store.rows[row.key] for row in each] for each in expected]


def _expected(model: TrainedModel, trial: ModelStarts) -> list[Row]:
    """Rows without figures: each start alone, each in the batch."""
    return [
        Row(
            key=_key(model, trial, k, variation),
            scene=trial.scene.name,
            engine=model.kind,
            version=registry.package_version("torch"),
            method=f"{model.run} {model.variant}",
            variation=variation,
            options={"known_frames": HISTORY, "file": model.content[:16]},
            steps_per_frame=1,
            step_s=trial.scene.clock.frame,
            trajectory=int(index),
            seed=trial.seed,
            machine=machine(),
            limit_s=_LIMIT,
            kind="done",
        )
        for variation in (_ALONE, _BATCHED)
        for k, index in enumerate(trial.starts.index)
    ]


def _key(model: TrainedModel, trial: ModelStarts, start: int, variation: str) -> str:
    motion = key_of("learned tradeoff", trial.scene, trial.starts, start, 0.0)
    versions = (MODELS, CHECKS, registry.package_version("torch"))
    what = (model.content, motion, variation, versions, machine())
    return hashlib.sha256(repr(what).encode()).hexdigest()


def _learned(model: TrainedModel, rows: list[Row]) -> Learned:
    half = len(rows) // 2
    return Learned(
        model=model.kind,
        training=model.run,
        variant=model.variant,
        engines=model.engines,
        source=str(model.named),
        known_frames=HISTORY,
        at_once=AT_ONCE,
        alone=point_of(rows[:half]),
        batched=point_of(rows[half:]),
        train_wall_s=_number(model, "wall_s"),
        train_cpu_s=_number(model, "cpu_s"),
        train_steps=_number(model, "steps"),
        train_trajectories=_number(model, "train_trajectories"),
        train_device=model.facts.get("device", ""),
        machine=rows[0].machine,
    )


def _number(model: TrainedModel, fact: str) -> float | None:
    return float(model.facts[fact]) if model.facts.get(fact) else None


def _is_of(model: TrainedModel, scene: Scene) -> bool:
    """Whether it was trained on this scene, be it over fewer frames."""
    own = msgspec.structs.replace(model.scene, clock=scene.clock)
    return model.scene.clock.frame == scene.clock.frame and fingerprint(own) == fingerprint(scene)


def _crashed(expected: Sequence[Row], crash: Crash) -> list[Row]:
    kind: Kind = "refused" if crash.refused else "timed out" if crash.timed_out else "crashed"
    return [msgspec.structs.replace(row, kind=kind, reason=crash.reason) for row in expected]

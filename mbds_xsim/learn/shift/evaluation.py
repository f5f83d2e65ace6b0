"""All measurements of a scene: figures of models on domains, their cells, and the floors.

Floors are the distances that engines, noise and chaos alone cause after identical starts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.text import csv_text
from mbds_xsim.learn.curves import LearningCurve, read_curve
from mbds_xsim.learn.particles import EXPLODED, LOST, RolloutFigures, measure
from mbds_xsim.learn.shift.domains import REFERENCE, Domain, Paired, ReferenceFrames
from mbds_xsim.learn.shift.result import INTERVALS, ErrorCell, ErrorFloor, values
from mbds_xsim.learn.trained import TrainedModel
from mbds_xsim.learn.window import HISTORY

ENGINE = "engine"
"""Name in place of a model's if the prediction is an engine's own motion."""
RESTART = "restarted engine"
"""Name in place of a model's if an engine restarts from the domain's last known frame."""
_SHOWN = 4  # digits of figures that are only displayed: they fill most of a study's file
CHAOS_START = 1e-4
"""Root mean square displacement at the last known frame, from which chaos grows [m]."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Everything that was measured of a scene."""

    test: Paired
    frames: tuple[int, ...]
    """Reported frames, counted from 1."""
    figures: Mapping[tuple[TrainedModel, str], RolloutFigures]
    """Figures by model and domain."""
    oracles: Mapping[tuple[str, str], RolloutFigures]
    """Figures by the domain taken as the prediction and the domain it is compared with."""
    restarted: Mapping[tuple[str, str], RolloutFigures] = field(default_factory=dict)
    """Figures of engines that restart from a domain's last known frame, by engine and domain."""
    floors: Mapping[str, Array] = field(default_factory=dict)
    """Floors of noise and chaos, as far as the reference is known, (trajectory, frame) [m²]."""

    @property
    def at(self) -> Index:
        """Indices of the reported frames."""
        return np.array(self.frames) - 1

    @property
    def largest(self) -> float:
        """Squared error assigned to an exploded or lost prediction [m²]."""
        return (EXPLODED * self.test.scene.length) ** 2

    @property
    def entries(self) -> list[TrainedModel]:
        """Trained and trivial models."""
        return list(dict.fromkeys(entry for entry, _ in self.figures))

    @property
    def models(self) -> list[str]:
        """Names of the trained models."""
        return list(dict.fromkeys(e.model for e in self.entries if e.path is not None))

    def runs(self, run: TrainedModel) -> list[TrainedModel]:
        """Return the runs of all seeds of a run's training."""
        key = (run.model, run.training)
        return [entry for entry in self.entries if (entry.model, entry.training) == key]

    def rolled(self) -> Iterator[tuple[tuple[str, str, int, str], RolloutFigures]]:
        """Yield all figures with model, training, seed and domain; engines follow as models."""
        for (entry, test), figures in self.figures.items():
            yield (entry.model, entry.training, entry.seed, test), figures
        for kind, pairs in ((ENGINE, self.oracles), (RESTART, self.restarted)):
            for (first, test), figures in pairs.items():
                yield (kind, first, 0, test), figures

    def errors(self, training: TrainedModel, test: str) -> Array:
        """Return a training's errors at `frames`, none dropped: lost ones count as exploded [m²].

        Shape (seed, trajectory, frame); NaN where the truth is unknown.
        """
        errors = [self.figures[run, test].error for run in self.runs(training)]
        return self.counted(np.stack(errors))

    def floor(self, first: str, test: str) -> Array:
        """Return `apart` at the reported frames."""
        return self.counted(self.apart(first, test))

    def apart(self, first: str, test: str) -> Array:
        """Return an engine's squared distance from a domain [m²], shape (trajectory, frame).

        Both share the window if the engine could go on from it, else only the start: an engine that
        is lost, as on a state that its constraints forbid, does not measure the distance of two.
        """
        if (first, test) not in self.restarted:
            return self.oracles[first, test].error
        error = self.restarted[first, test].error
        if first == test:
            return error
        return np.asarray(np.where(self.exploded(error), self.oracles[first, test].error, error))

    def counted(self, error: Array) -> Array:
        """Return errors at `frames`, at their assigned value from the frame on that lost them."""
        return np.asarray(np.where(self.exploded(error), self.largest, error)[..., self.at])

    def exploded(self, error: Array) -> Mask:
        """Return whether known errors (…, frame) have exceeded `largest` by each frame."""
        beyond = np.logical_or.accumulate(error > self.largest, axis=-1)
        return np.asarray(beyond & ~np.isnan(error))

    def rows(self, interval: str) -> Mask:
        """Return a mask of the trajectories of an interval."""
        number = self.test.index % (len(INTERVALS) - 1)
        return np.asarray((interval == INTERVALS[0]) | (number == INTERVALS.index(interval) - 1))

    def intervals(self) -> Iterator[tuple[str, Mask]]:
        """Yield the intervals that have trajectories, with a mask of these."""
        rows = {interval: self.rows(interval) for interval in INTERVALS}
        return ((interval, mask) for interval, mask in rows.items() if mask.any())


def cells_of(evaluation: Evaluation) -> Iterator[ErrorCell]:
    """Yield a cell for every model and domain.

    Single intervals have cells only for models at home, formulas and trainings on one interval: a
    change of engine is reported for all starts alone, which keeps the file a quarter as large.
    """
    parted = {entry.training for entry in evaluation.entries if entry.interval or not entry.engines}
    for key, figures in evaluation.rolled():
        _, training, _, test = key
        split = training == test or training in parted
        for interval, rows in evaluation.intervals():
            if split or interval == INTERVALS[0]:
                yield _cell(evaluation, (*key, interval), figures, rows)


def _cell(
    evaluation: Evaluation,
    key: tuple[str, str, int, str, str],
    figures: RolloutFigures,
    rows: Mask,
) -> ErrorCell:
    scene, error = evaluation.test.scene, figures.error[rows]
    reported = error[:, evaluation.at]
    time, never = valid_time(error, scene.length, scene.clock.frame)
    begun = ~np.isnan(error[:, 0])
    one_step = figures.one_step[rows]
    one_step = one_step[~np.isnan(one_step)]
    return ErrorCell(
        *key,
        known=_counts(~np.isnan(reported)),
        finite=_counts(np.isfinite(reported)),
        diverged=_counts(evaluation.exploded(error)[:, evaluation.at]),
        mse=values(known_mean(evaluation.counted(error))),
        median=values(median(reported), _SHOWN),
        energy=values(median(figures.energy[rows][:, evaluation.at]), _SHOWN),
        gap=values(median(figures.gap[rows][:, evaluation.at]), _SHOWN),
        one_step=float(one_step.mean()) if len(one_step) and np.isfinite(one_step).all() else None,
        valid_s=float(np.median(time[begun])) if begun.any() else None,
        never_lost=int((never & begun).sum()),
        curve=values(median(error), _SHOWN) if key[-1] == INTERVALS[0] else (),
    )


def valid_time(error: Array, length: float, frame_s: float) -> tuple[Array, Mask]:
    """Return the time until the root mean square error exceeds `LOST` lengths [s], (trajectory,).

    It is the known horizon if the error never does; a mask of these trajectories comes with it.
    """
    lost = error > (LOST * length) ** 2
    known = (~np.isnan(error)).sum(axis=1)
    never = ~lost.any(axis=1)
    return np.asarray(np.where(never, known, lost.argmax(axis=1)) * frame_s), np.asarray(never)


def median(figures: Array) -> Array:
    """Return the median over the known trajectories, frame by frame; NaN without any."""
    return _over_known(np.nanmedian, figures)


def known_mean(figures: Array) -> Array:
    """Return the mean over the known trajectories, frame by frame; NaN without any."""
    return _over_known(np.nanmean, figures)


def _over_known(statistic: Callable[..., Array], figures: Array) -> Array:
    result = np.full(figures.shape[1], np.nan)
    known = ~np.isnan(figures).all(axis=0)
    with np.errstate(invalid="ignore"):  # if the two middle values are infinite
        result[known] = statistic(figures[:, known], axis=0)
    return result


def _counts(flags: Mask) -> tuple[int, ...]:
    return tuple(flags.sum(axis=0).tolist())


def to_csv(evaluations: Sequence[Evaluation]) -> bytes:
    """Write a row for every trajectory, so that medians at the reported frames can be redone.

    So can means, but for predictions that were lost between two of these frames and came back.
    `inf` is a prediction that is not finite, an empty field an unknown value.
    """
    frames = list(dict.fromkeys(f for evaluation in evaluations for f in evaluation.frames))
    kinds = ("squared_error_m2", "energy_error", "constraint_gap_m")
    head = ["scene", "model", "training", "seed", "test", "trajectory", "interval", "one_step_m2"]
    head += [f"{kind}_t{frame}" for kind in kinds for frame in frames]
    rows = (row for evaluation in evaluations for row in _raw(evaluation, frames))
    return csv_text([head, *rows]).encode()


def _raw(evaluation: Evaluation, frames: Sequence[int]) -> Iterator[list[object]]:
    for key, figures in evaluation.rolled():
        series = np.stack([figures.error, figures.energy, figures.gap])
        columns = np.full((*series.shape[:2], len(frames)), np.nan)
        covered = np.array(frames) <= series.shape[-1]
        columns[..., covered] = series[..., np.array(frames)[covered] - 1]
        for row, number in enumerate(evaluation.test.index.tolist()):
            interval = INTERVALS[1 + number % (len(INTERVALS) - 1)]
            raw = [figures.one_step[row], *columns[:, row].ravel()]
            texts = ["" if np.isnan(value) else f"{value:.9g}" for value in raw]
            yield [evaluation.test.scene.name, *key, number, interval, *texts]


def oracles(domains: Sequence[Domain], horizon: int) -> dict[tuple[str, str], RolloutFigures]:
    """Compare every domain with every other, as if it were a prediction.

    They share the start at frame 0, not the window: by the first predicted frame they have had
    `HISTORY` frames to diverge.
    """
    # Without the bodies' states, which fill more memory than everything else in the domains.
    motions = {d.name: dataclasses.replace(d.motions(torch.float64), body=None) for d in domains}
    return {
        (first, test): measure(truth, other.position[:, HISTORY : HISTORY + horizon])
        for first, other in motions.items()
        for test, truth in motions.items()
        if first not in (test, REFERENCE)
    }


def noise_floor(truth: ReferenceFrames, horizon: int) -> Array:
    """Return the squared distance of the reference without the noise from that with it [m²].

    Both have the same state at the last known frame, so this is the error of a perfect model that
    does not see the noise. Shape (trajectory, frame).
    """
    noisy = truth.position[:, HISTORY : HISTORY + horizon]
    return np.asarray(((truth.quiet[:, :horizon] - noisy) ** 2).sum(-1).mean(-1))


def chaos_floor(test: Paired, truth: ReferenceFrames, horizon: int) -> Array:
    """Return the squared distance to which `CHAOS_START` at the last known frame grows [m²].

    It follows the reference's growth factor, which is for small errors, and is capped at the error
    of an exploded prediction. Shape (trajectory, frame).
    """
    growth = truth.growth[:, HISTORY : HISTORY + horizon] / truth.growth[:, HISTORY - 1, None]
    return np.minimum((CHAOS_START * growth) ** 2, (EXPLODED * test.scene.length) ** 2)


def floors_of(evaluation: Evaluation) -> Iterator[ErrorFloor]:
    """Yield all floors."""
    errors = {(ENGINE, *pair): figures.error for pair, figures in evaluation.oracles.items()}
    errors |= {(RESTART, *pair): evaluation.apart(*pair) for pair in evaluation.restarted}
    errors |= {(kind, REFERENCE, REFERENCE): error for kind, error in evaluation.floors.items()}
    for key, error in errors.items():
        yield ErrorFloor(
            *key,
            INTERVALS[0],
            mse=values(known_mean(evaluation.counted(error))),
            median=values(median(error[:, evaluation.at])),
            curve=values(median(error), _SHOWN),
        )


_FRAMES = 10  # as in a validation


def nearest_engine(evaluation: Evaluation, home: str) -> float:
    """Return the mean squared distance of the nearest other engine over the first ten frames.

    In m²; engines go on from the domain's last known frame; infinite if none does.
    """
    engine = home.rpartition("-")[0]
    others = [i for i, j in evaluation.restarted if j == home and i.rpartition("-")[0] != engine]
    errors = (evaluation.apart(other, home)[:, :_FRAMES] for other in others)
    distances = (float(np.nanmean(np.minimum(each, evaluation.largest))) for each in errors)
    return min(distances, default=np.inf)


def curve_of(trained: TrainedModel) -> LearningCurve | None:
    """Read the learning curve next to a model's file; None if missing, InputError if damaged."""
    path = trained.file.with_suffix(".curve.json") if trained.path else None
    return read_curve(path) if path is not None and path.exists() else None


def seconds_to_floor(evaluation: Evaluation, trained: TrainedModel) -> float | None:
    """Return the processor time until the validation error reached `nearest_engine` [s].

    The validation error is a mean over ten frames, too. None if it never did, if the training is on
    several engines, or if its curve or processor time is missing.
    """
    curve = curve_of(trained)
    if not trained.single or curve is None or not trained.facts.get("cpu_s"):
        return None
    floor, points = nearest_engine(evaluation, trained.domains[0]), curve.points
    steps = [point.step for point in points if np.isfinite(floor) and point.error <= floor]
    if not steps:
        return None
    return float(trained.facts["cpu_s"]) * steps[0] / points[-1].step

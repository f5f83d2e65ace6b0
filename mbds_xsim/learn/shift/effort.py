"""How much processor time a training took until it was as near its engine as other engines are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mbds_xsim.learn.curves import read_curve
from mbds_xsim.learn.shift.evaluation import Evaluation
from mbds_xsim.learn.trained import TrainedModel

_FRAMES = 10  # as of a validation


def nearest_engine(evaluation: Evaluation, home: str) -> float:
    """Mean squared distance of the nearest other engine over the first ten frames [m²].

    Engines go on from the domain's last known frame; infinite where none does.
    """
    apart = [
        float(np.nanmean(figures.error[:, :_FRAMES]))
        for (first, test), figures in evaluation.restarted.items()
        if test == home and first.rpartition("-")[0] != home.rpartition("-")[0]
    ]
    return min(apart, default=np.inf)


def seconds_to_floor(evaluation: Evaluation, trained: TrainedModel) -> float | None:
    """Processor time until the validation error was below that distance [s].

    The validation error is the mean over ten frames, too. None where it never was, where the
    training is of several engines, and where its curve is not beside its file.
    """
    curve = Path(trained.file).with_suffix(".curve.json") if trained.path else None
    if not trained.single or curve is None or not curve.exists() or "cpu_s" not in trained.facts:
        return None
    floor = nearest_engine(evaluation, trained.domains[0])
    points = read_curve(curve).points
    reached = [point.step for point in points if np.isfinite(floor) and point.error <= floor]
    if not reached:
        return None
    return float(trained.facts["cpu_s"]) * reached[0] / points[-1].step

"""Is a model nearer to the engine that taught it than any other engine is?"""

from __future__ import annotations

from collections.abc import Iterator

from mbds_xsim.learn.shift.evaluation import RESTART
from mbds_xsim.learn.shift.result import INTERVALS, Shift
from mbds_xsim.report.blocks import Table
from mbds_xsim.report.quantity import NONE, number
from mbds_xsim.studies.shift.changes import titled
from mbds_xsim.studies.shift.figures import at, matrix_of, trained_models

_FRAMES = (10, 20, 50)


def nearness(shift: Shift) -> Table:
    """A row for each training on one domain; those that nothing can be told of are left out."""
    frames = [frame for frame in _FRAMES if frame in shift.frames]
    rows = (row for model in trained_models(shift) for row in _rows(shift, model, frames))
    return titled(
        "Is a model nearer to its engine than any other engine is?",
        "Mean squared distance [m²] of the model from the domain that taught it, below or above "
        "that of the nearest other engine that goes on from the same frame; nothing where that is "
        "below the noise floor, so that no model could tell",
        ("trained on", *(f"t = {frame}" for frame in frames)),
        (row for row in rows if any(text != NONE for text in row[1:])),
    )


def _rows(shift: Shift, model: str, frames: list[int]) -> Iterator[tuple[str, ...]]:
    matrices = [matrix_of(shift, model, at(shift, frame)) for frame in frames]
    for home in matrices[0].homes if matrices else ():
        texts = (
            _beside(matrix.at_home(home), _nearest(shift, home, frame))
            for matrix, frame in zip(matrices, frames, strict=True)
        )
        yield f"{model}, {home}", *texts


def _beside(own: float | None, other: float | None) -> str:
    if own is None or other is None:
        return NONE
    return f"{number(own)} {'<' if own < other else '>'} {number(other)}"


def _nearest(shift: Shift, home: str, frame: int) -> float | None:
    """Distance of the nearest other engine [m²]; None where it drowns in the noise."""
    place, engine = shift.frames.index(frame), home.rpartition("-")[0]
    whole = [floor for floor in shift.floors if floor.interval == INTERVALS[0]]
    noise = [f.mse[place] or 0.0 for f in whole if f.kind == "noise"]
    apart = [
        value
        for floor in whole
        if (floor.kind, floor.test) == (RESTART, home)
        and floor.first.rpartition("-")[0] != engine
        and (value := floor.mse[place]) is not None
    ]
    nearest = min(apart, default=None)
    return None if nearest is None or nearest <= max(noise, default=0.0) else nearest

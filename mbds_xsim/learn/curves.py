"""Learning curves: a JSON file next to a model, logs for TensorBoard, and a picture.

In the picture an engine has its usual colour; dashes distinguish the other trainings named after
it: all engines but it, or its starts of one interval.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import check_writable
from mbds_xsim.base.frame import optional
from mbds_xsim.learn.train import CurvePoint, End
from mbds_xsim.report.themed import INK, LIGHT, engine_style, png
from mbds_xsim.simulate import registry

Look = tuple[str, str | tuple[int, tuple[int, ...]]]
_PANEL = (4.2, 3.0)  # [in]
_ABREAST = 4
_DASHES = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)))
_MARK = {"level": ".", "steps": "|", "diverged": "x", "": "4"}


class LearningCurve(msgspec.Struct, frozen=True):
    """Progress of a run so far."""

    run: str
    most_steps: int
    """Maximum number of steps."""
    ended: End
    """Reason for the end; empty while the run goes on."""
    points: list[CurvePoint]


def write_curve(curve: LearningCurve) -> bytes:
    """Encode a curve as JSON; see `docs/train.md`."""
    return msgspec.json.encode(curve) + b"\n"


def read_curve(path: Path) -> LearningCurve:
    """Read what `write_curve` wrote, or raise InputError."""
    try:
        curve = msgspec.json.decode(path.read_bytes())
        for point in curve["points"]:  # JSON has no infinity: null is a failed prediction
            point |= {key: math.inf for key in ("loss", "error") if point[key] is None}
        return msgspec.convert(curve, LearningCurve)
    except (OSError, msgspec.MsgspecError, KeyError, TypeError) as error:
        msg = f"{path}: no learning curve, or a damaged one ({error}); remove it"
        raise InputError(msg) from error


def check_events(folder: Path) -> None:
    """Raise InputError if TensorBoard is not installed or the folder is not writable."""
    _writer()
    check_writable(folder / "events", "--tensorboard")


class EventLog(AbstractContextManager["EventLog"]):
    """Log for TensorBoard; without a folder it discards everything."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._to: Any = None
        self._logged = 0

    def add(self, points: Sequence[CurvePoint]) -> None:
        """Log the points of a curve that this log lacks; it replaces what other processes wrote."""
        if self._folder is None or not points:
            return
        if self._to is None:
            self._to = _writer()(str(self._folder), purge_step=points[0].step)
        for point in points[self._logged :]:
            for name in ("loss", "error", "rate"):
                self._to.add_scalar(name, getattr(point, name), point.step)
        self._logged = len(points)
        self._to.flush()

    def __exit__(self, *_: object) -> None:
        if self._to is not None:
            self._to.close()


def log_whole(curve: Path, folder: Path) -> None:
    """Log a finished run for TensorBoard, unless that was done after its curve was written."""
    logged = max((file.stat().st_mtime_ns for file in folder.glob("events*")), default=0)
    if curve.exists() and logged < curve.stat().st_mtime_ns:
        with EventLog(folder) as log:
            log.add(read_curve(curve).points)


def _writer() -> Any:
    return optional("torch.utils.tensorboard", "--tensorboard", "learn").SummaryWriter


def to_png(curves: Sequence[LearningCurve]) -> bytes:
    """Draw validation errors over steps: a panel for each model and data, a line for each run.

    A mark at the end of a line shows why the run ended.
    """
    panels: dict[str, list[LearningCurve]] = {}
    for curve in curves:
        if any(math.isfinite(point.error) for point in curve.points):
            panels.setdefault(curve.run.rpartition("/")[0], []).append(curve)
    styles = looks(sorted({_training(curve) for curve in curves}))
    columns = max(1, min(_ABREAST, len(panels)))
    rows = max(1, math.ceil(len(panels) / columns))

    def draw(figure: Any) -> None:
        grid = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, (name, members) in zip(grid, panels.items(), strict=False):
            _panel(axes, name, members, styles)
        for axes in grid[len(panels) :]:
            axes.remove()
        _legend(figure, styles)

    return png(draw, (_PANEL[0] * columns, _PANEL[1] * rows + 0.5))


def _panel(
    axes: Any, name: str, curves: Sequence[LearningCurve], styles: Mapping[str, Look]
) -> None:
    axes.set_title(name, fontsize=10, loc="left", color=INK)
    axes.set_xlabel("steps")
    axes.set_ylabel("validation error [m²]")
    axes.set_yscale("log")
    for curve in curves:
        colour, dash = styles[_training(curve)]
        points = [(point.step, point.error) for point in curve.points]
        axes.plot(*zip(*points, strict=True), color=colour, linestyle=dash, linewidth=1.1)
        last = [point for point in points if math.isfinite(point[1])][-1]
        axes.plot(*last, color=colour, marker=_MARK[curve.ended], markersize=5)


def _legend(figure: Any, styles: Mapping[str, Look]) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=colour, linestyle=dash, label=training)
        for training, (colour, dash) in styles.items()
    ]
    labels = {"level": "level", "steps": "all steps taken", "diverged": "diverged"}
    entries += [
        Line2D([], [], color=INK, linestyle="", marker=_MARK[end], label=text)
        for end, text in labels.items()
    ]
    figure.legend(
        handles=entries, loc="outside lower center", ncols=min(6, len(entries)), frameon=False
    )


def looks(trainings: Sequence[str]) -> dict[str, Look]:
    """Choose colour and dashes of each training; a single engine has its colour and a solid line.

    Trainings that name no engine are black.
    """
    members: dict[str, list[str]] = {}
    for training in trainings:
        first = _first_engine(training)
        others = members.setdefault(first, [first] if first else [])
        others += [] if training in others else [training]
    return {
        training: (
            LIGHT[engine_style(first).colour] if first else INK,
            _DASHES[others.index(training) % len(_DASHES)],
        )
        for first, others in members.items()
        for training in others
        if training in trainings
    }


def _first_engine(training: str) -> str:
    """Find the first engine in a training's name, the longest if several match; "" if none."""
    engines = "|".join(sorted(map(re.escape, registry.engine_names()), key=len, reverse=True))
    match = re.search(f"(?:^|-)({engines})(?:-|$)", training)
    return match[1] if match else ""


def _training(curve: LearningCurve) -> str:
    """Return the training of a run: `mujoco` of `6pendulum/native/gns/mujoco-s0`."""
    return curve.run.rpartition("/")[2].rpartition("-s")[0]

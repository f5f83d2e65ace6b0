"""Learning curves: a file of JSON beside a model, what TensorBoard reads, and a picture.

In the picture an engine has the colour that it has everywhere; dashes tell apart what else its name
stands for: all but it, or its starts of one interval.
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
    """How a run went so far."""

    run: str
    most_steps: int
    """It may take."""
    ended: End
    """Why; empty while it goes on."""
    points: list[CurvePoint]


def write_curve(curve: LearningCurve) -> bytes:
    """Give JSON; see `docs/train.md`."""
    return msgspec.json.encode(curve) + b"\n"


def read_curve(path: Path) -> LearningCurve:
    """Read what `write_curve` wrote, or raise InputError."""
    try:
        curve = msgspec.json.decode(path.read_bytes())
        for point in curve["points"]:  # JSON has no infinity, that of a prediction that failed
            point |= {key: math.inf for key in ("loss", "error") if point[key] is None}
        return msgspec.convert(curve, LearningCurve)
    except (OSError, msgspec.MsgspecError, KeyError, TypeError) as error:
        msg = f"{path}: no learning curve, or a damaged one ({error}); remove it"
        raise InputError(msg) from error


def check_events(folder: Path) -> None:
    """Raise InputError where TensorBoard is not installed, or the folder cannot be written to."""
    _writer()
    check_writable(folder / "events", "--tensorboard")


class EventLog(AbstractContextManager["EventLog"]):
    """Tells TensorBoard, or nobody where there is no folder."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._to: Any = None

    def add(self, point: CurvePoint) -> None:
        """Tell of a point; those of an interrupted process that lie behind it are forgotten."""
        if self._folder is None:
            return
        if self._to is None:
            self._to = _writer()(str(self._folder), purge_step=point.step)
        for name in ("loss", "error", "rate"):
            self._to.add_scalar(name, getattr(point, name), point.step)
        self._to.flush()

    def __exit__(self, *_: object) -> None:
        if self._to is not None:
            self._to.close()


def log_whole(curve: Path, folder: Path) -> None:
    """Tell TensorBoard of a run that is over, unless it has been told."""
    if curve.exists() and not folder.exists():
        with EventLog(folder) as log:
            for point in read_curve(curve).points:
                log.add(point)


def _writer() -> Any:
    return optional("torch.utils.tensorboard", "--tensorboard", "learn").SummaryWriter


def to_png(curves: Sequence[LearningCurve]) -> bytes:
    """Draw validation errors over steps: a panel a model and data, a line a seed.

    A mark at the end says why it ended there.
    """
    panels: dict[str, list[LearningCurve]] = {}
    for curve in curves:
        if not any(math.isfinite(point.error) for point in curve.points):
            continue
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
        steps = [point.step for point in curve.points]
        errors = [point.error for point in curve.points]
        axes.plot(steps, errors, color=colour, linestyle=dash, linewidth=1.1)
        finite = [k for k, error in enumerate(errors) if math.isfinite(error)]
        if finite:
            last = finite[-1]
            mark = _MARK[curve.ended]
            axes.plot(steps[last], errors[last], color=colour, marker=mark, markersize=5)


def _legend(figure: Any, styles: Mapping[str, Look]) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=colour, linestyle=dash, label=training)
        for training, (colour, dash) in styles.items()
    ]
    words = {"level": "level", "steps": "all steps taken", "diverged": "diverged"}
    entries += [
        Line2D([], [], color=INK, linestyle="", marker=_MARK[way], label=text)
        for way, text in words.items()
    ]
    figure.legend(
        handles=entries, loc="outside lower center", ncols=min(6, len(entries)), frameon=False
    )


def looks(trainings: Sequence[str]) -> dict[str, Look]:
    """Colour and dashes of each training: an engine alone has a full line, its own colour.

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
    """Find the engine that stands first in a training's name; the longest of several."""
    known = "|".join(sorted(map(re.escape, registry.engine_names()), key=len, reverse=True))
    found = re.search(f"(?:^|-)({known})(?:-|$)", training)
    return found[1] if found else ""


def _training(curve: LearningCurve) -> str:
    """As in `mujoco` of `6pendulum/native/gns/mujoco-s0`."""
    return curve.run.rpartition("/")[2].rpartition("-s")[0]

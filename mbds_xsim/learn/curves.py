"""Learning curves as files: one of JSON beside a model, and what TensorBoard reads."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.learn.train import CurvePoint


class LearningCurve(msgspec.Struct, frozen=True):
    """How a run went so far."""

    run: str
    most_steps: int
    """It may take."""
    ended: str
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
    """Raise InputError where TensorBoard is not installed, or a file is in the folder's place."""
    _writer()
    blocking = next((place for place in (folder, *folder.parents) if place.is_file()), None)
    if blocking is not None:
        msg = f"--tensorboard: got {folder}, but {blocking} is a file; name a folder"
        raise InputError(msg)


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

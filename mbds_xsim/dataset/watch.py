"""Tell progress from the logs of the shards, which workers write wherever they run."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from mbds_xsim.dataset.shard import LOG

__all__ = ["ProgressSink", "watched"]

_INTERVAL = 0.3  # [s]


class ProgressSink(Protocol):
    """Where progress is told."""

    def begin(self, total: int, done: int) -> None:
        """Say how many trajectories there are, and how many an earlier run has made."""

    def advance(self, done: int, rejected: int) -> None:
        """Count trajectories that were made since, and how many of them were rejected."""

    def notice(self, line: str) -> None:
        """Say what is to stay and be read."""


@contextmanager
def watched(folders: Sequence[Path], progress: ProgressSink) -> Iterator[None]:
    """Tell what is added to the logs of some folders while the block runs."""
    tails = [_Tail(folder / LOG) for folder in folders]
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(_INTERVAL):
            _tell(tails, progress)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        _tell(tails, progress)


def _tell(tails: Sequence[_Tail], progress: ProgressSink) -> None:
    facts = [line for tail in tails for line in tail.new()]
    if facts:
        done = sum(line["count"] for line in facts)
        progress.advance(done, sum(line["rejected"] for line in facts))


class _Tail:
    """Reads the lines that are added to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = path.stat().st_size if path.exists() else 0

    def new(self) -> list[dict[str, int]]:
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._place)
            text = file.read()
        whole = text[: text.rfind(b"\n") + 1]
        self._place += len(whole)
        return [json.loads(line) for line in whole.splitlines()]

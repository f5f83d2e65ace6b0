"""Time, memory and folders of a process, its interruptions, and output past Python's streams."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Self

SEARCHED = "MBDS_XSIM_SEARCHED"
"""Variable with the folders of a process's modules, for those that carry out its tasks."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_EVERY = 0.05  # shortest time between two looks [s]
_GAP = 1.0  # most time that one look adds, as this process may have been suspended [s]


class Usage:
    """Watcher of another process's memory and of the time that it has used.

    A running process uses processor time, and a sleeping one wall-clock time. Waiting for a core of
    a busy machine thus uses no time, but waiting for something else, maybe forever, does. Where the
    system reports no processor time (elsewhere than on Linux), all time is wall-clock time.

    Args:
        process: Process id.
    """

    def __init__(self, process: int) -> None:
        self._folder = Path(f"/proc/{process}")
        self._last = time.monotonic()
        self._cpu = 0.0
        self.seconds = 0.0
        self.bytes = 0
        """Resident memory at the last look [bytes]."""

    def look(self) -> bool:
        """Update the figures unless the last look was just now; return whether it did so."""
        now = time.monotonic()
        passed = now - self._last
        if passed < _EVERY:
            return False
        self._last = now
        try:
            state, cpu, self.bytes = self._stat()
        except OSError:  # it has ended, or this is not Linux
            state, cpu = "", self._cpu
        used, self._cpu = cpu - self._cpu, cpu
        self.seconds += min(used if state == "R" else passed, passed, _GAP)
        return True

    def _stat(self) -> tuple[str, float, int]:
        """Read state, processor time [s] and resident memory [bytes]; see proc(5)."""
        text = (self._folder / "stat").read_text(errors="replace")
        words = text.rpartition(")")[2].split()
        ticks = int(words[11]) + int(words[12])
        return words[0], ticks / os.sysconf("SC_CLK_TCK"), int(words[21]) * _page()


def memory_bytes() -> float:
    """Return the memory that this process and its children may use together [bytes]."""
    bounds = [float(os.sysconf("SC_PHYS_PAGES") * _page())]
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # of a container
        limit = Path("/sys/fs/cgroup", name)
        if limit.is_file() and (text := limit.read_text().strip()).isdigit():
            bounds.append(float(text))
    return min(bounds)


def _page() -> int:
    return os.sysconf("SC_PAGE_SIZE")


def absolute_folders(packages: Path | None = None) -> dict[str, str]:
    """Return the environment's folders for a process that works in another folder.

    Args:
        packages: Folder of packages that it imports in preference to all others.
    """
    caches = {key: os.environ.get(key) for key in ("MBDS_XSIM_CACHE", "XDG_CACHE_HOME")}
    folders = {key: str(Path(value).absolute()) for key, value in caches.items() if value}
    text = os.environ.get("PYTHONPATH")
    search = [packages] if packages else []
    search += [Path(each) for each in text.split(os.pathsep)] if text else []
    if search:
        folders["PYTHONPATH"] = os.pathsep.join(str(each.absolute()) for each in search)
    places = [Path(each) for each in sys.path]
    with suppress(FileNotFoundError):  # a current folder that is gone has no modules
        places = [place.absolute() for place in places]
    folders[SEARCHED] = os.pathsep.join(str(place) for place in places if place.is_absolute())
    return folders


class Interruptions:
    """Interruptions that are held back during a block until they are let through.

    Python may raise `KeyboardInterrupt` between any two steps. A process that is just being started
    would then have no owner. If `subprocess` had just taken the lock under which it asks whether a
    process has ended, it would never release it, and waiting for that end would take forever.

    Signals without a handler in Python are left alone. Outside the main thread, where no signals
    arrive, nothing is held back.
    """

    def __init__(self) -> None:
        main = threading.current_thread() is threading.main_thread()
        actions = {int(number): signal.getsignal(number) for number in _SIGNALS if main}
        self._handlers = {number: action for number, action in actions.items() if callable(action)}
        self._came: list[tuple[int, FrameType | None]] = []

    def __enter__(self) -> Self:
        self._hold()
        return self

    def __exit__(self, *_: object) -> None:
        self._release()

    def let_through(self) -> None:
        """Let those through that have arrived in the meantime."""
        while self._came:
            number, frame = self._came.pop()
            self._handlers[number](number, frame)

    def _hold(self) -> None:
        """Hold all interruptions back from now on."""
        for number in self._handlers:
            signal.signal(number, lambda *interruption: self._came.append(interruption))

    def _release(self) -> None:
        """Let all interruptions through from now on, beginning with those held back."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self.let_through()

    @contextmanager
    def released(self) -> Iterator[None]:
        """Let all interruptions through at once during the block."""
        try:
            self._release()
            yield
        finally:
            self._hold()


unwritten: list[OSError] = []
"""Errors because of which output was discarded, to be told at the end."""


def discard(stream: IO[str]) -> None:
    """Discard all further output of a stream, and what it holds: it cannot be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def tell(text: str) -> None:
    """Write a line on the program to standard error."""
    from mbds_xsim.base.text import on_a_line

    try:
        print(f"mbds-xsim: {on_a_line(text)}", file=sys.stderr, flush=True)
    except OSError as error:  # the output ends, not the work
        unwritten.append(error)
        discard(sys.stderr)


@contextmanager
def redirected(numbers: tuple[int, ...], target: int) -> Iterator[None]:
    """Send file descriptors (1: output, 2: errors) elsewhere: C++ writes past Python's streams."""
    saved = [os.dup(number) for number in numbers]
    try:
        for number in numbers:
            os.dup2(target, number)
        yield
    finally:
        for number, copy in zip(numbers, saved, strict=True):
            os.dup2(copy, number)
            os.close(copy)

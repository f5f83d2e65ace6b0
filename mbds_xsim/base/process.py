"""Processes: what one has used, its interruptions, and what it writes past Python's streams."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_EVERY = 0.05  # time between two looks [s]
_GAP = 1.0  # the most that one look adds: who looks may have been suspended [s]


class Spent:
    """Watches another process: time of its own, and memory.

    Its time is that of the processor while it runs, and of the clock while it sleeps. What waits
    for its turn on a busy machine uses none; what waits for something else, maybe for ever, does.
    Where the system does not tell (elsewhere than on Linux) it is that of the clock.

    Args:
        process: Its number.
    """

    def __init__(self, process: int) -> None:
        self._folder = Path(f"/proc/{process}")
        self._last = time.monotonic()
        self._cpu = 0.0
        self.seconds = 0.0
        self.bytes = 0
        """Of memory, at the last look."""

    def look(self) -> bool:
        """Bring the figures up to date; says whether it was time to."""
        now = time.monotonic()
        passed = now - self._last
        if passed < _EVERY:
            return False
        self._last = now
        try:
            state, cpu, self.bytes = self._stat()
        except OSError:  # it has ended, or nothing tells
            state, cpu = "", self._cpu
        used, self._cpu = cpu - self._cpu, cpu
        self.seconds += min(used if state == "R" else passed, passed, _GAP)
        return True

    def _stat(self) -> tuple[str, float, int]:
        """State, processor time [s] and resident memory [bytes]; see proc(5)."""
        text = (self._folder / "stat").read_text(errors="replace")
        words = text.rpartition(")")[2].split()
        ticks = int(words[11]) + int(words[12])
        return words[0], ticks / os.sysconf("SC_CLK_TCK"), int(words[21]) * _page()


def memory_bytes() -> float:
    """Memory that this process and its children may have together."""
    bounds = [float(os.sysconf("SC_PHYS_PAGES") * _page())]
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # of a container
        limit = Path("/sys/fs/cgroup", name)
        if limit.is_file() and (text := limit.read_text().strip()).isdigit():
            bounds.append(float(text))
    return min(bounds)


def _page() -> int:
    return os.sysconf("SC_PAGE_SIZE")


@contextmanager
def held_back() -> Iterator[Callable[[], None]]:
    """Hold interruptions back; gives what lets through one that came in the meantime.

    Python raises `KeyboardInterrupt` between any two steps: a process that is being started then
    belongs to nobody, and where `subprocess` has just taken the lock under which it asks for a
    process's end, it never gives it back, so that waiting for that end takes forever.

    Signals that no Python function handles stay as they are, and so does everything outside the
    main thread, where none arrive.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    came: list[tuple[int, FrameType | None]] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append((number, frame))

    def let_through() -> None:
        while came:
            number, frame = came.pop()
            handlers[number](number, frame)

    found = {int(number): signal.getsignal(number) for number in _SIGNALS}
    handlers = {number: handler for number, handler in found.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, note)
    try:
        yield let_through
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        let_through()


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

"""Processes: what one has used, its interruptions, and what it writes past Python's streams."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
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


class Held:
    """Interruptions that wait until they are let through.

    Signals that no Python function handles stay as they are, and so does everything outside the
    main thread, where none arrive.
    """

    def __init__(self) -> None:
        main = threading.current_thread() is threading.main_thread()
        found = {int(number): signal.getsignal(number) for number in _SIGNALS if main}
        self._handlers = {number: handler for number, handler in found.items() if callable(handler)}
        self._came: list[tuple[int, FrameType | None]] = []

    def let_through(self) -> None:
        """Let one through that came in the meantime."""
        while self._came:
            number, frame = self._came.pop()
            self._handlers[number](number, frame)

    def hold(self) -> None:
        """Let none through from now on."""
        for number in self._handlers:
            signal.signal(number, lambda *interruption: self._came.append(interruption))

    def release(self) -> None:
        """Let all through from now on."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self.let_through()

    @contextmanager
    def released(self) -> Iterator[None]:
        """Let all through at once meanwhile."""
        try:
            self.release()
            yield
        finally:
            self.hold()


@contextmanager
def held_back() -> Iterator[Held]:
    """Hold interruptions back; gives what lets them through.

    Python raises `KeyboardInterrupt` between any two steps: a process that is being started then
    belongs to nobody, and where `subprocess` has just taken the lock under which it asks for a
    process's end, it never gives it back, so that waiting for that end takes forever.
    """
    held = Held()
    held.hold()
    try:
        yield held
    finally:
        held.release()


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

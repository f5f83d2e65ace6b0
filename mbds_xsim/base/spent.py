"""What a process has used: time of its own, and memory."""

from __future__ import annotations

import os
import time
from pathlib import Path

_EVERY = 0.05  # time between two looks [s]
_GAP = 1.0  # the most that one look adds: who looks may have been suspended [s]


class Spent:
    """Watches another process.

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
            state, cpu, self.bytes = self._told()
        except OSError:  # it has ended, or nothing tells
            state, cpu = "", self._cpu
        used, self._cpu = cpu - self._cpu, cpu
        self.seconds += min(used if state == "R" else passed, passed, _GAP)
        return True

    def _told(self) -> tuple[str, float, int]:
        """State, processor time [s] and resident memory [bytes]; see proc(5)."""
        text = (self._folder / "stat").read_text(errors="replace")
        words = text.rpartition(")")[2].split()
        ticks = int(words[11]) + int(words[12])
        return words[0], ticks / os.sysconf("SC_CLK_TCK"), int(words[21]) * _page()


def memory_bytes() -> float:
    """Memory that this process and its children may have together."""
    bounds = [float(os.sysconf("SC_PHYS_PAGES") * _page())]
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # of a container
        told = Path("/sys/fs/cgroup", name)
        if told.is_file() and (text := told.read_text().strip()).isdigit():
            bounds.append(float(text))
    return min(bounds)


def _page() -> int:
    return os.sysconf("SC_PAGE_SIZE")

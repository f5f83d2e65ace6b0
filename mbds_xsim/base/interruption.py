"""Let Ctrl-C act only where nothing is half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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

"""Where people read."""

from __future__ import annotations

import os
import sys

from rich.console import Console

__all__ = ["Outlet"]

_PIPED = 160  # columns


class Outlet(Console):
    """Standard output or error; a reader that hangs up ends the telling, not the work."""

    def __init__(self, *, stderr: bool) -> None:
        super().__init__(stderr=stderr)
        if not self.is_terminal and "COLUMNS" not in os.environ:
            self.width = _PIPED  # a file has no edge to cut tables at

    def on_broken_pipe(self) -> None:
        """Fall silent: results are still to be written to files (`… | head`)."""
        self.quiet = True
        stream = sys.stderr if self.stderr else sys.stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())

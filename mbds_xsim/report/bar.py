"""What all progress bars share: they live in a `with`, and say nothing off a terminal."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import Progress, ProgressColumn

__all__ = ["Bar"]

_SPEED_OVER = 600.0  # work comes in bursts; rate and time left look back over so long [s]


class Bar:
    """One line on a terminal, gone when the work is done."""

    def __init__(
        self, console: Console, *columns: ProgressColumn, name: str = "", **fields: Any
    ) -> None:
        self._progress = Progress(
            *columns,
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER,
        )
        self._task = self._progress.add_task(name, total=None, **fields)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def _show(self, **what: Any) -> None:
        self._progress.update(self._task, **what)

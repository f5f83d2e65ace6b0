"""Data generation on the terminal: progress with rate and time left, and what came of it."""

from __future__ import annotations

import time

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from mbds_xsim.counted import counted
from mbds_xsim.dataset.generate import Generated
from mbds_xsim.report.bar import Bar

__all__ = ["GeneratingBar", "print_counts"]


class GeneratingBar(Bar):
    """Shows trajectories made, rate, time left, and rejected ones."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console,
            BarColumn(bar_width=32),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[rejected]} rejected"),
            rate="",
            rejected=0,
        )
        self._made, self._rejected, self._begin = 0, 0, time.monotonic()

    def begin(self, total: int, done: int = 0) -> None:
        """Say how many trajectories there are, and how many an earlier run has made."""
        self._show(total=total, completed=done)

    def advance(self, done: int, rejected: int) -> None:
        """Count trajectories that were made since, and how many of them were rejected."""
        self._made += done
        self._rejected += rejected
        rate = self._made / max(time.monotonic() - self._begin, 1e-9)
        self._show(advance=done, rate=f"{rate:.3g}/s", rejected=self._rejected)


def print_counts(generated: Generated, console: Console) -> None:
    """Print what was published and what was rejected, and why."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    table.add_column("file", overflow="fold")
    for column in ("drawn", "published", "rejected", "MB"):
        table.add_column(column, justify="right")
    table.add_column("rejected by")
    for count in generated.variants:
        causes = ", ".join(f"{cause} {number}" for cause, number in count.rejected_by.items())
        numbers = (count.trajectories, count.published, count.rejected)
        table.add_row(count.file, *map(str, numbers), f"{count.bytes / 1e6:.4g}", causes)
    console.print(table)
    for pair, reason in generated.left_out.items():
        console.print(f"{pair} left out: {reason}", highlight=False)
    for variant, reason in generated.failed.items():
        console.print(f"{variant} failed: {reason}", highlight=False, markup=False)
    rate = generated.made / generated.wall_s
    console.print(
        f"{counted(generated.made, 'trajectory')} made in {generated.wall_s:.1f} s ({rate:.3g}/s)",
        highlight=False,
    )

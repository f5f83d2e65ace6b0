"""A data set on the terminal: what it is, how many of what, and what the checks find."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mbds_xsim.counted import counted
from mbds_xsim.dataset.summary import Range, Summary
from mbds_xsim.report import quantity

__all__ = ["print_summary"]


def print_summary(summary: Summary, console: Console) -> None:
    """Print one data set."""
    title = Text(summary.file, style="bold")
    title.append(f"  {summary.kind}, {summary.certification}", style="dim not bold")
    console.print(title, soft_wrap=True)
    for name, text in _lines(summary):
        console.print(f"{name:<10} {text}", highlight=False, soft_wrap=True)
    console.print(_counts(summary))
    if summary.figures:
        console.print(_figures(summary))


def _lines(summary: Summary) -> list[tuple[str, str]]:
    noise = "with" if summary.noise else "without"
    options = f", {summary.options}" if summary.options != "{}" else ""
    causes = ", ".join(f"{cause} {count}" for cause, count in summary.rejected_by.items())
    return [
        (
            "scene",
            f"{summary.scene}: {summary.description or 'no description'}; {summary.dimension}D, "
            f"{counted(summary.bodies, 'body')}, {counted(summary.points, 'point')}, "
            f"{counted(summary.steps, 'step')} of "
            f"{summary.frame_s:g} s",
        ),
        (
            "made by",
            f"{summary.engine} {summary.engine_version} ({summary.profile}), {summary.method} at "
            f"{summary.step_s:.6g} s{options}; seed {summary.seed}, {noise} noise",
        ),
        ("versions", f"mbds-xsim {summary.mbds_xsim_version}, numpy {summary.numpy_version}"),
        (
            "holds",
            f"{summary.published} published and {summary.rejected} rejected of {summary.drawn}"
            + (f": {causes}" if causes else ""),
        ),
        ("on disk", f"{summary.bytes / 1e6:.4g} MB in {counted(summary.shards, 'shard')}"),
    ]


def _counts(summary: Summary) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("trajectories", no_wrap=True)
    intervals = list(next(iter(summary.counts.values())))
    for heading in (*intervals, "all"):
        table.add_column(heading, justify="right")
    for part, counts in summary.counts.items():
        table.add_row(part, *(str(counts[name]) for name in intervals), str(sum(counts.values())))
    return table


def _figures(summary: Summary) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("check", no_wrap=True)
    for heading in ("trajectories", "smallest", "median", "largest", "allowed"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for figure in summary.figures:
        table.add_row(*_cells(figure))
    return table


def _cells(figure: Range) -> tuple[str, ...]:
    shown = (quantity.with_unit(value, figure.unit) for value in (figure.smallest, figure.median))
    largest, allowed = quantity.beside(figure.largest, figure.allowed, figure.unit)
    if figure.allowed is None:
        return figure.check, str(figure.trajectories), *shown, largest, "shown", ""
    mark = "✓" if figure.largest <= figure.allowed else "✗"
    return figure.check, str(figure.trajectories), *shown, largest, allowed, mark

"""`mbds-xsim inspect`: what a data file or folder holds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import counted
from mbds_xsim.commands import shared
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Column, Remarks, Table, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.dataset.summary import Range, Summary


@shared.command(
    "data",
    epilog="Examples:  mbds-xsim inspect data  ·  "
    "mbds-xsim inspect data/6pendulum/mujoco-matched.h5 --png paths.png",
)
def inspect(
    path: Annotated[Path, Argument(metavar="FILE|DIR", help="A data file or a folder.")],
    png: Annotated[
        Path | None, Option(metavar="FILE", help="Draw paths of particles into this file.")
    ] = None,
    json: shared.JsonFile = None,
) -> None:
    """Sum up data sets: scene, engine, counts, figures of the checks, versions, size."""
    from mbds_xsim.dataset.read import load_dataset
    from mbds_xsim.dataset.summary import draw_paths, summaries

    shared.check_targets(json=json, png=png)
    found = summaries(path)
    if png is not None and len(found) > 1:
        msg = f"--png: {path} holds {len(found)} data sets; name one of them, as {found[0].file}"
        raise InputError(msg)
    if png is not None:
        draw_paths(load_dataset(found[0].file), png)
    shared.answer((b for summary in found for b in summary_blocks(summary)), found, json, "inspect")
    if png is not None:
        shared.console_for(json).print(f"written: {png}", highlight=False)


def summary_blocks(summary: Summary) -> Iterator[Block]:
    """Say what a data set is, how many of what it has, and what the checks measured."""
    yield Text(f"{summary.file}  {summary.kind}, {summary.certification}", "strong")
    yield Remarks.of(_facts(summary))
    yield _counts(summary)
    if summary.figures:
        figures = (">trajectories", ">smallest", ">median", ">largest", ">allowed", ">")
        yield table_of(["check", *figures], map(_cells, summary.figures))


def _facts(summary: Summary) -> list[tuple[str, str]]:
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
    intervals = list(next(iter(summary.counts.values())))
    return table_of(
        ["trajectories", *map(Column, (*intervals, "all"))],
        [
            [part, *(str(counts[name]) for name in intervals), str(sum(counts.values()))]
            for part, counts in summary.counts.items()
        ],
    )


def _cells(figure: Range) -> list[Cell | str]:
    first = (quantity.with_unit(value, figure.unit) for value in (figure.smallest, figure.median))
    largest, allowed = quantity.beside(figure.largest, figure.allowed, figure.unit)
    known: list[Cell | str] = [figure.check, str(figure.trajectories), *first, largest]
    if figure.allowed is None:
        return [*known, "shown", ""]
    kept = figure.largest <= figure.allowed
    return [*known, allowed, Cell("", "pass" if kept else "fail")]

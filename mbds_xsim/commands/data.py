"""`mbds-xsim inspect`, `export`, `audit` and `verify`: commands on existing data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Exit, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT, Conduct
from mbds_xsim.base.text import counted, encoded
from mbds_xsim.commands import shared
from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Block, Cell, Column, Remark, Remarks, Table, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.dataset.summary import Range, Summary
    from mbds_xsim.dataset.verify import Verified


@shared.command("data", writes="json")
def inspect(
    to: shared.Outputs,
    path: Annotated[Path, Argument(metavar="FILE|DIR", help="A data file or a folder.")],
    png: Annotated[Path | None, shared.file("Draw paths of particles into this file.")] = None,
) -> None:
    """Sum up data sets: scene, engine, counts, figures of the checks, versions, size.

    Examples:
        mbds-xsim inspect data
        mbds-xsim inspect data/6pendulum/mujoco-matched.h5 --png paths.png
    """
    from mbds_xsim.dataset.read import load_dataset
    from mbds_xsim.dataset.summary import draw_paths, summaries

    to.check(png=png)
    sets = summaries(path)
    if png is not None and len(sets) > 1:
        msg = f"--png: {path} holds {len(sets)} data sets; name one of them, as {sets[0].file}"
        raise InputError(msg)
    if png is not None:
        draw_paths(load_dataset(sets[0].file), png)
    to.answer((b for summary in sets for b in summary_blocks(summary)), sets, "inspect")
    if png is not None:
        to.say(f"written: {png}")


def summary_blocks(summary: Summary) -> Iterator[Block]:
    """Describe a data set: its facts, its counts, and the figures of the checks."""
    rejected = summary.kind == "rejected"
    standing = "do not use as data" if rejected else summary.certification
    yield Text(f"{summary.file}  {summary.kind}, {standing}", "strong")
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
    cells: list[Cell | str] = [figure.check, str(figure.trajectories), *first, largest]
    if figure.allowed is None:
        return [*cells, "shown", ""]
    return [*cells, allowed, Cell("", "pass" if figure.kept else "fail")]


@shared.command("data", writes="json")
def export(
    to: shared.Outputs,
    dataset: Annotated[Path, Argument(metavar="DATASET", help="A data file or folder.")],
    out: Annotated[Path, Option(metavar="DIR", help="Folder to write, made if needed.")],
    form: Annotated[Literal["npz", "csv"], Option("--format", help="Format of the files.")],
    engines: Annotated[
        str | None, Option(help="Comma-separated; all that there are when left out.")
    ] = None,
    indices: Annotated[
        str | None, Option(help="Numbers of trajectories, as 0-9,15; all when left out.")
    ] = None,
) -> None:
    """Write data sets in a form that any program reads, and report what is not carried over.

    Examples:
        mbds-xsim export data --out npz --format npz
        mbds-xsim export data/6pendulum/mujoco-matched.h5 --out csv --format csv --indices 0-9
    """
    from mbds_xsim.dataset.export import export as run
    from mbds_xsim.dataset.read import parse_numbers

    numbers = None if indices is None else sorted(set(parse_numbers(indices, "--indices")))
    with shared.progress_on(to.console) as progress:
        exported = run(dataset, out, form, engines=engines, numbers=numbers, progress=progress)
    to.say(
        f"{counted(exported.trajectories, 'trajectory')} in "
        f"{counted(exported.files, 'file')}, {exported.bytes / 1e6:.4g} MB, "
        f"written to {exported.out}"
    )
    for file, missing in exported.absent.items():
        if missing:
            some = ", ".join(map(str, missing[:10])) + (" …" if len(missing) > 10 else "")
            cause = "published, not rejected" if exported.rejected else "rejected"
            to.say(f"{file} has not {some}: {cause}")
    to.say("not carried over:")
    for line in exported.lost:
        to.say(f"  {line}")
    to.write_json(encoded(exported, "export"))


@shared.command("data", writes="json html opened")
def audit(
    to: shared.Outputs,
    file: Annotated[Path, Argument(metavar="FILE", help="File of trajectories: npz, CSV or HDF5.")],
    scene: Annotated[
        str | None,
        Option(help="A built-in name, a family with a size, or a file; else the file's own."),
    ] = None,
    index: Annotated[
        str | None,
        Option(help="Numbers of the starts, in the file's order, as 0-9,15: compares with them."),
    ] = None,
    seed: Annotated[int | None, Option(help="Seed of those starts.", min=0)] = None,
    noise: Annotated[
        bool | None, Option(help="Whether their random forces acted.", show_default=False)
    ] = None,
    order: Annotated[
        int | None, Option(help="Order of the method that made it; 1 when left out.", min=1)
    ] = None,
    step: Annotated[
        float | None, Option(help="Its integration step [s]; else the frame.", min=1e-12)
    ] = None,
    velocity_lag: Annotated[
        float | None, Option(help="Velocities belong to frame time + lag [s].")
    ] = None,
    contact_time: Annotated[
        float | None, Option(help="Time over which it spreads an impact [s].", min=0.0)
    ] = None,
) -> None:
    """Check trajectories from any source: another engine, a lab, a learned model.

    Examples:
        mbds-xsim audit lab.csv --scene 6pendulum
        mbds-xsim audit model.npz --scene 6pendulum --index 0-9 --seed 0
    """
    from mbds_xsim.dataset.audit import audit_file
    from mbds_xsim.dataset.foreign import Provenance
    from mbds_xsim.dataset.read import parse_numbers
    from mbds_xsim.studies.audit import present

    origin = Provenance(
        index=None if index is None else tuple(parse_numbers(index, "--index")),
        seed=seed,
        noise=noise,
        step_s=step,
        method_order=order,
        velocity_lag_s=velocity_lag,
        contact_time_s=contact_time,
    )
    audited = audit_file(file, None if scene is None else shared.scene_named(scene), origin)
    report = present(audited, shared.command_line())
    to.show(report)
    to.give([report], audited.file, encoded(audited, "audit"))
    raise Exit(0 if audited.verdict == "pass" else 1)


_MOST = 20
"""Largest number of problems listed."""


@shared.command("data", writes="json")
def verify(
    to: shared.Outputs,
    path: Annotated[
        Path, Argument(metavar="FILE|DIR", help="A data file, with its shards, or a folder.")
    ],
    seed: Annotated[
        int | None,
        Option(help="Seed for choosing what to simulate again; random when left out.", min=0),
    ] = None,
    workers: shared.WorkerCount = None,
    limit: Annotated[float, shared.seconds("Time limit of each file [s].")] = LIMIT,
) -> None:
    """Check data again: layout, checksums, pairing, every check; simulate some trajectories anew.

    Examples:
        mbds-xsim verify data
        mbds-xsim verify data/6pendulum/mujoco-matched.h5
    """
    from mbds_xsim.dataset.verify import verify as run

    with shared.progress_on(to.console) as progress:
        verified = run(path, seed=seed, limit=limit, conduct=Conduct(workers, meter=progress))
    to.answer(_outcome(verified), verified, "verify")
    raise Exit(0 if verified.sound else 1)


def _outcome(verified: Verified) -> Iterator[Block]:
    """Describe the data, the checks made, and the problems found."""
    yield from map(_describe, verified.about)
    problems = [Remark(one.file, text, "fail") for one in verified.files for text in one.problems]
    yield Remarks(tuple(problems), most=_MOST)
    for note, count in Counter(note for one in verified.files for note in one.notes).items():
        yield Text(f"  {note}{f' ({count} files)' if count > 1 else ''}")
    if any("simulated again: " in note for one in verified.files for note in one.notes):
        yield Text(f"  simulated again: chosen by --seed {verified.seed}")
    checked = sum(one.trajectories for one in verified.files if one.kind in ("shard", "rejected"))
    verdict = (
        "everything holds what it says" if verified.sound else counted(len(problems), "problem")
    )
    yield Text(
        f"{counted(len(verified.files), 'file')}, {counted(checked, 'trajectory')} checked: "
        f"{verdict}",
        "pass" if verified.sound else "fail",
    )


def _describe(about: dict[str, object]) -> Text:
    noise = "with" if about["noise"] else "without"
    return Text(
        f"{about['file']}: {about['scene_name']} in {about['engine']} {about['engine_version']}, "
        f"{about['method']} at {about['step_s']:.6g} s, {about['certification']}; "
        f"{about['published']} of {about['count']} published, {noise} noise, seed {about['seed']}"
    )

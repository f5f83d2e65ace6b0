"""Commands to list (`engines`, `scenes`, `show`), check (`validate`, `diff`) and convert models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT, Conduct
from mbds_xsim.base.text import counted, encoded, in_utf8
from mbds_xsim.commands import shared
from mbds_xsim.report.blocks import Block, Remark, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.report.catalogue import EngineRow, SceneRow
    from mbds_xsim.scene.scene import Scene

Model = Annotated[
    Path, Argument(metavar="MODEL", help="A file: .xml (MJCF), .urdf, .sdf, .usd, .usda, .usdc.")
]
Floating = Annotated[
    bool, Option("--floating", help="Leave a URDF's root link free, not fixed in the world.")
]
OnGround = Annotated[
    bool,
    Option(
        "--ground",
        help="Let collision shapes touch the model's horizontal plane, or z = 0 without one.",
    ),
]
Folder = Annotated[
    Path | None,
    Option(help="Folder that files named in the model must lie in; its own when left out."),
]


@shared.command("check", writes="json html opened markdown")
def validate(
    to: shared.Outputs,
    scene: shared.SceneName,
    engines: shared.EngineNames = None,
    settings: Annotated[
        str, Option(help="matched, native, files of settings, or several (matched,native).")
    ] = "matched",
    trajectories: Annotated[int, Option(help="Starts of each interval.", min=1, max=10_000)] = 1,
    seed: shared.Seed = 0,
    method: Annotated[
        str | None, Option(help="Step with this method; needs one engine in --engines.")
    ] = None,
    step: Annotated[float | None, Option(help="Step [s], a divisor of the frame interval.")] = None,
    noise: Annotated[bool, Option(help="Random forces.")] = True,
    inputs: Annotated[bool, Option(help="Drawn inputs: wind, drives.")] = True,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
) -> None:
    """Run a scene in all engines, check every trajectory, and report which engines to trust.

    Examples:
        mbds-xsim validate 3ladder
        mbds-xsim validate my.toml --engines mujoco
    """
    from mbds_xsim.report.losses import loss_section
    from mbds_xsim.scene.sampling import Starts
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.simulate.registry import is_model, read_model
    from mbds_xsim.studies.validate import validate_with_evidence
    from mbds_xsim.studies.validate.present import present

    choice = Choice.parse(engines=engines, profiles=settings, method=method, step=step, limit=limit)
    with shared.progress_on(to.console) as progress:
        validation, evidence = validate_with_evidence(
            shared.scene_named(scene),
            choice=choice,
            starts=Starts(trajectories, seed, noise, inputs),
            conduct=Conduct(workers, cache, meter=progress),
            command=shared.command_line(),
        )
    to.show(present(validation))
    report = present(validation, evidence if to.paged else None)
    if is_model(scene) and (to.paged or to.markdown):
        losses = loss_section(read_model(Path(scene)))
        report = replace(report, blocks=(*report.blocks, losses))
    to.give([report], validation.scene, encoded(validation))
    raise Exit(0 if validation.verdict != "fail" else 1)


@shared.command("check", writes="json markdown")
def diff(
    to: shared.Outputs,
    old: Annotated[Path, Argument(metavar="OLD", help="JSON of the earlier result.")],
    new: Annotated[Path, Argument(metavar="NEW", help="JSON of the later one.")],
    rtol: Annotated[
        float, Option(help="Largest relative difference that is no change.", min=0.0)
    ] = 1e-6,
    factor: Annotated[
        float, Option(help="Largest factor between two times that is no change.", min=1.0)
    ] = 1.5,
) -> None:
    """Compare two results of one command and scene: exit code 1 if anything is worse, else 0.

    Examples:
        mbds-xsim diff reports/3ladder.json new.json
        mbds-xsim diff before.json after.json --markdown changes.md
    """
    from mbds_xsim.studies.diff.compare import compare_files
    from mbds_xsim.studies.diff.present import present

    comparison = compare_files(old, new, rtol=rtol, factor=factor)
    reports = list(present(comparison))
    for report in reports:
        to.show(report)
    to.give(reports, "", encoded(comparison))
    raise Exit(1 if comparison.verdict == "worse" else 0)


@shared.command("check", name="import", writes="json html opened markdown")
def import_model(
    to: shared.Outputs,
    model: Model,
    out: Annotated[Path | None, shared.file("Write the scene file.")] = None,
    floating: Floating = False,
    ground: OnGround = False,
    folder: Folder = None,
) -> None:
    """Make a scene file from another program's model, and report what is lost.

    Examples:
        mbds-xsim import ant.xml --out ant.toml
        mbds-xsim import anymal.urdf --floating --json losses.json
        mbds-xsim import ant.xml --ground --out ant.toml
    """
    from mbds_xsim.report.losses import import_row, present
    from mbds_xsim.scene.file import save_scene
    from mbds_xsim.simulate.registry import read_model

    to.check(out=out)
    with shared.progress_on(to.console) as progress:
        progress.begin(1, f"reading {model}")
        imported = read_model(model, folder=folder, floating=floating, ground=ground)
    if out is not None:
        save_scene(imported.scene, out)
    report = present(imported, shared.command_line())
    to.show(report)
    to.give([report], imported.scene.name, encoded(import_row(imported), "import"))


@shared.command("check", name="export-model", writes="json")
def export_model(
    to: shared.Outputs,
    scene: shared.SceneName,
    out: Annotated[Path, shared.file("Write the model.")],
    kind: Annotated[
        str, Option("--format", metavar="NAME", help="mjcf, urdf, sdf or usda.")
    ] = "mjcf",
) -> None:
    """Write a scene as another program's model, and report what is lost.

    Examples:
        mbds-xsim export-model bricard --format mjcf --out bricard.xml
        mbds-xsim export-model 2ladder --format usda --out ladder.usda
    """
    from mbds_xsim.base.files import write_whole
    from mbds_xsim.report.losses import loss_blocks
    from mbds_xsim.simulate.registry import registered, write_model

    to.check(out=out)
    ending = out.suffix[1:].lower()
    if ending != kind and ending in registered("mbds_xsim.model_writers"):
        raise InputError(f"--out: got {out} for the format {kind}; add --format {ending}")
    written = write_model(shared.scene_named(scene), kind)
    write_whole(out, written.text.encode())
    file = in_utf8(str(out))
    result = {"scene": in_utf8(scene), "format": kind, "file": file, "fates": written.fates}
    to.answer(loss_blocks(written), result, "export-model")


@shared.command("check", writes="json html opened markdown")
def readers(
    to: shared.Outputs,
    model: Model,
    engines: Annotated[
        str, Option(metavar="NAMES", help="Comma-separated: mujoco, pybullet, dart.")
    ] = "mujoco,pybullet,dart",
    floating: Floating = False,
    folder: Folder = None,
) -> None:
    """Compare the readings of a model by engines' own readers with what its file says.

    Example:
        mbds-xsim readers arm.urdf --engines pybullet,dart
    """
    from mbds_xsim.simulate.choice import words_of
    from mbds_xsim.studies.readers import compare, present

    with shared.progress_on(to.console) as progress:
        progress.begin(1, f"reading {model}")
        readings = compare(model, words_of(engines, "--engines"), folder=folder, floating=floating)
    report = present(readings, shared.command_line())
    to.show(report)
    to.give([report], readings.file, encoded(readings))
    raise Exit(0 if all(reading.alike for reading in readings.readings) else 1)


@shared.command("check")
def engines(
    json: shared.JsonFile = None,
    markdown: Annotated[
        bool, Option("--markdown", help="Print the page docs/engines.md instead.")
    ] = False,
) -> None:
    """List the engines, their methods, and what each cannot do."""
    from mbds_xsim.report.catalogue import engine_rows, engines_page

    if markdown and json:
        raise InputError("engines gives one form at a time; choose one of --markdown and --json")
    to = shared.Outputs(json)
    to.check()
    rows = engine_rows()
    if markdown:
        print(engines_page(rows), end="")
    else:
        to.answer((block for row in rows for block in _about_engine(row)), rows)


@shared.command("check", writes="json")
def scenes(to: shared.Outputs) -> None:
    """List the built-in scenes: size, degrees of freedom, what each needs of an engine."""
    from mbds_xsim.report.catalogue import scene_rows

    rows = scene_rows()
    to.answer(_about_scenes(rows), rows)


@shared.command("check", writes="json")
def show(
    to: shared.Outputs,
    scene: shared.SceneName,
    toml: Annotated[bool, Option("--toml", help="Print it as a scene file.")] = False,
    native: Annotated[
        str | None, Option(metavar="ENGINE", help="Print this engine's exact input, ready to run.")
    ] = None,
    settings: Annotated[
        str, Option(help="With --native: matched, native, or a file of `match --out`.")
    ] = "matched",
    png: Annotated[Path | None, shared.file("Draw it into a file.")] = None,
    start: Annotated[
        int | None,
        Option(
            help="With --png or --native: as this trajectory starts, not as the scene is written.",
            min=0,
            max=10**15,
        ),
    ] = None,
) -> None:
    """Describe a scene and its needs, draw it, or print what an engine is given.

    Examples:
        mbds-xsim show 3ladder --png ladder.png
        mbds-xsim show 5pendulum --native mujoco > pendulum.xml
        mbds-xsim show 5pendulum --start 2 --native dart | python
    """
    from mbds_xsim.report.catalogue import scene_row
    from mbds_xsim.scene.file import write_scene

    if sum(map(bool, (toml, native, to.json))) > 1:
        raise InputError("show gives one form at a time; choose one of --toml, --native and --json")
    if start is not None and png is None and native is None:
        msg = f"--start: got {start}, which says what is drawn or given; add --png or --native"
        raise InputError(msg)
    if settings != "matched" and native is None:
        msg = f"--settings: got {settings}, which says what an engine is given; add --native"
        raise InputError(msg)
    to.check(png=png)
    loaded = shared.scene_named(scene)
    text = None if native is None else _given(loaded, native, settings, start)
    if png is not None:
        from mbds_xsim.report.draw import draw_scene

        draw_scene(loaded, png, start=start)
    if text is not None:
        print(text)
    elif toml:
        print(write_scene(loaded), end="")
    else:
        row = scene_row(loaded)
        to.answer(_about_scene(loaded, row), row)


def _given(scene: Scene, native: str, settings: str, start: int | None) -> str:
    """Return exactly what an engine is given at its settings: a model file or a script."""
    from mbds_xsim.measure.quick import searched
    from mbds_xsim.report.catalogue import native_text
    from mbds_xsim.simulate.choice import Choice

    choice = Choice.parse(engines=native, profiles=settings)
    if len(choice.engines) * len(choice.profiles) > 1:
        msg = "show gives one engine's model at one of its settings"
        raise InputError(f"{msg}; got --native {native} --settings {settings}")
    with shared.progress_on(shared.console_for(Path("-"))) as progress:
        choice = searched(scene, choice, Conduct(meter=progress))
    (contender,), _ = choice.contenders(scene)
    return native_text(scene, contender.engine, contender.settings, start)


def _about_engine(row: EngineRow) -> Iterator[Block]:
    """Describe an engine: its methods, and what it and they cannot do."""
    coordinates = f", {row.coordinates} coordinates" if row.coordinates else ""
    yield Text(f"{row.engine} {row.version}{coordinates}", "strong")
    if row.fault:
        yield Text(row.fault)
    yield Remarks.of((m.name, f"{m.family}, order {m.order}") for m in row.methods)
    yield Remarks(tuple(_refusals("cannot", row.limits)))
    for method in row.methods:
        yield Remarks(tuple(_refusals(f"{method.name} cannot", method.refuses)))
    yield Text("")


def _refusals(subject: str, refusals: dict[str, str]) -> Iterator[Remark]:
    from mbds_xsim.report.catalogue import by_reason

    for reason, features in by_reason(refusals).items():
        yield Remark(subject, f"{', '.join(features)}: {reason}")


def _about_scenes(rows: list[SceneRow]) -> Iterator[Block]:
    yield table_of(
        ["scene", ">dim", ">bodies", ">particles", ">joints", ">loops", ">dof", "needs"],
        [
            [
                row.scene,
                f"{row.dimension}D",
                *map(str, (row.bodies, row.particles, row.joints, row.loops)),
                str(row.degrees_of_freedom),
                ", ".join(row.needs),
            ]
            for row in rows
        ],
    )
    yield Text("Families of any size: Npendulum, Nladder; or the path of a scene file.")


def _about_scene(scene: Scene, row: SceneRow) -> Iterator[Block]:
    """Describe a scene: its parts, its needs, and how its starts are drawn."""
    from mbds_xsim.report.catalogue import told_budgets, told_term
    from mbds_xsim.scene.mechanism import Mechanism
    from mbds_xsim.scene.reach import doubted_length

    mechanism, clock = Mechanism.of(scene), scene.clock
    loops = ", ".join(joint.name for joint in mechanism.loops) or "none"
    freedom = counted(row.degrees_of_freedom, "degree of freedom", "degrees of freedom")
    yield Text(f"{scene.name}  {scene.description}", "strong")
    if scene.source:
        yield Text(f"source: {scene.source}")
    yield Text(
        f"{counted(row.bodies, 'body')}, {counted(row.particles, 'particle')}, "
        f"{mechanism.mass.sum():g} kg, {freedom}, {scene.dimension}D"
    )
    yield Text(f"{counted(row.joints, 'joint')}; loops closed by: {loops}")
    yield Text(
        f"{counted(clock.steps, 'step')} of {clock.frame:g} s ({clock.duration:g} s); length "
        f"{scene.length:g} m; noise {scene.noise:g} N"
    )
    if doubt := doubted_length(scene):
        yield Text(doubt, "warn")
    yield Text(f"budgets: {told_budgets(scene)}")
    yield Text(f"needs: {', '.join(row.needs) or 'nothing'}")
    yield from (Text(f"draws {told_term(term)}") for term in scene.sampling)

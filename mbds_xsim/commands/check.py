"""What checks a result or a model: `mbds-xsim validate`, `diff`, `import`, `readers`, and so on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.commands import shared

Model = Annotated[
    Path, Argument(metavar="MODEL", help="A file: .xml (MJCF), .urdf, .sdf or .usda.")
]
Floating = Annotated[
    bool, Option("--floating", help="Leave a URDF's root link free, not fixed in the world.")
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
        str, Option(help="matched, native, a file of `match --out`, or two (matched,native).")
    ] = "matched",
    trajectories: Annotated[int, Option(help="Starts of each interval.", min=1, max=10_000)] = 1,
    seed: shared.Seed = 0,
    method: Annotated[
        str | None, Option(help="Step with this method, with --engines of one engine.")
    ] = None,
    step: Annotated[float | None, Option(help="Step [s], a divisor of the frame interval.")] = None,
    noise: Annotated[bool, Option(help="Random forces.")] = True,
    inputs: Annotated[bool, Option(help="Drawn inputs: wind, drives.")] = True,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
) -> None:
    """Run a scene in all engines, check every trajectory, and tell which to trust.

    Examples:
        mbds-xsim validate 3ladder
        mbds-xsim validate my.toml --engines mujoco
    """
    from mbds_xsim.measure.result import to_json
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.validate.present import present
    from mbds_xsim.studies.validate.validation import Choice, validate_with_evidence

    choice = Choice.parse(engines=engines, profiles=settings, method=method, step=step, limit=limit)
    with shared.progress_on(to.console) as progress:
        validation, evidence = validate_with_evidence(
            shared.scene_named(scene),
            choice=choice,
            trajectories=trajectories,
            seed=seed,
            noise=noise,
            inputs=inputs,
            cache=cache,
            workers=workers,
            progress=progress,
            command=shared.command_line(),
        )
    print_report(present(validation), to.console)
    shown = present(validation, evidence if to.paged else None)
    to.give([shown], validation.scene, to_json(validation))
    raise Exit(0 if validation.verdict != "fail" else 1)


@shared.command("check", writes="json markdown")
def diff(
    to: shared.Outputs,
    old: Annotated[Path, Argument(metavar="OLD", help="JSON of the earlier result.")],
    new: Annotated[Path, Argument(metavar="NEW", help="JSON of the later one.")],
    rtol: Annotated[
        float, Option(help="Relative difference of a figure that is no change.", min=0.0)
    ] = 1e-6,
    factor: Annotated[
        float, Option(help="Factor between two times that is no change.", min=1.0)
    ] = 1.5,
) -> None:
    """Compare two results of one command and scene: 0 nothing is worse, 1 something is.

    Examples:
        mbds-xsim diff reports/3ladder.json new.json
        mbds-xsim diff before.json after.json --markdown changes.md
    """
    from mbds_xsim.report.terminal import print_blocks, print_report
    from mbds_xsim.studies.diff.compare import compare_files
    from mbds_xsim.studies.diff.present import present, remarks_of

    comparison = compare_files(old, new, rtol=rtol, factor=factor)
    reports = list(present(comparison))
    print_blocks([remarks_of(comparison)], to.console)
    for report in reports:
        print_report(report, to.console)
    to.give(reports, "", shared.encoded(comparison))
    raise Exit(1 if comparison.verdict == "worse" else 0)


@shared.command("check", name="import", writes="json html opened markdown")
def import_model(
    to: shared.Outputs,
    model: Model,
    out: Annotated[Path | None, Option(metavar="FILE", help="Write the scene file.")] = None,
    floating: Floating = False,
    folder: Folder = None,
) -> None:
    """Make a scene file of another program's model, and tell what of it is lost.

    Examples:
        mbds-xsim import ant.xml --out ant.toml
        mbds-xsim import anymal.urdf --floating --json losses.json
    """
    from mbds_xsim.report.losses import import_row, present
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.scene.file import save_scene
    from mbds_xsim.simulate.registry import read_model

    to.check(out=out)
    with shared.progress_on(to.console) as progress:
        progress.begin(1, f"reading {model}")
        imported = read_model(model, folder=folder, floating=floating)
    if out is not None:
        save_scene(imported.scene, out)
    report = present(imported, shared.command_line())
    print_report(report, to.console)
    to.give([report], imported.scene.name, shared.encoded(import_row(imported), "import"))


@shared.command("check", name="export-model")
def export_model(
    scene: shared.SceneName,
    out: Annotated[Path, Option(metavar="FILE", help="Write the model.")],
    kind: Annotated[str, Option("--format", metavar="NAME", help="mjcf or urdf.")] = "mjcf",
    json: shared.JsonFile = None,
) -> None:
    """Write a scene as another program's model, and tell what of it is lost.

    Example:
        mbds-xsim export-model bricard --format mjcf --out bricard.xml
    """
    from mbds_xsim.base.files import write_whole
    from mbds_xsim.report.losses import loss_blocks
    from mbds_xsim.simulate.registry import write_model

    shared.check_targets(out=out, json=json)
    written = write_model(shared.scene_named(scene), kind)
    write_whole(out, written.text.encode())
    result = {"scene": scene, "format": kind, "file": str(out), "fates": written.fates}
    shared.answer(loss_blocks(written), result, json, "export-model")


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
    """Hold what engines' own readers make of a model against what its file says.

    Example:
        mbds-xsim readers arm.urdf --engines pybullet,dart
    """
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.readers import compare, present

    with shared.progress_on(to.console) as progress:
        progress.begin(1, f"reading {model}")
        readings = compare(model, engines.split(","), folder=folder, floating=floating)
    report = present(readings, shared.command_line())
    print_report(report, to.console)
    to.give([report], readings.file, shared.encoded(readings))
    raise Exit(0 if all(reading.alike for reading in readings.readings) else 1)

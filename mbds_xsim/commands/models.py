"""`mbds-xsim import`, `export-model` and `readers`: models of other formats, and what is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

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


@shared.command(
    "check",
    name="import",
    epilog="Examples:  mbds-xsim import ant.xml --out ant.toml  ·  "
    "mbds-xsim import anymal.urdf --floating --json losses.json",
)
def import_model(
    model: Model,
    out: Annotated[Path | None, Option(metavar="FILE", help="Write the scene file.")] = None,
    floating: Floating = False,
    folder: Folder = None,
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
    markdown: shared.MarkdownFile = None,
) -> None:
    """Make a scene file of another program's model, and tell what of it is lost."""
    from mbds_xsim.report.losses import import_row, present
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.scene.file import save_scene
    from mbds_xsim.simulate.registry import read_model

    shared.check_targets(out=out, json=json, html=html, markdown=markdown)
    console = shared.console_for(json)
    with shared.progress_on(console) as progress:
        progress.begin(1, f"reading {model}")
        imported = read_model(model, folder=folder, floating=floating)
    if out is not None:
        save_scene(imported.scene, out)
    report = present(imported, shared.command_line())
    print_report(report, console)
    shared.deliver(
        [report], imported.scene.name, console, html=html, markdown=markdown, opened=opened
    )
    shared.write_json(shared.encoded(import_row(imported), "import"), json)


@shared.command(
    "check",
    name="export-model",
    epilog="Example:  mbds-xsim export-model bricard --format mjcf --out bricard.xml",
)
def export_model(
    scene: shared.SceneName,
    out: Annotated[Path, Option(metavar="FILE", help="Write the model.")],
    kind: Annotated[str, Option("--format", metavar="NAME", help="mjcf or urdf.")] = "mjcf",
    json: shared.JsonFile = None,
) -> None:
    """Write a scene as another program's model, and tell what of it is lost."""
    from mbds_xsim.base.files import write_whole
    from mbds_xsim.report.losses import loss_blocks
    from mbds_xsim.simulate.registry import write_model

    shared.check_targets(out=out, json=json)
    written = write_model(shared.scene_named(scene), kind)
    write_whole(out, written.text.encode())
    result = {"scene": scene, "format": kind, "file": str(out), "fates": written.fates}
    shared.answer(loss_blocks(written), result, json, "export-model")


@shared.command("check", epilog="Example:  mbds-xsim readers arm.urdf --engines pybullet,dart")
def readers(
    model: Model,
    engines: Annotated[
        str, Option(metavar="NAMES", help="Comma-separated: mujoco, pybullet, dart.")
    ] = "mujoco,pybullet,dart",
    floating: Floating = False,
    folder: Folder = None,
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
    markdown: shared.MarkdownFile = None,
) -> None:
    """Hold what engines' own readers make of a model against what its file says."""
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.readers import compare, present

    shared.check_targets(json=json, html=html, markdown=markdown)
    console = shared.console_for(json)
    with shared.progress_on(console) as progress:
        progress.begin(1, f"reading {model}")
        readings = compare(model, engines.split(","), folder=folder, floating=floating)
    report = present(readings, shared.command_line())
    print_report(report, console)
    shared.deliver([report], readings.file, console, html=html, markdown=markdown, opened=opened)
    shared.write_json(shared.encoded(readings), json)
    raise Exit(0 if all(reading.alike for reading in readings.readings) else 1)

"""`mbds-xsim import`: a model of another format becomes a scene file, with a report of losses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from mbds_xsim.commands import shared


@shared.command(
    "check",
    name="import",
    epilog="Examples:  mbds-xsim import ant.xml --out ant.toml  ·  "
    "mbds-xsim import anymal.urdf --floating --json losses.json",
)
def import_model(
    model: Annotated[Path, Argument(metavar="MODEL", help="An MJCF (.xml) or URDF (.urdf) file.")],
    out: Annotated[Path | None, Option(metavar="FILE", help="Write the scene file.")] = None,
    floating: Annotated[
        bool, Option("--floating", help="Leave a URDF's root link free, not fixed in the world.")
    ] = False,
    folder: Annotated[
        Path | None,
        Option(help="Folder that files named in the model must lie in; its own when left out."),
    ] = None,
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    markdown: shared.MarkdownFile = None,
) -> None:
    """Make a scene file of another program's model, and tell what of it is lost."""
    from mbds_xsim.report.losses import import_row, present
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.scene.file import save_scene
    from mbds_xsim.simulate.models import read_model

    shared.check_targets(out=out, json=json, html=html, markdown=markdown)
    console = shared.console_for(json)
    with shared.progress_on(console) as progress:
        progress.begin(1, f"reading {model}")
        imported = read_model(model, folder=folder, floating=floating)
    if out is not None:
        save_scene(imported.scene, out)
    report = present(imported, shared.command_line())
    print_report(report, console)
    shared.deliver([report], imported.scene.name, console, html=html, markdown=markdown)
    shared.write_json(shared.encoded(import_row(imported), "import"), json)

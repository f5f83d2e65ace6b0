"""`mbds-xsim contact`: what contact means in each engine, measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.base.errors import InputError
from mbds_xsim.commands.shared import (
    LIMIT,
    EngineNames,
    JsonFile,
    TimeLimit,
    WorkerCount,
    check_targets,
    command,
    command_line,
    console_for,
    encoded,
    progress_on,
    write_json,
)


@command(
    "study",
    epilog="Examples:  mbds-xsim contact --engines dart  ·  "
    "mbds-xsim contact --markdown docs/contact.md --figures docs/images",
)
def contact(
    engines: EngineNames = None,
    settings: Annotated[
        str, typer.Option(help="native, matched, or both side by side (native,matched).")
    ] = "native,matched",
    workers: WorkerCount = None,
    limit: TimeLimit = LIMIT,
    json: JsonFile = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the page docs/contact.md.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw the page's figures into a folder.")
    ] = None,
) -> None:
    """Measure what contact means in each engine: rebound, friction, rest, energy, limits."""
    from mbds_xsim.report.terminal import print_blocks
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.contact.present import present
    from mbds_xsim.studies.contact.study import study_contact

    console = console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if choice.given:
        msg = f"--settings: got {settings}, allowed are matched and native: what is measured has "
        raise InputError(msg + "scenes of its own, and a file of settings is matched for one scene")
    drawn = {} if figures is None else _figure_files(figures)
    check_targets(json=json, markdown=markdown, **drawn)
    with progress_on(console) as progress:
        study = study_contact(
            choice,
            progress=progress,
            workers=workers,
            command=command_line(),
        )
    print_blocks(present(study), console)
    if drawn:
        from mbds_xsim.studies.contact.figures import draw_study

        draw_study(study, drawn)
    if markdown is not None:
        from mbds_xsim.base.write import write_whole
        from mbds_xsim.studies.contact.page import contact_page

        write_whole(markdown, contact_page(study, drawn, markdown.parent).encode())
    write_json(encoded(study, "contact"), json)


def _figure_files(folder: Path) -> dict[str, Path]:
    return {name: folder / f"contact-{name}.png" for name in ("restitution", "friction")}

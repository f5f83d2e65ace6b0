"""`mbds-xsim contact`: what contact means in each engine, measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.commands import shared


@shared.command(
    "study",
    epilog="Examples:  mbds-xsim contact --engines dart  ·  "
    "mbds-xsim contact --markdown docs/contact.md --figures docs/images",
)
def contact(
    engines: shared.EngineNames = None,
    settings: Annotated[
        str, Option(help="native, matched, or both side by side (native,matched).")
    ] = "native,matched",
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
    json: shared.JsonFile = None,
    markdown: Annotated[
        Path | None, Option(metavar="FILE", help="Write the page docs/contact.md.")
    ] = None,
    figures: Annotated[
        Path | None, Option(metavar="DIR", help="Draw the page's figures into a folder.")
    ] = None,
) -> None:
    """Measure what contact means in each engine: rebound, friction, rest, energy, limits."""
    from mbds_xsim.report.terminal import print_blocks
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.contact.present import present
    from mbds_xsim.studies.contact.study import study_contact

    console = shared.console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if choice.given:
        msg = f"--settings: got {settings}, allowed are matched and native: what is measured has "
        raise InputError(msg + "scenes of its own, and a file of settings is matched for one scene")
    drawn = {} if figures is None else _figure_files(figures)
    shared.check_targets(json=json, markdown=markdown, **drawn)
    with shared.progress_on(console) as progress:
        study = study_contact(
            choice,
            progress=progress,
            workers=workers,
            command=shared.command_line(),
        )
    print_blocks(present(study), console)
    if drawn:
        from mbds_xsim.studies.contact.present import draw_study

        draw_study(study, drawn)
    if markdown is not None:
        from mbds_xsim.base.write import write_whole
        from mbds_xsim.studies.contact.page import contact_page

        write_whole(markdown, contact_page(study, drawn, markdown.parent).encode())
    shared.write_json(shared.encoded(study, "contact"), json)


def _figure_files(folder: Path) -> dict[str, Path]:
    return {name: folder / f"contact-{name}.png" for name in ("restitution", "friction")}

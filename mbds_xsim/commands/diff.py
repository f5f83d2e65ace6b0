"""`mbds-xsim diff`: what changed between two results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    JsonFile,
    check_targets,
    command,
    console_for,
    deliver,
    encoded,
    write_json,
)


@command(
    "check",
    epilog="Examples:  mbds-xsim diff reports/3ladder.json new.json  ·  "
    "mbds-xsim diff before.json after.json --markdown changes.md",
)
def diff(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="JSON of the earlier result.")],
    new: Annotated[Path, typer.Argument(metavar="NEW", help="JSON of the later one.")],
    rtol: Annotated[
        float, typer.Option(help="Relative difference of a figure that is no change.", min=0.0)
    ] = 1e-6,
    factor: Annotated[
        float, typer.Option(help="Factor between two times that is no change.", min=1.0)
    ] = 1.5,
    json: JsonFile = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write everything as Markdown.")
    ] = None,
) -> None:
    """Compare two results of one command and scene: 0 nothing is worse, 1 something is."""
    from mbds_xsim.report.terminal import print_blocks, print_report
    from mbds_xsim.studies.diff.compare import compare_files
    from mbds_xsim.studies.diff.present import present, remarks_of

    check_targets(json=json, markdown=markdown)
    comparison = compare_files(old, new, rtol=rtol, factor=factor)
    console, reports = console_for(json), list(present(comparison))
    print_blocks([remarks_of(comparison)], console)
    for report in reports:
        print_report(report, console)
    deliver(reports, "", console, markdown=markdown)
    write_json(encoded(comparison), json)
    raise typer.Exit(1 if comparison.verdict == "worse" else 0)

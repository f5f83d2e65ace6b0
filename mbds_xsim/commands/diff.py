"""`mbds-xsim diff`: what changed between two results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from mbds_xsim.commands import shared


@shared.command(
    "check",
    epilog="Examples:  mbds-xsim diff reports/3ladder.json new.json  ·  "
    "mbds-xsim diff before.json after.json --markdown changes.md",
)
def diff(
    old: Annotated[Path, Argument(metavar="OLD", help="JSON of the earlier result.")],
    new: Annotated[Path, Argument(metavar="NEW", help="JSON of the later one.")],
    rtol: Annotated[
        float, Option(help="Relative difference of a figure that is no change.", min=0.0)
    ] = 1e-6,
    factor: Annotated[
        float, Option(help="Factor between two times that is no change.", min=1.0)
    ] = 1.5,
    json: shared.JsonFile = None,
    markdown: Annotated[
        Path | None, Option(metavar="FILE", help="Write everything as Markdown.")
    ] = None,
) -> None:
    """Compare two results of one command and scene: 0 nothing is worse, 1 something is."""
    from mbds_xsim.report.terminal import print_blocks, print_report
    from mbds_xsim.studies.diff.compare import compare_files
    from mbds_xsim.studies.diff.present import present, remarks_of

    shared.check_targets(json=json, markdown=markdown)
    comparison = compare_files(old, new, rtol=rtol, factor=factor)
    console, reports = shared.console_for(json), list(present(comparison))
    print_blocks([remarks_of(comparison)], console)
    for report in reports:
        print_report(report, console)
    shared.deliver(reports, "", console, markdown=markdown)
    shared.write_json(shared.encoded(comparison), json)
    raise Exit(1 if comparison.verdict == "worse" else 0)

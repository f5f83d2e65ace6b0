"""`mbds-xsim validate` and `diff`: which engines to trust, and what changed between two results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.commands import shared


@shared.command(
    "check",
    epilog="Examples:  mbds-xsim validate 3ladder  ·  mbds-xsim validate my.toml --engines mujoco",
)
def validate(
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
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
    markdown: Annotated[
        Path | None, Option(metavar="FILE", help="Write the table as Markdown.")
    ] = None,
) -> None:
    """Run a scene in all engines, check every trajectory, and tell which to trust."""
    from mbds_xsim.measure.result import to_json
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.validate.present import present
    from mbds_xsim.studies.validate.validation import Choice, validate_with_evidence

    console = shared.console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, method=method, step=step, limit=limit)
    shared.check_targets(json=json, html=html, markdown=markdown)
    with shared.progress_on(console) as progress:
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
    print_report(present(validation), console)
    shown = present(validation, evidence if html is not None or opened else None)
    shared.deliver([shown], validation.scene, console, html=html, markdown=markdown, opened=opened)
    shared.write_json(to_json(validation), json)
    raise Exit(0 if validation.verdict != "fail" else 1)


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

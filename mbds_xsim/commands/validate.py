"""`mbds-xsim validate`: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    LIMIT,
    CacheUse,
    EngineNames,
    HtmlFile,
    JsonFile,
    Opened,
    SceneName,
    Seed,
    TimeLimit,
    WorkerCount,
    check_targets,
    command,
    command_line,
    console_for,
    deliver,
    progress_on,
    scene_named,
    write_json,
)


@command(
    "check",
    epilog="Examples:  mbds-xsim validate 3ladder  ·  mbds-xsim validate my.toml --engines mujoco",
)
def validate(
    scene: SceneName,
    engines: EngineNames = None,
    settings: Annotated[
        str, typer.Option(help="matched, native, a file of `match --out`, or two (matched,native).")
    ] = "matched",
    trajectories: Annotated[
        int, typer.Option(help="Starts of each interval.", min=1, max=10_000)
    ] = 1,
    seed: Seed = 0,
    method: Annotated[
        str | None, typer.Option(help="Step with this method, with --engines of one engine.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Step [s], a divisor of the frame interval.")
    ] = None,
    noise: Annotated[bool, typer.Option(help="Random forces.")] = True,
    inputs: Annotated[bool, typer.Option(help="Drawn inputs: wind, drives.")] = True,
    cache: CacheUse = True,
    workers: WorkerCount = None,
    limit: TimeLimit = LIMIT,
    json: JsonFile = None,
    html: HtmlFile = None,
    opened: Opened = False,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as Markdown.")
    ] = None,
) -> None:
    """Run a scene in all engines, check every trajectory, and tell which to trust."""
    from mbds_xsim.measure.result import to_json
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.validate.present import present
    from mbds_xsim.studies.validate.validation import Choice, validate_with_evidence

    console = console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, method=method, step=step, limit=limit)
    check_targets(json=json, html=html, markdown=markdown)
    with progress_on(console) as progress:
        validation, evidence = validate_with_evidence(
            scene_named(scene),
            choice=choice,
            trajectories=trajectories,
            seed=seed,
            noise=noise,
            inputs=inputs,
            cache=cache,
            workers=workers,
            progress=progress,
            command=command_line(),
        )
    print_report(present(validation), console)
    shown = present(validation, evidence if html is not None or opened else None)
    deliver([shown], validation.scene, console, html=html, markdown=markdown, opened=opened)
    write_json(to_json(validation), json)
    raise typer.Exit(0 if validation.verdict != "fail" else 1)

"""`mbds-xsim plan`: what a data set will cost."""

from __future__ import annotations

from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    LIMIT,
    EngineNames,
    JsonFile,
    SceneName,
    TimeLimit,
    check_targets,
    command,
    console_for,
    encoded,
    progress_on,
    scene_named,
    write_json,
)

__all__ = ["plan"]


@command(
    "data",
    epilog="Examples:  mbds-xsim plan 6pendulum --trajectories 1000000000  ·  "
    "mbds-xsim plan 3ladder --engines mujoco,dart --trajectories 15000 --workers 64",
)
def plan(
    scene: SceneName,
    trajectories: Annotated[int, typer.Option(help="How many are planned.", min=1)] = 15_000,
    engines: EngineNames = None,
    settings: Annotated[
        str, typer.Option(help="matched, native, a file of `match --out`, or two: matched,native.")
    ] = "matched",
    sample: Annotated[
        int, typer.Option(help="Trajectories of each of the two measured shards.", min=2, max=1000)
    ] = 6,
    workers: Annotated[
        int | None, typer.Option(help="Processes that will work; all cores when left out.", min=1)
    ] = None,
    limit: TimeLimit = LIMIT,
    json: JsonFile = None,
) -> None:
    """Measure a few trajectories and tell core-hours and bytes of a data set of any size."""
    from mbds_xsim.choice import Choice
    from mbds_xsim.dataset.estimate import plan as run
    from mbds_xsim.report.planning import print_plan

    console = console_for(json)
    check_targets(json=json)
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    with progress_on(console) as progress:
        found = run(
            scene_named(scene),
            choice,
            trajectories,
            sample=sample,
            workers=workers,
            progress=progress,
        )
    print_plan(found, console)
    write_json(encoded(found, "plan"), json)
    raise typer.Exit(0 if all(not one.failure for one in found.estimates) else 1)

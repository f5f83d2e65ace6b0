"""`mbds-xsim ablate`: no more than a scene needs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.base.errors import InputError
from mbds_xsim.commands.shared import (
    LIMIT,
    CacheUse,
    EngineNames,
    JsonFile,
    SceneNames,
    Seed,
    TimeLimit,
    WorkerCount,
    check_targets,
    command,
    command_line,
    console_for,
    deliver,
    encoded,
    progress_on,
    scene_named,
    write_json,
)


@command(
    "study",
    epilog="Examples:  mbds-xsim ablate 3ladder  ·  "
    "mbds-xsim ablate 5pendulum balldrop --trajectories 4 --markdown ablation.md",
)
def ablate(
    scenes: SceneNames,
    engines: EngineNames = None,
    settings: Annotated[
        str, typer.Option(help="Of the engines: matched, native, or a file of `match --out`.")
    ] = "matched",
    trajectories: Annotated[
        int, typer.Option(help="Starts of each interval.", min=1, max=1000)
    ] = 2,
    seed: Seed = 0,
    cache: CacheUse = True,
    workers: WorkerCount = None,
    limit: TimeLimit = LIMIT,
    json: JsonFile = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the tables as Markdown.")
    ] = None,
) -> None:
    """Drop and halve what a scene models; compare with the disagreement between engines."""
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.ablate.present import present
    from mbds_xsim.studies.ablate.study import ablate as study

    console = console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if len(choice.profiles) > 1:
        msg = f"--settings: got {settings}, allowed is one of matched, native and a file"
        raise InputError(msg)
    check_targets(json=json, markdown=markdown)
    found = []
    for scene in [scene_named(name) for name in scenes]:
        with progress_on(console) as progress:
            result = study(
                scene,
                choice=choice,
                starts=trajectories,
                seed=seed,
                cache=cache,
                workers=workers,
                progress=progress,
                command=command_line(),
            )
        print_report(present(result), console)
        found.append(result)
        deliver([present(one) for one in found], "", console, markdown=markdown)
    write_json(encoded(found[0] if len(found) == 1 else found), json)

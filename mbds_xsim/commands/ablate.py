"""`mbds-xsim ablate`: no more than a scene needs."""

from __future__ import annotations

from typing import Annotated

from typer import Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.commands import shared


@shared.command(
    "study",
    epilog="Examples:  mbds-xsim ablate 3ladder  ·  "
    "mbds-xsim ablate 5pendulum balldrop --trajectories 4 --markdown ablation.md",
)
def ablate(
    scenes: shared.SceneNames,
    engines: shared.EngineNames = None,
    settings: Annotated[
        str, Option(help="Of the engines: matched, native, or a file of `match --out`.")
    ] = "matched",
    trajectories: Annotated[int, Option(help="Starts of each interval.", min=1, max=1000)] = 2,
    seed: shared.Seed = 0,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
    json: shared.JsonFile = None,
    markdown: shared.MarkdownFile = None,
) -> None:
    """Drop and halve what a scene models; compare with the disagreement between engines."""
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.ablate.present import present
    from mbds_xsim.studies.ablate.study import ablate as study

    console = shared.console_for(json)
    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if len(choice.profiles) > 1:
        msg = f"--settings: got {settings}, allowed is one of matched, native and a file"
        raise InputError(msg)
    shared.check_targets(json=json, markdown=markdown)
    found = []
    for scene in [shared.scene_named(name) for name in scenes]:
        with shared.progress_on(console) as progress:
            result = study(
                scene,
                choice=choice,
                starts=trajectories,
                seed=seed,
                cache=cache,
                workers=workers,
                progress=progress,
                command=shared.command_line(),
            )
        print_report(present(result), console)
        found.append(result)
        shared.deliver([present(one) for one in found], "", console, markdown=markdown)
    shared.write_json(shared.encoded(found[0] if len(found) == 1 else found), json)

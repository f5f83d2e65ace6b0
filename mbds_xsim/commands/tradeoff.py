"""`mbds-xsim tradeoff`: speed against accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    CacheUse,
    EngineNames,
    JsonFile,
    SceneNames,
    Seed,
    WorkerCount,
    app,
    check_targets,
    command_line,
    console_for,
    scene_named,
    write_json,
)

__all__ = ["tradeoff"]


@app.command(
    epilog="Examples:  mbds-xsim tradeoff 3ladder --html ladder.html  ·  "
    "mbds-xsim tradeoff 5pendulum 6pendulum --engines mujoco,exudyn --csv rows.csv"
)
def tradeoff(
    scenes: SceneNames,
    engines: EngineNames = None,
    starts: Annotated[
        int, typer.Option(help="Starts of the medium interval.", min=1, max=1000)
    ] = 3,
    seed: Seed = 0,
    limit: Annotated[
        float,
        typer.Option(
            help="Longest rollout of one start [s]; slower points are only listed.", min=0.1
        ),
    ] = 30.0,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Measure again what was measured earlier.")
    ] = False,
    cache: CacheUse = True,
    workers: WorkerCount = None,
    json: JsonFile = None,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the raw rows as CSV.")
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a self-contained page.")
    ] = None,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the charts.")] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the tables as Markdown.")
    ] = None,
) -> None:
    """Chart speed against accuracy: every engine, method and step, and their options."""
    from mbds_xsim.choice import Choice
    from mbds_xsim.isolate import core_count
    from mbds_xsim.report.tradeoff_files import write_files
    from mbds_xsim.report.tradeoff_progress import StudyBar
    from mbds_xsim.report.tradeoff_terminal import print_tradeoff
    from mbds_xsim.study.rows import to_json
    from mbds_xsim.study.tradeoff import tradeoff_with_rows

    console = console_for(json)
    choice = Choice.parse(engines=engines)
    check_targets(json=json, csv=csv, html=html, png=png, markdown=markdown)
    loaded = [scene_named(name) for name in scenes]
    studies, rows = [], []
    for scene in loaded:
        with StudyBar(console, workers or core_count(), scene.name) as meter:
            study, found = tradeoff_with_rows(
                scene,
                choice=choice,
                starts=starts,
                seed=seed,
                limit=limit,
                workers=workers,
                fresh=fresh,
                cache=cache,
                meter=meter,
                command=command_line(),
            )
        studies.append(study)
        rows += found
        print_tradeoff(study, console)
    write_files(studies, rows, csv=csv, html=html, png=png, markdown=markdown)
    write_json(to_json(studies), json)

"""`mbds-xsim tradeoff`: speed against accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mbds_xsim.commands.shared import (
    CacheUse,
    EngineNames,
    HtmlFile,
    JsonFile,
    ModelPlaces,
    Opened,
    SceneNames,
    Seed,
    WorkerCount,
    check_targets,
    check_torch,
    command,
    command_line,
    console_for,
    deliver,
    scene_named,
    write_json,
)

if TYPE_CHECKING:
    from mbds_xsim.learn.trained import TrainedModel
    from mbds_xsim.scene.scene import Scene
    from mbds_xsim.studies.tradeoff.rows import Measurement, Tradeoff


@command(
    "study",
    epilog="Examples:  mbds-xsim tradeoff 3ladder --html ladder.html  ·  "
    "mbds-xsim tradeoff 5pendulum 6pendulum --engines mujoco,exudyn --csv rows.csv  ·  "
    "mbds-xsim tradeoff 6pendulum --models models/6pendulum --onto 6pendulum.json --png both.png",
)
def tradeoff(
    scenes: SceneNames,
    engines: EngineNames = None,
    models: ModelPlaces = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --models: take the engines from the JSON of an earlier run of the scene.",
        ),
    ] = None,
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
    html: HtmlFile = None,
    opened: Opened = False,
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the charts.")] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the tables as Markdown.")
    ] = None,
) -> None:
    """Chart speed against accuracy: every engine, method and step, and their options."""
    from mbds_xsim.base.isolate import core_count
    from mbds_xsim.report.bar import StudyBar
    from mbds_xsim.report.files import link, results_json, rows_csv, write_if
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.tradeoff.present import present, to_png

    console = console_for(json)
    choice = Choice.parse(engines=engines)
    check_targets(json=json, csv=csv, html=html, png=png, markdown=markdown)
    loaded = [scene_named(name) for name in scenes]
    trained = _models(models, onto, loaded)
    studies, rows = [], []
    for scene in loaded:
        with StudyBar(console, workers or core_count(), scene.name) as meter:
            study, found = _engines(
                onto,
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
            if trained:
                from mbds_xsim.studies.tradeoff.learned import with_models

                study, more = with_models(
                    study,
                    scene,
                    trained,
                    workers=workers,
                    fresh=fresh,
                    cache=cache,
                    meter=meter,
                    command=f"{study.command} && {command_line()}" if onto else "",
                )
                found = found + more
        studies.append(study)
        rows += found
        print_report(present(study), console)
    stored = results_json(studies)
    write_if(csv, lambda: rows_csv(rows))
    write_if(png, lambda: to_png(studies, stored))
    reports = [
        present(study, link(png, markdown) if not k else "") for k, study in enumerate(studies)
    ]
    deliver(reports, "Speed against accuracy", console, html=html, markdown=markdown, opened=opened)
    write_json(stored, json)


def _engines(onto: Path | None, scene: Scene, **how: Any) -> tuple[Tradeoff, list[Measurement]]:
    """Read the engines' part of a study, without its rows, or measure it."""
    from mbds_xsim.studies.tradeoff.rows import read_tradeoff
    from mbds_xsim.studies.tradeoff.study import tradeoff_with_rows

    return (read_tradeoff(onto), []) if onto is not None else tradeoff_with_rows(scene, **how)


def _models(
    places: list[Path] | None, onto: Path | None, scenes: list[Scene]
) -> list[TrainedModel]:
    """Find the models, and refuse them before engines are measured where there are none."""
    from mbds_xsim.base.errors import InputError

    if onto is not None and (not places or len(scenes) != 1):
        msg = "--onto: models are put onto a stored trade-off; name one SCENE and --models"
        raise InputError(msg)
    if not places:
        return []
    check_torch("tradeoff --models")
    from mbds_xsim.learn.trained import trained_in
    from mbds_xsim.studies.tradeoff.learned import models_of

    found = trained_in(places)
    for scene in scenes:
        models_of(scene, found)
    return found

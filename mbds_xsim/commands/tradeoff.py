"""`mbds-xsim tradeoff`: speed against accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from mbds_xsim.commands import shared

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mbds_xsim.learn.trained import TrainedModel
    from mbds_xsim.scene.scene import Scene
    from mbds_xsim.studies.tradeoff.rows import Measurement, Tradeoff


_Onto = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="With --models: take the engines from the JSON of an earlier run of the scene.",
    ),
]
_Starts = Annotated[int, Option(help="Starts of the medium interval.", min=1, max=1000)]
_Limit = Annotated[
    float, Option(help="Longest rollout of one start [s]; slower points are only listed.", min=0.1)
]
_Fresh = Annotated[bool, Option("--fresh", help="Measure again what was measured earlier.")]
_Csv = Annotated[Path | None, Option(metavar="FILE", help="Write the raw rows as CSV.")]
_Png = Annotated[Path | None, Option(metavar="FILE", help="Write the charts.")]


@shared.command(
    "study",
    epilog="Examples:  mbds-xsim tradeoff 3ladder --html ladder.html  ·  "
    "mbds-xsim tradeoff 5pendulum 6pendulum --engines mujoco,exudyn --csv rows.csv  ·  "
    "mbds-xsim tradeoff 6pendulum --models models/6pendulum --onto 6pendulum.json --png both.png",
)
def tradeoff(
    scenes: shared.SceneNames,
    engines: shared.EngineNames = None,
    models: shared.ModelPlaces = None,
    onto: _Onto = None,
    starts: _Starts = 3,
    seed: shared.Seed = 0,
    limit: _Limit = 30.0,
    fresh: _Fresh = False,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    json: shared.JsonFile = None,
    csv: _Csv = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
    png: _Png = None,
    markdown: shared.MarkdownFile = None,
) -> None:
    """Chart speed against accuracy: every engine, method and step, and their options."""
    from mbds_xsim.base.isolate import core_count
    from mbds_xsim.report.bar import StudyBar
    from mbds_xsim.report.files import link, results_json, rows_csv, write_if
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.tradeoff.present import present, to_png

    console = shared.console_for(json)
    choice = Choice.parse(engines=engines)
    shared.check_targets(json=json, csv=csv, html=html, png=png, markdown=markdown)
    loaded = [shared.scene_named(name) for name in scenes]
    trained = _models(models, onto, loaded)
    how: dict[str, Any] = {"workers": workers, "fresh": fresh, "cache": cache}
    asked = {"choice": choice, "starts": starts, "seed": seed, "limit": limit}
    studies, rows = [], []
    for scene in loaded:
        with StudyBar(console, workers or core_count(), scene.name) as meter:
            study, found = _chart(scene, onto, trained, asked, meter=meter, **how)
        studies.append(study)
        rows += found
        print_report(present(study), console)
    stored = results_json(studies)
    write_if(csv, lambda: rows_csv(rows))
    write_if(png, lambda: to_png(studies, stored))
    reports = [
        present(study, link(png, markdown) if not k else "") for k, study in enumerate(studies)
    ]
    shared.deliver(
        reports, "Speed against accuracy", console, html=html, markdown=markdown, opened=opened
    )
    shared.write_json(stored, json)


def _chart(
    scene: Scene,
    onto: Path | None,
    trained: list[TrainedModel],
    asked: Mapping[str, Any],
    **how: Any,
) -> tuple[Tradeoff, list[Measurement]]:
    """Measure the engines of a scene, or take them from where they are stored, then the models."""
    from mbds_xsim.studies.tradeoff.rows import read_tradeoff
    from mbds_xsim.studies.tradeoff.study import tradeoff_with_rows

    command = shared.command_line()
    rows: list[Measurement] = []
    if onto is not None:
        study = read_tradeoff(onto)
        command = f"{study.command} && {command}"
    else:
        study, rows = tradeoff_with_rows(scene, command=command, **asked, **how)
        command = ""
    if not trained:
        return study, rows
    from mbds_xsim.studies.tradeoff.learned import with_models

    study, added = with_models(study, scene, trained, command=command, **how)
    return study, [*rows, *added]


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
    shared.check_torch("tradeoff --models")
    from mbds_xsim.learn.trained import trained_in
    from mbds_xsim.studies.tradeoff.learned import models_of

    found = trained_in(places)
    for scene in scenes:
        models_of(scene, found)
    return found

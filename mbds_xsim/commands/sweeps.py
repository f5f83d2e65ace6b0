"""`mbds-xsim tradeoff` and `stability`: results of methods over their steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from typer import Argument, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import Conduct, core_count
from mbds_xsim.base.text import each_once
from mbds_xsim.commands import shared

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mbds_xsim.learn.trained import TrainedModel
    from mbds_xsim.scene.scene import Scene
    from mbds_xsim.simulate.adapter import Profile
    from mbds_xsim.simulate.simulator import Simulator
    from mbds_xsim.studies.stability import Study, Survey, Value
    from mbds_xsim.studies.stability.survey import SurveyPlan
    from mbds_xsim.studies.tradeoff import Measurement, Tradeoff


_STARTS = 3
_LIMIT = 30.0  # [s]
_Onto = Annotated[
    Path | None,
    shared.file("With --models: take the engines from the JSON of an earlier run of the scene."),
]
_Starts = Annotated[int, Option(help="Starts of the medium interval.", min=1, max=1000)]
_StartLimit = Annotated[
    float, shared.seconds("Longest rollout of one start [s]; slower points are only listed.", 0.1)
]
_Fresh = Annotated[bool, Option("--fresh", help="Measure again what was measured earlier.")]


@shared.command("study", writes="json csv html opened png markdown")
def tradeoff(
    to: shared.Outputs,
    scenes: shared.SceneNames,
    engines: shared.EngineNames = None,
    models: shared.ModelPlaces = None,
    onto: _Onto = None,
    starts: _Starts = _STARTS,
    seed: shared.Seed = 0,
    limit: _StartLimit = _LIMIT,
    fresh: _Fresh = False,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
) -> None:
    """Chart speed against accuracy: every engine, method and step, and the reference.

    Examples:
        mbds-xsim tradeoff 3ladder --html ladder.html
        mbds-xsim tradeoff 5pendulum 6pendulum --engines mujoco,exudyn --csv rows.csv
        mbds-xsim tradeoff 6pendulum --models models/6pendulum --onto 6pendulum.json --png both.png
    """
    from mbds_xsim.report.files import results_json, rows_csv, write_if
    from mbds_xsim.report.progress import StudyBar
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.simulate.registry import REFERENCE
    from mbds_xsim.studies.tradeoff import Measurement
    from mbds_xsim.studies.tradeoff.present import present, to_png
    from mbds_xsim.studies.tradeoff.study import able_curves

    choice = Choice.parse(engines=engines, also=(REFERENCE,))
    loaded = [shared.scene_named(name) for name in scenes]
    options = {"choice": choice, "starts": starts, "seed": seed, "limit": limit}
    if onto is not None and (engines or (starts, seed, limit) != (_STARTS, 0, _LIMIT)):
        msg = "--onto: the stored trade-off has engines, starts, seed and limit of its own"
        raise InputError(f"{msg}; leave --engines, --starts, --seed and --limit out")
    trained = _models(models, onto, loaded)
    for scene in loaded if onto is None else []:  # check all before starting long work
        able_curves(scene, choice)
    studies, rows = [], []
    for scene in loaded:
        with StudyBar(to.console, workers or core_count(), scene.name) as meter:
            study, added = _chart(
                scene, onto, trained, options, Conduct(workers, cache, fresh, meter)
            )
        studies.append(study)
        rows += added
        to.show(present(study))
    stored = results_json(studies)
    write_if(to.csv, lambda: rows_csv(Measurement, rows))
    write_if(to.png, lambda: to_png(studies, stored))
    to.give(to.pictured(map(present, studies)), "Speed against accuracy", stored)


def _chart(
    scene: Scene,
    onto: Path | None,
    trained: list[TrainedModel],
    options: Mapping[str, Any],
    conduct: Conduct,
) -> tuple[Tradeoff, list[Measurement]]:
    """Measure a scene's engines, or load their stored results, then measure the models."""
    from mbds_xsim.studies.tradeoff import read_tradeoff
    from mbds_xsim.studies.tradeoff.study import tradeoff_with_rows

    command = shared.command_line()
    rows: list[Measurement] = []
    if onto is not None:
        study = read_tradeoff(onto)
        command = f"{study.command} && {command}"
    else:
        study, rows = tradeoff_with_rows(scene, command=command, conduct=conduct, **options)
        command = ""
    if not trained:
        return study, rows
    from mbds_xsim.studies.tradeoff.learned import with_models

    study, added = with_models(study, scene, trained, command=command, conduct=conduct)
    return study, [*rows, *added]


def _models(
    places: list[Path] | None, onto: Path | None, scenes: list[Scene]
) -> list[TrainedModel]:
    """Find the models; refuse scenes without any before engines are measured."""
    if onto is not None and (not places or len(scenes) != 1):
        msg = "--onto: models are put onto a stored trade-off; name one SCENE and --models"
        raise InputError(msg)
    if not places:
        return []
    shared.check_torch("tradeoff --models")
    from mbds_xsim.learn.trained import trained_in
    from mbds_xsim.studies.tradeoff.learned import models_of

    models = trained_in(places)
    for scene in scenes:
        models_of(scene, models)
    return models


T = TypeVar("T")

_ENDS = {"csv": ".csv", "png": ".png", "html": ".html", "markdown": ".md", "json": ".json"}


_Studies = Annotated[
    list[str] | None,
    Argument(metavar="[STUDY…]", help="Names of --list; all when left out.", callback=each_once),
]
_Listed = Annotated[bool, Option("--list", help="Name the studies, and end.")]
_Engines = Annotated[
    str | None, Option(help="Comma-separated; all installed when left out; none: only --models.")
]
_Methods = Annotated[
    str | None, Option("--methods", "--method", help="Comma-separated; all by default.")
]
_Settings = Annotated[
    str | None, Option(help="matched (all methods) or native; both when left out.")
]
_Value = Annotated[str | None, Option(help="Only this value; any number, or a name of the study.")]
_Step = Annotated[float | None, Option(help="Only this step [s]; divides a frame of 0.1 s.")]
_Quick = Annotated[bool, Option("--quick", help="Three values and three steps.")]
_CellLimit = Annotated[float, shared.seconds("Time limit of one cell [s].")]
_Out = Annotated[Path | None, Option(metavar="DIR", help="Write all files of every study there.")]


@shared.command("study", writes="json csv html opened png markdown")
def stability(
    to: shared.Outputs,
    studies: _Studies = None,
    listed: _Listed = False,
    engines: _Engines = None,
    models: shared.ModelPlaces = None,
    methods: _Methods = None,
    settings: _Settings = None,
    value: _Value = None,
    step: _Step = None,
    quick: _Quick = False,
    limit: _CellLimit = _LIMIT,
    fresh: _Fresh = False,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    out: _Out = None,
) -> None:
    """Map where methods fail: what breaks first, at which step, and whether the engine reports it.

    Examples:
        mbds-xsim stability --list
        mbds-xsim stability stiffness --png map.png
        mbds-xsim stability mass-ratio --engines mujoco --methods RK4 --value 1000 --step 0.01
        mbds-xsim stability pace links --models models/6pendulum --engines none
    """
    from mbds_xsim.simulate.choice import Choice, words_of
    from mbds_xsim.studies.stability.studies import STUDIES, study_named
    from mbds_xsim.studies.stability.survey import SurveyPlan

    if listed:
        _list_studies(
            to,
            {"STUDY": studies, "--engines": engines, "--models": models, "--methods": methods}
            | {"--settings": settings, "--value": value, "--step": step, "--quick": quick}
            | {"--limit": limit != _LIMIT, "--fresh": fresh, "--no-cache": not cache}
            | {"--workers": workers, "--out": out},
        )
        return
    to.check(out=out and out / "map.json")
    others = _outsiders(models)
    choice = Choice(()) if others and engines == "none" else Choice.parse(engines=engines)
    if not choice.engines:
        _refuse({"--step": step, "--settings": settings}, "models step by frames, with no settings")
    single = value is not None and step is not None
    plans = [
        SurveyPlan(
            study=study,
            engines=choice.engines,
            faulty=choice.faulty,
            others=others,
            methods=words_of(methods or (), "--methods"),
            profiles=_profiles(settings or "matched,native"),
            values=_values(study, value, quick=quick),
            counts=_counts(step, quick=quick),
            limit=limit,
            conduct=Conduct(workers, cache, fresh or single),
            command=shared.command_line(),
        )
        for study in map(study_named, studies or STUDIES)
    ]
    _write([_mapped(plan, to, out, single=single) for plan in _able(plans, to, studies)], to)


def _list_studies(to: shared.Outputs, others: Mapping[str, object]) -> None:
    from mbds_xsim.studies.stability.present import listing
    from mbds_xsim.studies.stability.studies import STUDIES

    outputs = {"--" + name.replace("opened", "open"): value for name, value in vars(to).items()}
    _refuse({**outputs, **others}, "--list only prints names")
    to.print([listing(STUDIES.values())])


def _refuse(options: Mapping[str, object], why: str) -> None:
    """Raise InputError for the first option that was given, though it has no effect."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise InputError(f"{name}: got it, but {why}; leave it out")


def _able(plans: list[SurveyPlan], to: shared.Outputs, named: list[str] | None) -> list[SurveyPlan]:
    """Return the plans that can run, and name the others before any runs.

    If studies are named, all must be among them.
    """
    from mbds_xsim.studies.stability.survey import simulators_of

    able: list[SurveyPlan] = []
    for plan in plans:
        try:
            simulators_of(plan)
        except InputError as error:
            if named or (plan is plans[-1] and not able):
                raise
            to.say(f"left out: {error}")
        else:
            able.append(plan)
    return able


def _mapped(plan: SurveyPlan, to: shared.Outputs, out: Path | None, *, single: bool) -> Survey:
    """Run and present one study, and write its files before the next one begins."""
    from mbds_xsim.report.progress import StudyBar
    from mbds_xsim.studies.stability.present import cells_of, present
    from mbds_xsim.studies.stability.survey import survey

    with StudyBar(to.console, plan.conduct.processes, plan.study.name) as meter:
        sweep = survey(replace(plan, conduct=replace(plan.conduct, meter=meter)))
    if single:
        to.print(cells_of(sweep))
    else:
        to.show(present(sweep))
    if out is not None:
        base = out / plan.study.name
        files: dict[str, Any] = {kind: base.with_suffix(end) for kind, end in _ENDS.items()}
        _write([sweep], shared.Outputs(**files), quiet=True)
    return sweep


def _write(sweeps: list[Survey], to: shared.Outputs, *, quiet: bool = False) -> None:
    from mbds_xsim.report.files import results_json, rows_csv, write_if
    from mbds_xsim.studies.stability import MapCell
    from mbds_xsim.studies.stability.present import present, to_png

    rows = rows_csv(MapCell, (cell for sweep in sweeps for cell in sweep.cells), "silent")
    write_if(to.csv, lambda: rows)
    write_if(to.png, lambda: to_png(sweeps, rows))
    reports = [present(sweep) for sweep in sweeps]
    to.give(reports, "Where methods fail", results_json(sweeps), quiet=quiet)


def _outsiders(places: list[Path] | None) -> tuple[Simulator, ...]:
    if not places:
        return ()
    shared.check_torch("stability --models")
    from mbds_xsim.learn.simulator import simulators_in

    return simulators_in(places)


def _profiles(words: str) -> tuple[Profile, ...]:
    """Return the named profiles, each once; refuse files of settings."""
    from mbds_xsim.simulate.choice import as_profile, is_file, words_of

    listed = words_of(words, "--settings")
    if paths := [word for word in listed if is_file(word)]:
        raise InputError(
            f"--settings {paths[0]}: a file has the settings of one scene, and a map makes scenes "
            "and steps of its own; allowed are matched, native, or both"
        )
    return tuple(map(as_profile, listed))


def _values(study: Study, value: str | None, *, quick: bool) -> tuple[Value, ...]:
    if value is not None:
        return (study.parse(value),)
    return _three(study.values) if quick else study.values


def _counts(step: float | None, *, quick: bool) -> tuple[int, ...]:
    """Return the numbers of steps per frame."""
    from mbds_xsim.simulate.adapter import Settings
    from mbds_xsim.studies.stability import COUNTS, FRAME

    if step is not None:
        return (Settings("", step).substeps(FRAME),)
    return _three(COUNTS) if quick else COUNTS


def _three(values: tuple[T, ...]) -> tuple[T, ...]:
    """Return the first, the middle and the last value."""
    return (values[0], values[len(values) // 2], values[-1])

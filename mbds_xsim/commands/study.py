"""`mbds-xsim match`, `ablate`, `contact` and `releases`: studies of scenes and engines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.isolate import LIMIT, Conduct, core_count
from mbds_xsim.base.text import each_once
from mbds_xsim.commands import shared

_Trajectories = Annotated[
    int, Option(help="Starts of each interval to search with.", min=1, max=1000)
]
_HeldOut = Annotated[int, Option(help="Starts of each interval to verify with.", min=1, max=1000)]
_Seed = Annotated[int, Option(help="Seed of the search; the next one verifies.", min=0)]
_Limit = Annotated[float, shared.seconds("Longest rollout of a start [s].", 0.1)]
_Options = Annotated[bool, Option("--options", help="Vary the engines' own options, too.")]
_Out = Annotated[Path | None, shared.file("Write here, not into scenes/matched.")]


@shared.command("study", writes="json html opened")
def match(
    to: shared.Outputs,
    scenes: shared.SceneNames,
    engines: shared.EngineNames = None,
    trajectories: _Trajectories = 2,
    held_out: _HeldOut = 20,
    seed: _Seed = 0,
    limit: _Limit = 30.0,
    options: _Options = False,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
    out: _Out = None,
) -> None:
    """Search for the cheapest settings of each engine that keep all budgets of a scene.

    Examples:
        mbds-xsim match 3ladder
        mbds-xsim match my.toml --out my-settings.toml --engines mujoco
    """
    from mbds_xsim.base.files import write_whole
    from mbds_xsim.report.files import results_json
    from mbds_xsim.report.progress import StudyBar
    from mbds_xsim.scene.sampling import Starts
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.match import matched_toml, present, settings_there
    from mbds_xsim.studies.match import search as study

    choice = Choice.parse(engines=engines)
    targets = _targets(scenes, choice.engines, out)
    for target in targets:
        to.check(out=target)
        settings_there(target)
    loaded = [shared.scene_named(name) for name in scenes]
    for scene in loaded:  # check all before starting long work
        study.searched_curves(scene, choice, options=options)
    results = []
    for scene, target in zip(loaded, targets, strict=True):
        with StudyBar(to.console, workers or core_count(), scene.name) as meter:
            result = study.match(
                scene,
                choice=choice,
                held_out=held_out,
                starts=Starts(trajectories, seed),
                limit=limit,
                options=options,
                conduct=Conduct(workers, cache, meter=meter),
                command=shared.command_line("--out"),
            )
        to.show(present(result))
        write_whole(target, matched_toml(result, settings_there(target)).encode())
        to.say(f"written: {target}")
        results.append(result)
    reports = [present(result) for result in results]
    to.give(reports, "Matched settings", results_json(results))
    met = all(engine.meets_budget for result in results for engine in result.engines)
    raise Exit(0 if met else 1)


def _targets(scenes: list[str], engines: tuple[str, ...], out: Path | None) -> list[Path]:
    """Return the file that each scene's settings go to."""
    from mbds_xsim.simulate.registry import REFERENCE, is_foreign, scene_names
    from mbds_xsim.studies.match import stored_path

    if out is not None and len(scenes) > 1:
        raise InputError(f"--out: got {len(scenes)} scenes for one file {out}; match one at a time")
    for name in scenes if out is None else []:
        if name not in scene_names():
            msg = f"{name} has no place among the built-in scenes; say where to write with --out"
            raise InputError(msg)
    foreign = [name for name in engines if name != REFERENCE and is_foreign(name)]
    if out is None and foreign:
        raise InputError(
            f"{foreign[0]} is another package's engine, whose settings do not stand among the "
            "toolkit's; say where to write with --out"
        )
    return [out] if out is not None else [stored_path(name) for name in scenes]


@shared.command("study", writes="json markdown")
def ablate(
    to: shared.Outputs,
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
) -> None:
    """Drop and halve each effect that a scene models; compare with the engines' disagreement.

    Examples:
        mbds-xsim ablate 3ladder
        mbds-xsim ablate 5pendulum balldrop --trajectories 4 --markdown ablation.md
    """
    from mbds_xsim.measure.quick import check_able
    from mbds_xsim.report.files import results_json
    from mbds_xsim.scene.sampling import Starts
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.ablate import ablate as study
    from mbds_xsim.studies.ablate import present

    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if len(choice.profiles) > 1:
        msg = f"--settings: got {settings}, allowed is one of matched, native and a file"
        raise InputError(msg)
    loaded = [shared.scene_named(name) for name in scenes]
    for scene in loaded:  # check all before starting long work
        check_able(scene, choice)
    results = []
    for scene in loaded:
        with shared.progress_on(to.console) as progress:
            result = study(
                scene,
                choice=choice,
                starts=Starts(trajectories, seed),
                conduct=Conduct(workers, cache, meter=progress),
                command=shared.command_line(),
            )
        to.show(present(result))
        results.append(result)
        to.give([present(one) for one in results], "")
    to.write_json(results_json(results))


@shared.command("study", writes="json markdown")
def contact(
    to: shared.Outputs,
    engines: shared.EngineNames = None,
    settings: Annotated[
        str, Option(help="native, matched, or both side by side (native,matched).")
    ] = "native,matched",
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
    figures: Annotated[
        Path | None, Option(metavar="DIR", help="Draw the page's figures into a folder.")
    ] = None,
) -> None:
    """Measure contact in each engine: rebound, friction, rest, energy, limits.

    Examples:
        mbds-xsim contact --engines dart
        mbds-xsim contact --markdown docs/contact.md --figures docs/images
    """
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.contact.present import present, study_contact

    choice = Choice.parse(engines=engines, profiles=settings, limit=limit)
    if choice.settings:
        msg = f"--settings: got {settings}, allowed are matched and native: what is measured has "
        raise InputError(msg + "scenes of its own, and a file of settings is matched for one scene")
    pictures = {}
    if figures is not None:
        pictures = {kind: figures / f"contact-{kind}.png" for kind in ("restitution", "friction")}
    for picture in pictures.values():
        to.check(figures=picture)
    with shared.progress_on(to.console) as progress:
        study = study_contact(choice, Conduct(workers, meter=progress), shared.command_line())
    to.answer(present(study), study, "contact")
    if pictures:
        from mbds_xsim.studies.contact.present import draw_study

        draw_study(study, pictures)
    if to.markdown is not None:
        from mbds_xsim.base.files import write_whole
        from mbds_xsim.studies.contact.page import contact_page

        write_whole(to.markdown, contact_page(study, pictures, to.markdown.parent).encode())


@shared.command("study", writes="json csv html opened png markdown")
def releases(
    to: shared.Outputs,
    engines: Annotated[
        list[str], Argument(metavar="ENGINE…", help="Names of engines.", callback=each_once)
    ],
    since: Annotated[
        str,
        Option(
            metavar="VERSION",
            help="First release to measure, for one engine; else the one known for it, or its last "
            "ten releases.",
        ),
    ] = "",
    last: Annotated[int | None, Option(help="Number of newest releases to measure.", min=1)] = None,
    fresh: Annotated[
        bool, Option("--fresh", help="Measure anew, and try again what could not be installed.")
    ] = False,
    cache: shared.CacheUse = True,
    workers: shared.WorkerCount = None,
) -> None:
    """Measure every release of an engine on the package index, and report which changed what.

    Each is installed into a folder of its own in the cache, and used again by later runs.

    Examples:
        mbds-xsim releases mujoco --since 3.7.0
        mbds-xsim releases dart exudyn --html releases.html --png releases.png
        mbds-xsim releases mujoco --last 2 --json -
    """
    from mbds_xsim.report.files import results_json, rows_csv, write_if
    from mbds_xsim.report.progress import StudyBar
    from mbds_xsim.simulate.registry import engine_names, load_adapter
    from mbds_xsim.studies.releases import ReleaseStudy
    from mbds_xsim.studies.releases.present import present, to_png
    from mbds_xsim.studies.releases.steps import ReleaseRow

    if since and len(engines) > 1:
        raise InputError(f"--since: got {since} for {len(engines)} engines; name one ENGINE")
    for engine in engines:
        check_name("engine", engine, engine_names())
        load_adapter(engine)
    histories = []
    for engine in engines:
        with StudyBar(to.console, workers or core_count(), engine) as meter:
            study = ReleaseStudy(engine, Conduct(workers, cache, fresh, meter))
            histories.append(study.history(since, last, command=shared.command_line()))
        to.show(present(histories[-1]))
    stored = results_json(histories)
    write_if(
        to.csv, lambda: rows_csv(ReleaseRow, (row for history in histories for row in history.rows))
    )
    write_if(to.png, lambda: to_png(histories, stored))
    to.give(to.pictured(map(present, histories)), "Release by release", stored)
    raise Exit(1 if any(history.verdict == "fail" for history in histories) else 0)

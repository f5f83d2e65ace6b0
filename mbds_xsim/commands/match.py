"""`mbds-xsim match`: the cheapest settings that are good enough."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Exit, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.commands import shared

_Trajectories = Annotated[
    int, Option(help="Starts of each interval to search with.", min=1, max=1000)
]
_HeldOut = Annotated[int, Option(help="Starts of each interval to verify with.", min=1, max=1000)]
_Seed = Annotated[int, Option(help="Seed of the search; the next one verifies.", min=0)]
_Limit = Annotated[float, Option(help="Longest rollout of a start [s].", min=0.1)]
_Options = Annotated[bool, Option("--options", help="Vary the engines' own options, too.")]
_Out = Annotated[
    Path | None, Option(metavar="FILE", help="Write here, not where validate finds them.")
]


@shared.command(
    "study",
    epilog="Examples:  mbds-xsim match 3ladder  ·  "
    "mbds-xsim match my.toml --out my-settings.toml --engines mujoco",
)
def match(
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
    json: shared.JsonFile = None,
    html: shared.HtmlFile = None,
    opened: shared.Opened = False,
) -> None:
    """Search the cheapest settings of each engine that keep all budgets of a scene."""
    from mbds_xsim.base.isolate import core_count
    from mbds_xsim.base.write import write_whole
    from mbds_xsim.report.bar import StudyBar
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.simulate.choice import Choice
    from mbds_xsim.studies.match import search as study
    from mbds_xsim.studies.match.present import matched_toml, present

    console = shared.console_for(json)
    choice = Choice.parse(engines=engines)
    targets = _targets(scenes, out)
    for target in targets:
        shared.check_targets(json=json, html=html, out=target)
    found = []
    for name, target in zip(scenes, targets, strict=True):
        scene = shared.scene_named(name)
        with StudyBar(console, workers or core_count(), scene.name) as meter:
            result = study.match(
                scene,
                choice=choice,
                trajectories=trajectories,
                held_out=held_out,
                seed=seed,
                limit=limit,
                options=options,
                workers=workers,
                cache=cache,
                meter=meter,
                command=shared.command_line(),
            )
        print_report(present(result), console)
        before = target.read_text("utf-8") if target.is_file() else ""
        write_whole(target, matched_toml(result, before).encode())
        console.print(f"written: {target}", highlight=False)
        found.append(result)
    reports = [present(result) for result in found]
    shared.deliver(reports, "Matched settings", console, html=html, opened=opened)
    shared.write_json(shared.encoded(found[0] if len(found) == 1 else found), json)
    met = all(engine.meets_budget for result in found for engine in result.engines)
    raise Exit(0 if met else 1)


def _targets(scenes: list[str], out: Path | None) -> list[Path]:
    """Say where each scene's settings go."""
    from mbds_xsim.simulate.registry import scene_names
    from mbds_xsim.studies.match.present import stored_path

    if out is not None and len(scenes) > 1:
        msg = f"--out: got {len(scenes)} scenes for one file {out}; match one at a time"
        raise InputError(msg)
    for name in scenes if out is None else []:
        if name not in scene_names():
            msg = f"{name} has no place among the built-in scenes; say where to write with --out"
            raise InputError(msg)
    return [out] if out is not None else [stored_path(name) for name in scenes]

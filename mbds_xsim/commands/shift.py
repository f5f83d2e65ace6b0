"""`mbds-xsim shift`: learned models under a change of the engine that made the data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mbds_xsim.commands import shared

if TYPE_CHECKING:
    from mbds_xsim.learn.shift.study import ShiftStudy
    from mbds_xsim.report.blocks import Report

_Models = Annotated[Path, typer.Argument(metavar="MODELS", help="Folder that train has written.")]
_Data = Annotated[Path, typer.Argument(metavar="DATA", help="Folder that generate has written.")]
_Scenes = Annotated[
    list[str] | None,
    typer.Option(help="Only this scene; may be repeated. All with models when left out."),
]
_Trajectories = Annotated[
    int | None,
    typer.Option(help="Test with at most so many; all of the test part when left out.", min=1),
]
_Settings = Annotated[
    str | None, typer.Option(help="Only these: native or matched; both when left out.")
]
_On = Annotated[
    str | None,
    typer.Option(help="Only models so trained: each, leave-one-out, all, by-interval."),
]
_Seeds = Annotated[int | None, typer.Option(help="Only models of so many seeds: 0, 1, …", min=1)]
_At = Annotated[
    int | None,
    typer.Option(help="Frame of answers and tables: 1, 10, 20, …; 10 when left out.", min=1),
]
_Cache = Annotated[bool, typer.Option(help="Use what was solved, predicted and simulated before.")]
_Rollouts = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Draw rollouts over the truth.")
]


@shared.command("learn", writes="json csv html opened png markdown")
def shift(
    to: shared.Outputs,
    models: _Models,
    data: _Data,
    scene: _Scenes = None,
    trajectories: _Trajectories = None,
    settings: _Settings = None,
    on: _On = None,
    seeds: _Seeds = None,
    at: _At = None,
    cache: _Cache = True,
    workers: shared.DeviceWorkers = None,
    device: shared.Device = "cpu",
    rollouts: _Rollouts = None,
) -> None:
    """Test models that were trained on one engine's data on every other engine's.

    Examples:
        mbds-xsim shift models data --html shift.html
        mbds-xsim shift models data --scene 6pendulum --json - --workers 2
    """
    shared.check_torch("shift")
    from mbds_xsim.dataset.variant import folder_name
    from mbds_xsim.learn.recipe import check_device
    from mbds_xsim.learn.shift.domains import Selection
    from mbds_xsim.learn.shift.evaluation import to_csv
    from mbds_xsim.learn.shift.result import to_json
    from mbds_xsim.learn.shift.study import question_of, samples_of, study
    from mbds_xsim.report.files import link, write_if
    from mbds_xsim.report.terminal import print_report
    from mbds_xsim.studies.shift.figures import to_png
    from mbds_xsim.studies.shift.present import present, samples_png

    to.check(rollouts=rollouts)
    check_device(device)
    part = Selection.parse(settings, on, seeds)
    names = map(folder_name, scene or _scenes(models, data))
    # All at once: what the last is lacking is said before the first has taken its time.
    questions = [question_of(models, data, n, trajectories=trajectories, part=part) for n in names]
    how: dict[str, Any] = {"at": at, "cache": cache, "workers": workers, "device": device}
    studies = []
    for question in questions:
        with shared.progress_on(to.console) as meter:
            found = study(question, meter=meter, command=shared.command_line(), **how)
        print_report(present(found.shift), to.console)
        studies.append(found)
    stored = to_json([found.shift for found in studies])
    write_if(to.csv, lambda: to_csv([found.evaluation for found in studies]))
    write_if(to.png, lambda: to_png([found.shift for found in studies], stored))
    write_if(rollouts, lambda: samples_png([samples_of(found.evaluation) for found in studies]))
    title = "Learned models under a change of engine"
    to.give(_reports(studies, link(to.png, to.markdown), shown=to.paged), title, stored)


def _reports(studies: list[ShiftStudy], picture: str, *, shown: bool) -> list[Report]:
    """Give a chapter each; a page shows motions too, and plays those of a single study."""
    from mbds_xsim.learn.shift.study import samples_of
    from mbds_xsim.studies.shift.present import present

    return [
        present(
            found.shift,
            samples_of(found.evaluation) if shown else None,
            played=len(studies) == 1,
            picture="" if k else picture,
        )
        for k, found in enumerate(studies)
    ]


def _scenes(models: Path, data: Path) -> list[str]:
    """Scenes that there are both models and data of."""
    from mbds_xsim.base.errors import InputError
    from mbds_xsim.learn.shift.domains import scenes_in

    found = [name for name in scenes_in(data) if any((models / name).glob("*/*/*-s*.pt"))]
    if not found:
        msg = (
            f"no scene has both trained models in {models} and data in {data}; see train, generate"
        )
        raise InputError(msg)
    return found

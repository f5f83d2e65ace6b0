"""`mbds-xsim train` and `shift`: learned models, and the effect of a change of engine on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Exit, Option

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.base.isolate import Carrier, Conduct
from mbds_xsim.base.text import counted, encoded
from mbds_xsim.commands import shared
from mbds_xsim.report.blocks import Block, Column, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.learn.recipe import Profile
    from mbds_xsim.learn.runs import Cost, TrainingRequest
    from mbds_xsim.learn.trainings import TrainingOutcome, TrainingPlan

_Data = Annotated[list[Path], Argument(metavar="DATA…", help="Data sets, or folders of them.")]
_Out = Annotated[Path, Option(metavar="DIR", help="Folder of the models.")]
_Models = Annotated[str | None, Option(help="Comma-separated; all of the track if left out.")]
_On = Annotated[
    str, Option(help="each, leave-one-out, all, by-interval, mujoco, mujoco-low, …; by commas.")
]
_Seeds = Annotated[int, Option(help="Number of seeds: 0, 1, …", min=1)]
_ProfileName = Annotated[
    str, Option(help="Length of training: smoke (minutes), lite (hours), paper (GPU).")
]
_Steps = Annotated[
    int | None, Option(help="Number of steps of every run, in place of the profile's.", min=1)
]
_Track = Annotated[
    str | None, Option(help="Hyper-parameters: lite, native, paper, native+; else the profile's.")
]
_Plan = Annotated[bool, Option("--plan", help="Only measure and print the cost.")]
_Mixed = Annotated[bool, Option("--bf16", help="On cuda: mixed precision with bfloat16.")]
_Compiled = Annotated[bool, Option("--compile", help="On cuda: compiled networks, as CUDA graphs.")]
_Scheduler = Annotated[
    str | None,
    Option(
        metavar="ADDRESS",
        help="Dask scheduler in place of --workers; its workers must see DATA and DIR.",
    ),
]
_Events = Annotated[Path | None, Option(metavar="DIR", help="Write what TensorBoard reads.")]
_ModelFolder = Annotated[Path, Argument(metavar="MODELS", help="Folder that train wrote.")]
_DataFolder = Annotated[Path, Argument(metavar="DATA", help="Folder that generate wrote.")]
_OnlyScenes = Annotated[
    list[str] | None,
    Option(help="Only this scene; may be repeated. All with models when left out."),
]
_Trajectories = Annotated[
    int | None,
    Option(help="Most trajectories to test with; all of the test part when left out.", min=1),
]
_OnlySettings = Annotated[
    str | None,
    Option(
        help="Only these, comma-separated: native, matched, or names of settings files; all when "
        "left out."
    ),
]
_OnlyOn = Annotated[
    str | None, Option(help="Only models trained this way: each, leave-one-out, all, by-interval.")
]
_OnlySeeds = Annotated[
    int | None, Option(help="Number of seeds whose models are used: 0, 1, …", min=1)
]
_At = Annotated[
    int | None, Option(help="Frame of answers and tables: 1, 10, 20, …; 10 when left out.", min=1)
]
_Cache = Annotated[bool, Option(help="Use what was solved, predicted and simulated before.")]
_Rollouts = Annotated[Path | None, shared.file("Draw rollouts over the truth.")]


@shared.command("learn", writes="json png")
def train(
    to: shared.Outputs,
    data: _Data,
    out: _Out = Path("models"),
    models: _Models = None,
    on: _On = "each",
    seeds: _Seeds = 3,
    profile: _ProfileName = "lite",
    steps: _Steps = None,
    track: _Track = None,
    plan: _Plan = False,
    device: shared.Device = "cpu",
    bf16: _Mixed = False,
    compiled: _Compiled = False,
    workers: shared.DeviceWorkers = None,
    scheduler: _Scheduler = None,
    tensorboard: _Events = None,
) -> None:
    """Train learned models on engines' data, the same amount of data for each.

    Examples:
        mbds-xsim train data --models gns,sgnn --on each,all --plan
        mbds-xsim train data/6pendulum --on each,leave-one-out,all --out models
        the same command continues after an interruption
    """
    shared.check_torch("train")
    from mbds_xsim.learn.groups import groups
    from mbds_xsim.learn.runs import TrainingRequest
    from mbds_xsim.learn.trainings import planned

    to.check(out=None if plan else out / "model.pt")
    _check_plan(plan=plan, png=to.png, tensorboard=tensorboard)
    _check_options(device, tensorboard, fast=bf16 or compiled, far=scheduler is not None)
    request = TrainingRequest(
        groups=groups(data),
        models=_models(models, track, profile),
        on=on,
        seeds=seeds,
        profile_name=profile,
        profile=_profile(profile, steps, bf16=bf16, compiled=compiled),
        out=out,
        track=track,
        device=device,
        events=tensorboard,
    )
    trainings = planned(request, only=plan)
    to.print([Remarks.of((f"{k} left out", v) for k, v in trainings.left_out.items())])
    with ExitStack() as stack:
        carrier = _carrier(stack, scheduler, workers, device, out)
        if plan:
            costs = _costs(trainings, *carrier, to)
            result: dict[str, Any] = {"cost": costs, "left_out": trainings.left_out}
        else:
            result = _trained(trainings, request, *carrier, to)
    to.write_json(encoded(result, "train"))
    if plan:
        return
    _draw([out / f"{name}.curve.json" for name in result["runs"]], to)
    raise Exit(1 if result["failed"] or result["diverged"] else 0)


def _check_plan(*, plan: bool, **places: Path | None) -> None:
    """Refuse places for what only a training can give."""
    for option, place in places.items():
        if plan and place is not None:
            raise InputError(f"--{option}: nothing is trained with --plan; leave one out")


def _models(names: str | None, track: str | None, profile: str) -> Sequence[str]:
    """Return the named models; without names, all that have the track, or else the profile's."""
    from mbds_xsim.learn.model import load_model, trainable
    from mbds_xsim.learn.recipe import TRACKS
    from mbds_xsim.simulate.choice import words_of

    if names is not None:
        return words_of(names, "--models")
    track = track or TRACKS.get(profile)
    able = [name for name in trainable() if track in load_model(name).tracks]
    return able or trainable()  # their refusal lists the available tracks


def _costs(
    trainings: TrainingPlan, carrier: Carrier, at_once: int, to: shared.Outputs
) -> list[Cost]:
    """Measure and print the cost of the runs."""
    from mbds_xsim.learn.trainings import costs

    measured = costs(trainings, workers=at_once, carrier=carrier) if trainings.runs else []
    if measured:
        to.print(_cost_blocks(trainings, measured, at_once))
    if blocked := [*trainings.blocked.values()]:
        text = f"{len(blocked)} of these runs could not be written there: {blocked[0]}"
        to.print([Text(text)])
    return measured


def _trained(
    trainings: TrainingPlan,
    request: TrainingRequest,
    carrier: Carrier,
    at_once: int,
    to: shared.Outputs,
) -> dict[str, Any]:
    """Carry out the runs, and return the results to report."""
    from mbds_xsim.base.files import locked
    from mbds_xsim.learn.curves import log_whole
    from mbds_xsim.learn.trainings import LONG, carry, diverged
    from mbds_xsim.report.progress import TrainingBar

    with locked(request.out):
        long = request.profile.steps > LONG
        measured = _costs(trainings, carrier, at_once, to) if long else []
        with TrainingBar(to.console) as bar:
            outcome = carry(
                trainings, workers=at_once, carrier=carrier, progress=bar, costs=measured
            )
    if request.events is not None:
        for name in trainings.done:
            log_whole(request.out / f"{name}.curve.json", request.events / name)
    to.print(_outcome(trainings, outcome))
    runs = dict(sorted({**trainings.done, **outcome.trained}.items()))
    return {
        "runs": runs,
        "failed": outcome.failed,
        "diverged": diverged(runs),
        "left_out": trainings.left_out,
        "cost": measured,
    }


def _check_options(device: str, tensorboard: Path | None, *, fast: bool, far: bool) -> None:
    """Refuse options that cannot be met; a cluster's workers have devices of their own."""
    from mbds_xsim.learn.curves import check_events
    from mbds_xsim.learn.recipe import check_device

    check_device(device, here=not far)
    if fast and device != "cuda":
        raise InputError(f"--bf16 and --compile: got --device {device}, allowed with them is cuda")
    if tensorboard is not None:
        check_events(tensorboard)


def _profile(name: str, steps: int | None, *, bf16: bool, compiled: bool) -> Profile:
    import msgspec

    from mbds_xsim.learn.recipe import PROFILES

    check_name("profile", name, PROFILES)
    profile = msgspec.structs.replace(PROFILES[name], mixed_precision=bf16, compiled=compiled)
    return profile if steps is None else profile.of_exactly(steps)


def _carrier(
    stack: ExitStack, scheduler: str | None, workers: int | None, device: str, out: Path
) -> tuple[Carrier, int]:
    """Return what carries out runs, and the number at a time; by default 1 on a local GPU."""
    from mbds_xsim.dataset.cluster import carrier_of
    from mbds_xsim.learn.recipe import process_count

    carrier, at_once = carrier_of(stack, scheduler, workers, out)
    return carrier, process_count(at_once, device)


def _draw(curves: Sequence[Path], to: shared.Outputs) -> None:
    """Draw the curves that exist; copied models may lack theirs."""
    if to.png is None:
        return
    existing = [path for path in curves if path.exists()]
    for path in sorted({*curves} - {*existing}):
        to.say(f"{path}: not there, and not drawn")
    from mbds_xsim.base.files import write_whole
    from mbds_xsim.learn.curves import read_curve, to_png

    write_whole(to.png, to_png([read_curve(path) for path in existing]))


def _cost_blocks(plan: TrainingPlan, costs: Sequence[Cost], workers: int) -> Iterator[Block]:
    """Describe the cost of each model's runs, and of all together."""
    headings = ("data", "model", "runs", "steps each", "steps/s", "a run [h]", "all [h]")
    rows, total, longest = [], 0.0, 0.0
    for cost in costs:
        runs = [r for r in plan.runs if (r.group.name, r.model) == (cost.group, cost.model)]
        hours = cost.hours * len(runs)
        total, longest = total + hours, max(longest, cost.hours)
        figures = (f"{value:.3g}" for value in (cost.steps_per_s, cost.hours, hours))
        counts = (str(len(runs)), str(runs[0].profile.steps))
        rows.append([cost.group, cost.model, *counts, *figures])
    yield table_of([Column(h, words=h in headings[:2]) for h in headings], rows)
    level = any(run.profile.until_level for run in plan.runs)
    # The runs could be packed worse than this, but no run is divided.
    yield Text(
        f"{counted(len(plan.runs), 'run')}, at most {total:.3g} h of one process, about "
        f"{max(total / workers, longest):.3g} h with {workers}; measured on a few steps"
        + ("; runs end earlier once they are level" if level else "")
    )


def _outcome(plan: TrainingPlan, outcome: TrainingOutcome) -> Iterator[Block]:
    """Describe how the runs ended, and which diverged."""
    from mbds_xsim.learn.trainings import UNTRAINED, diverged, is_untrained

    facts = [*outcome.trained.values(), *plan.done.values()]
    ways = {"level": "ended level", "steps": "took all their steps", "diverged": "diverged"}
    counts = [
        f"{sum(fact.get('ended') == way for fact in facts)} {words}" for way, words in ways.items()
    ]
    yield Text(
        f"{counted(len(facts), 'run')} done, {len(plan.done)} of them before, "
        f"{len(outcome.failed)} failed; {', '.join(counts)}"
    )
    runs = {**plan.done, **outcome.trained}
    for name in diverged(runs):
        label = f"{name} diverged" if runs[name].get("ended") == "diverged" else name
        best = "its file has the best parameters before that"
        best = UNTRAINED if is_untrained(runs[name]) else best
        advice = "check its data, or train it with another --track into another --out"
        yield Remarks.of([(label, f"{best}; {advice}")])


@shared.command("learn", writes="json csv html opened png markdown")
def shift(
    to: shared.Outputs,
    models: _ModelFolder,
    data: _DataFolder,
    scene: _OnlyScenes = None,
    trajectories: _Trajectories = None,
    settings: _OnlySettings = None,
    on: _OnlyOn = None,
    seeds: _OnlySeeds = None,
    at: _At = None,
    cache: _Cache = True,
    workers: shared.DeviceWorkers = None,
    device: shared.Device = "cpu",
    rollouts: _Rollouts = None,
) -> None:
    """Test models trained on one engine's data on the data of all other engines.

    Examples:
        mbds-xsim shift models data --html shift.html
        mbds-xsim shift models data --scene 6pendulum --json - --workers 2
    """
    shared.check_torch("shift")
    from mbds_xsim.dataset.variant import folder_name
    from mbds_xsim.learn.recipe import check_device
    from mbds_xsim.learn.shift.evaluation import to_csv
    from mbds_xsim.learn.shift.study import question_of, study
    from mbds_xsim.learn.trained import Selection
    from mbds_xsim.report.files import results_json, write_if
    from mbds_xsim.studies.shift.present import present, samples_png, to_png

    to.check(rollouts=rollouts)
    check_device(device)
    part = Selection.parse(settings, on, seeds)
    names = dict.fromkeys(map(folder_name, scene or _scenes(models, data)))
    # Check all at once: a missing input of the last is reported before the first starts.
    questions = [question_of(models, data, name, trajectories, part, at) for name in names]
    studies = []
    for question in questions:
        with shared.progress_on(to.console) as meter:
            conduct = Conduct(workers, cache, meter=meter)
            command = shared.command_line()
            result = study(question, conduct=conduct, device=device, command=command)
        to.show(present(result.shift))
        studies.append(result)
    stored = results_json([result.shift for result in studies])
    write_if(to.csv, lambda: to_csv([result.evaluation for result in studies]))
    write_if(to.png, lambda: to_png([result.shift for result in studies], stored))
    write_if(rollouts, lambda: samples_png([result.samples for result in studies]))
    title = "Learned models under a change of engine"
    played = len(studies) == 1  # a page plays the motions of one study
    samples = [result.samples if to.paged else None for result in studies]
    reports = [
        present(result.shift, shown, played=played)
        for result, shown in zip(studies, samples, strict=True)
    ]
    to.give(to.pictured(reports), title, stored)


def _scenes(models: Path, data: Path) -> list[str]:
    """Return the scenes with both models and data; refuse folders without any."""
    from mbds_xsim.learn.shift.domains import scenes_in

    scenes = [name for name in scenes_in(data) if any((models / name).glob("*/*/*-s*.pt"))]
    if not scenes:
        raise InputError(
            f"no scene has both trained models in {models} and data in {data}; see train, generate"
        )
    return scenes

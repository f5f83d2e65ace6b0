"""`mbds-xsim train`: learned models of the data's motions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mbds_xsim.commands.extras import check_torch
from mbds_xsim.commands.shared import (
    JsonFile,
    app,
    check_targets,
    console_for,
    encoded,
    write_json,
)
from mbds_xsim.errors import InputError

if TYPE_CHECKING:
    from mbds_xsim.dataset.work import Carrier
    from mbds_xsim.learn.train import Profile

__all__ = ["train"]


@app.command(
    epilog="Examples:  mbds-xsim train data --models gns,sgnn --on each,all --plan  ·  "
    "mbds-xsim train data/6pendulum --on each,leave-one-out,all --out models  ·  "
    "run it again after any interruption, and it goes on"
)
def train(
    data: Annotated[
        list[Path],
        typer.Argument(metavar="DATA…", help="Data sets, or folders of them."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the models.")] = Path(
        "models"
    ),
    models: Annotated[str, typer.Option(help="Comma-separated.")] = "gns,sgnn,hgnn,lgnn",
    on: Annotated[
        str,
        typer.Option(help="each, leave-one-out, all, or names of engines, comma-separated."),
    ] = "each",
    seeds: Annotated[int, typer.Option(help="How many: 0, 1, …", min=1)] = 3,
    profile: Annotated[
        str, typer.Option(help="How long: smoke (minutes), lite (hours), paper (GPU).")
    ] = "lite",
    steps: Annotated[
        int | None,
        typer.Option(help="Exactly so many for every run, in place of the profile's.", min=1),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(help="Hyper-parameters: lite, native or paper; the profile's when left out."),
    ] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Only measure and print the cost.")] = False,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    bf16: Annotated[
        bool, typer.Option("--bf16", help="On cuda: mixed precision with bfloat16.")
    ] = False,
    compiled: Annotated[
        bool, typer.Option("--compile", help="On cuda: compiled networks, as CUDA graphs.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes at a time; left out, all cores, on cuda 1.", min=1),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask scheduler, whose workers see DATA and DIR too, in place of --workers.",
        ),
    ] = None,
    tensorboard: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write what TensorBoard reads.")
    ] = None,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the learning curves.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Train learned models on engines' data, always to one budget; see docs/train.md."""
    check_torch("train")
    from mbds_xsim.dataset.lock import locked
    from mbds_xsim.learn.campaign import LONG, Request, carry, costs, planned
    from mbds_xsim.learn.domains import groups
    from mbds_xsim.report.training import (
        TrainingBar,
        print_costs,
        print_left_out,
        print_outcome,
    )

    console = console_for(json)
    check_targets(json=json, png=png)
    _check_options(device, tensorboard, fast=bf16 or compiled, far=scheduler is not None)
    request = Request(
        groups=groups(data),
        models=[word.strip() for word in dict.fromkeys(models.split(","))],
        on=on,
        seeds=seeds,
        profile_name=profile,
        profile=_profile(profile, steps, bf16=bf16, compiled=compiled),
        out=out,
        track=track,
        device=device,
        events=tensorboard,
    )
    campaign = planned(request)
    print_left_out(campaign, console)
    with ExitStack() as stack:
        if not plan:
            stack.enter_context(locked(out))
        carrier, at_once = _carrier(stack, scheduler, workers, device, out)
        measured = []
        if campaign.runs and (plan or request.profile.steps > LONG):
            measured = costs(campaign, workers=at_once, carrier=carrier)
            print_costs(campaign, measured, at_once, console)
        if plan:
            write_json(encoded({"cost": measured, "left_out": campaign.left_out}), json)
            return
        bar = stack.enter_context(TrainingBar(console))
        outcome = carry(campaign, workers=at_once, carrier=carrier, progress=bar, costs=measured)
    print_outcome(campaign, outcome, console)
    runs = dict(sorted({**campaign.found, **outcome.trained}.items()))
    _draw([out / f"{name}.curve.json" for name in runs], png)
    told = {"runs": runs, "failed": outcome.failed, "left_out": campaign.left_out}
    write_json(encoded({**told, "cost": measured}), json)
    raise typer.Exit(1 if outcome.failed else 0)


def _check_options(device: str, tensorboard: Path | None, *, fast: bool, far: bool) -> None:
    """Refuse what cannot be; a cluster's workers have devices of their own."""
    from mbds_xsim.learn.accelerate import check_device
    from mbds_xsim.learn.curves import check_events

    check_device(device, here=not far)
    if fast and device != "cuda":
        msg = f"--bf16 and --compile: got --device {device}, allowed with them is cuda"
        raise InputError(msg)
    if tensorboard is not None:
        check_events()


def _profile(name: str, steps: int | None, *, bf16: bool, compiled: bool) -> Profile:
    import msgspec

    from mbds_xsim.learn.campaign import profile_named

    found = msgspec.structs.replace(profile_named(name), mixed_precision=bf16, compiled=compiled)
    if steps is None:
        return found
    every = min(found.every, steps)
    return msgspec.structs.replace(found, steps=steps, every=every, until_level=False)


def _carrier(
    stack: ExitStack, scheduler: str | None, workers: int | None, device: str, out: Path
) -> tuple[Carrier, int]:
    """Give what carries runs out, and how many at a time."""
    from mbds_xsim.dataset.cluster import Cluster
    from mbds_xsim.isolate import core_count, run_tasks

    if scheduler is not None and workers is not None:
        msg = "--workers and --scheduler: got both, allowed is one; a cluster has its own workers"
        raise InputError(msg)
    if scheduler is not None:
        cluster = stack.enter_context(Cluster(scheduler, out))
        return cluster, cluster.workers
    return run_tasks, workers or (1 if device == "cuda" else core_count())


def _draw(curves: Sequence[Path], png: Path | None) -> None:
    if png is None:
        return
    from mbds_xsim.learn.curves import read_curve
    from mbds_xsim.report.training_curves import to_png
    from mbds_xsim.write import write_whole

    write_whole(png, to_png([read_curve(path) for path in curves]))

"""`mbds-xsim generate`: data sets of checked trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mbds_xsim.base.counted import counted
from mbds_xsim.base.errors import InputError
from mbds_xsim.commands.shared import (
    LIMIT,
    EngineNames,
    JsonFile,
    SceneNames,
    Seed,
    TimeLimit,
    WorkerCount,
    check_targets,
    command,
    console_for,
    encoded,
    scene_named,
    write_json,
)
from mbds_xsim.report.blocks import Block, Column, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.dataset.generate import Generated


@command(
    "data",
    epilog="Examples:  mbds-xsim generate 6pendulum --engines mujoco --trajectories 1000 --out data"
    "  ·  run it again after any interruption, and it goes on",
)
def generate(
    scenes: SceneNames,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the data, made if needed.")],
    engines: EngineNames = None,
    settings: Annotated[
        str,
        typer.Option(
            help="matched or a file of `match --out` (certified), native (uncertified), or two."
        ),
    ] = "matched",
    trajectories: Annotated[
        int, typer.Option(help="How many are drawn; rejected ones are not replaced.", min=1)
    ] = 15_000,
    seed: Seed = 0,
    noise: Annotated[bool, typer.Option(help="Random forces.")] = True,
    workers: WorkerCount = None,
    limit: TimeLimit = LIMIT,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask scheduler, whose workers see DIR too, in place of --workers.",
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Make data sets: simulate, check every trajectory, publish what passes."""
    from mbds_xsim.base.isolate import run_tasks
    from mbds_xsim.dataset.cluster import Cluster
    from mbds_xsim.dataset.generate import Request
    from mbds_xsim.dataset.generate import generate as run
    from mbds_xsim.dataset.work import Carrier
    from mbds_xsim.report.bar import GeneratingBar
    from mbds_xsim.report.terminal import print_blocks
    from mbds_xsim.simulate.choice import Choice

    console = console_for(json)
    check_targets(json=json)
    request = Request(
        scenes=tuple(scene_named(name) for name in dict.fromkeys(scenes)),
        choice=Choice.parse(engines=engines, profiles=settings, limit=limit),
        trajectories=trajectories,
        out=out,
        seed=seed,
        noise=noise,
    )
    if scheduler is not None and workers is not None:
        msg = "--workers and --scheduler: got both, allowed is one; a cluster has its own workers"
        raise InputError(msg)
    with ExitStack() as stack:
        carry_out: Carrier = run_tasks
        if scheduler is not None:
            carry_out = cluster = stack.enter_context(Cluster(scheduler, out))
            workers = cluster.workers
        progress = stack.enter_context(GeneratingBar(console))
        generated = run(request, workers=workers, progress=progress, carry_out=carry_out)
    print_blocks(_outcome(generated), console)
    write_json(encoded(generated, "generate"), json)
    whole = not generated.failed and all(count.published for count in generated.variants)
    raise typer.Exit(0 if whole else 1)


def _outcome(generated: Generated) -> Iterator[Block]:
    """Say what was published and what was rejected, and why."""
    words = ("file", "rejected by")
    headings = ("file", "drawn", "published", "rejected", "MB", "rejected by")
    yield table_of(
        [Column(heading, words=heading in words) for heading in headings],
        [
            [
                count.file,
                *map(str, (count.trajectories, count.published, count.rejected)),
                f"{count.bytes / 1e6:.4g}",
                ", ".join(f"{cause} {number}" for cause, number in count.rejected_by.items()),
            ]
            for count in generated.variants
        ],
    )
    yield Remarks.of((f"{pair} left out", reason) for pair, reason in generated.left_out.items())
    yield Remarks.of((f"{variant} failed", why) for variant, why in generated.failed.items())
    rate = generated.made / generated.wall_s
    made = counted(generated.made, "trajectory")
    yield Text(f"{made} made in {generated.wall_s:.1f} s ({rate:.3g}/s)")

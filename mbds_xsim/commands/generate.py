"""`mbds-xsim generate`: data sets of checked trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Exit, Option

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT
from mbds_xsim.base.text import counted
from mbds_xsim.commands import shared
from mbds_xsim.report.blocks import Block, Remarks, Text, table_of

if TYPE_CHECKING:
    from mbds_xsim.dataset.generate import Generated


@shared.command(
    "data",
    epilog="Examples:  mbds-xsim generate 6pendulum --engines mujoco --trajectories 1000 --out data"
    "  ·  run it again after any interruption, and it goes on",
)
def generate(
    scenes: shared.SceneNames,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the data, made if needed.")],
    engines: shared.EngineNames = None,
    settings: Annotated[
        str,
        Option(
            help="matched or a file of `match --out` (certified), native (uncertified), or two."
        ),
    ] = "matched",
    trajectories: Annotated[
        int, Option(help="How many are drawn; rejected ones are not replaced.", min=1)
    ] = 15_000,
    seed: shared.Seed = 0,
    noise: Annotated[bool, Option(help="Random forces.")] = True,
    workers: shared.WorkerCount = None,
    limit: shared.TimeLimit = LIMIT,
    scheduler: Annotated[
        str | None,
        Option(
            metavar="ADDRESS",
            help="A Dask scheduler, whose workers see DIR too, in place of --workers.",
        ),
    ] = None,
    json: shared.JsonFile = None,
) -> None:
    """Make data sets: simulate, check every trajectory, publish what passes."""
    from mbds_xsim.base.isolate import Carrier, run_tasks
    from mbds_xsim.dataset.cluster import Cluster
    from mbds_xsim.dataset.generate import Request
    from mbds_xsim.dataset.generate import generate as run
    from mbds_xsim.report.bar import GeneratingBar
    from mbds_xsim.simulate.choice import Choice

    console = shared.console_for(json)
    shared.check_targets(json=json)
    request = Request(
        scenes=tuple(shared.scene_named(name) for name in dict.fromkeys(scenes)),
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
    shared.answer(_outcome(generated), generated, json, "generate")
    whole = not generated.failed and all(count.published for count in generated.variants)
    raise Exit(0 if whole else 1)


def _outcome(generated: Generated) -> Iterator[Block]:
    """Say what was published and what was rejected, and why."""
    yield table_of(
        ["file", ">drawn", ">published", ">rejected", ">MB", "rejected by"],
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

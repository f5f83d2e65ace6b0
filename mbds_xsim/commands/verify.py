"""`mbds-xsim verify`: check data again, from its own contents alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    LIMIT,
    JsonFile,
    TimeLimit,
    WorkerCount,
    check_targets,
    command,
    console_for,
    encoded,
    progress_on,
    write_json,
)

__all__ = ["verify"]


@command(
    "data",
    epilog="Examples:  mbds-xsim verify data  ·  mbds-xsim verify data/6pendulum/mujoco-matched.h5",
)
def verify(
    path: Annotated[
        Path, typer.Argument(metavar="FILE|DIR", help="A data file, with its shards, or a folder.")
    ],
    seed: Annotated[
        int | None,
        typer.Option(help="Chooses what is simulated again; left out, at random.", min=0),
    ] = None,
    workers: WorkerCount = None,
    limit: TimeLimit = LIMIT,
    json: JsonFile = None,
) -> None:
    """Check data again: layout, checksums, pairing, every check, some trajectories made anew."""
    from mbds_xsim.dataset.verify import verify as run
    from mbds_xsim.report.verifying import print_verified

    console = console_for(json)
    check_targets(json=json)
    with progress_on(console) as progress:
        verified = run(path, seed=seed, workers=workers, limit=limit, progress=progress)
    print_verified(verified, console)
    write_json(encoded(verified, "verify"), json)
    raise typer.Exit(0 if verified.sound else 1)

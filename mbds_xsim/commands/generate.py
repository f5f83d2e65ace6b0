"""`mbds-xsim generate`: data sets of checked trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    JsonFile,
    app,
    check_targets,
    console_for,
    encoded,
    scene_named,
    write_json,
)

__all__ = ["generate"]


@app.command(
    epilog="Examples:  mbds-xsim generate 6pendulum --engines mujoco --trajectories 1000 --out data"
    "  ·  run it again after any interruption, and it goes on"
)
def generate(
    scenes: Annotated[
        list[str],
        typer.Argument(metavar="SCENE...", help="Built-in names, families with a size, or files."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the data, made if needed.")],
    engines: Annotated[
        str | None, typer.Option(help="Comma-separated; all installed when left out.")
    ] = None,
    settings: Annotated[
        str,
        typer.Option(help="matched (certified), native (uncertified), or both: matched,native."),
    ] = "matched",
    trajectories: Annotated[
        int, typer.Option(help="How many are drawn; rejected ones are not replaced.", min=1)
    ] = 15_000,
    seed: Annotated[int, typer.Option(help="Seed of starts and inputs.", min=0)] = 0,
    noise: Annotated[bool, typer.Option(help="Random forces.")] = True,
    workers: Annotated[
        int | None, typer.Option(help="Processes at a time; all cores when left out.", min=1)
    ] = None,
    json: JsonFile = None,
) -> None:
    """Make data sets: simulate, check every trajectory, publish what passes."""
    from mbds_xsim.choice import Choice
    from mbds_xsim.dataset.generate import Request
    from mbds_xsim.dataset.generate import generate as run
    from mbds_xsim.report.generating import GeneratingBar, print_counts

    console = console_for(json)
    check_targets(json=json)
    request = Request(
        scenes=tuple(scene_named(name) for name in dict.fromkeys(scenes)),
        choice=Choice.parse(engines=engines, profiles=settings),
        trajectories=trajectories,
        out=out,
        seed=seed,
        noise=noise,
    )
    with GeneratingBar(console) as progress:
        generated = run(request, workers=workers, progress=progress)
    print_counts(generated, console)
    write_json(encoded(generated), json)
    raise typer.Exit(0 if all(count.published for count in generated.variants) else 1)

"""`mbds-xsim inspect`: what a data file or folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.commands.shared import (
    JsonFile,
    check_targets,
    command,
    console_for,
    encoded,
    write_json,
)
from mbds_xsim.errors import InputError

__all__ = ["inspect"]


@command(
    "data",
    epilog="Examples:  mbds-xsim inspect data  ·  "
    "mbds-xsim inspect data/6pendulum/mujoco-matched.h5 --png paths.png",
)
def inspect(
    path: Annotated[Path, typer.Argument(metavar="FILE|DIR", help="A data file or a folder.")],
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw paths of particles into this file.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Sum up data sets: scene, engine, counts, figures of the checks, versions, size."""
    from mbds_xsim.dataset.read import load_dataset
    from mbds_xsim.dataset.summary import summaries
    from mbds_xsim.report.inspecting import print_summary
    from mbds_xsim.report.paths import draw_paths

    console = console_for(json)
    check_targets(json=json, png=png)
    found = summaries(path)
    if png is not None and len(found) > 1:
        msg = f"--png: {path} holds {len(found)} data sets; name one of them, as {found[0].file}"
        raise InputError(msg)
    for summary in found:
        print_summary(summary, console)
    if png is not None:
        draw_paths(load_dataset(found[0].file), png)
        console.print(f"written: {png}", highlight=False)
    write_json(encoded(found, "inspect"), json)

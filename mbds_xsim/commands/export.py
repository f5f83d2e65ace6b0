"""`mbds-xsim export`: data sets as npz or CSV files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from mbds_xsim.commands import shared


@shared.command(
    "data",
    epilog="Examples:  mbds-xsim export data --out npz --format npz  ·  "
    "mbds-xsim export data/6pendulum/mujoco-matched.h5 --out csv --format csv --indices 0-9",
)
def export(
    dataset: Annotated[Path, Argument(metavar="DATASET", help="A data file or folder.")],
    out: Annotated[Path, Option(metavar="DIR", help="Folder to write, made if needed.")],
    form: Annotated[Literal["npz", "csv"], Option("--format", help="Of the files.")],
    engines: Annotated[
        str | None, Option(help="Comma-separated; all that there are when left out.")
    ] = None,
    indices: Annotated[
        str | None, Option(help="Numbers of trajectories, as 0-9,15; all when left out.")
    ] = None,
    json: shared.JsonFile = None,
) -> None:
    """Write data sets in a form that any program reads, and say what it does not carry."""
    from mbds_xsim.base.text import counted
    from mbds_xsim.dataset.export import export as run
    from mbds_xsim.dataset.read import parse_numbers

    console = shared.console_for(json)
    shared.check_targets(json=json)
    numbers = None if indices is None else parse_numbers(indices, "--indices")
    with shared.progress_on(console) as progress:
        done = run(dataset, out, form, engines=engines, numbers=numbers, progress=progress)
    console.print(
        f"{counted(done.trajectories, 'trajectory')} in "
        f"{counted(done.files, 'file')}, {done.bytes / 1e6:.4g} MB, "
        f"written to {done.out}",
        highlight=False,
        soft_wrap=True,
    )
    for file, missing in done.absent.items():
        if missing:
            some = ", ".join(map(str, missing[:10])) + (" …" if len(missing) > 10 else "")
            console.print(f"{file} has not {some}: rejected", highlight=False, soft_wrap=True)
    console.print("not carried over:")
    for line in done.lost:
        console.print(f"  {line}", highlight=False, soft_wrap=True)
    shared.write_json(shared.encoded(done, "export"), json)

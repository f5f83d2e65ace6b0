"""`mbds-xsim --version`, and all else that holds for the command line as a whole."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from mbds_xsim.commands.shared import app


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"mbds-xsim {version('mbds-xsim')}")
        raise typer.Exit


_Version = Annotated[
    bool,
    typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version."),
]


@app.callback()
def _of_all_commands(_version: _Version = False) -> None: ...

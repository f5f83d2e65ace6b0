"""What commands that work with trained models share."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from mbds_xsim.base.errors import InputError

ModelPlaces = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="PATH",
        help="Trained models beside the engines: a file, a folder of train, or a pattern such as "
        "'models/*/*/*/all-s0.pt'; may be repeated.",
    ),
]


def check_torch(command: str) -> None:
    """Refuse a command that works with learned models where they cannot run.

    Raises:
        InputError: torch is not installed.
    """
    if importlib.util.find_spec("torch") is None:
        msg = f"{command} needs torch, which is not installed: pip install 'mbds-xsim[learn]'"
        raise InputError(msg)

"""What a command needs that is not always installed."""

from __future__ import annotations

import importlib.util

from mbds_xsim.errors import InputError

__all__ = ["check_torch"]


def check_torch(command: str) -> None:
    """Refuse a command that works with learned models where they cannot run.

    Raises:
        InputError: torch is not installed.
    """
    if importlib.util.find_spec("torch") is None:
        msg = f"{command} needs torch, which is not installed: pip install 'mbds-xsim[learn]'"
        raise InputError(msg)

"""Arrays with names for their axes, where xarray is installed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mbds_xsim.errors import InputError

__all__ = ["labelled"]


def labelled(arrays: Mapping[str, tuple[tuple[str, ...], Any]], **coordinates: Any) -> Any:
    """Give an `xarray.Dataset` of arrays, each with its axes, and of coordinates of their axes.

    Raises:
        InputError: xarray is not installed.
    """
    try:
        from xarray import Dataset
    except ImportError as error:
        msg = "to_xarray() needs xarray, which is not installed: pip install 'mbds-xsim[frames]'"
        raise InputError(msg) from error
    used = {axis for axes, _ in arrays.values() for axis in axes}
    return Dataset(
        dict(arrays), coords={axis: coordinates[axis] for axis in coordinates if axis in used}
    )

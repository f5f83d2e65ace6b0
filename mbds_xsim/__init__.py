"""Multibody simulation data you can trust: one neutral scene, four engines, cross-checked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mbds_xsim.dataset.read import load_dataset

__all__ = ["load_dataset"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: importing the package stays light."""
    if name == "load_dataset":
        from mbds_xsim.dataset.read import load_dataset

        return load_dataset
    msg = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(msg)

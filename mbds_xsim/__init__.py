"""Multibody simulation data you can trust: one neutral scene, several engines, cross-checked."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mbds_xsim.api import audit, generate, load_scene, tradeoff, validate, verify
    from mbds_xsim.base.errors import InputError
    from mbds_xsim.dataset.paired import load_pairs
    from mbds_xsim.dataset.read import load_dataset
    from mbds_xsim.scene.file import save_scene
    from mbds_xsim.scene.scene import Scene

__all__ = [
    "InputError",
    "Scene",
    "audit",
    "generate",
    "load_dataset",
    "load_pairs",
    "load_scene",
    "save_scene",
    "tradeoff",
    "validate",
    "verify",
]

_HOMES = {
    "InputError": "mbds_xsim.base.errors",
    "Scene": "mbds_xsim.scene.scene",
    "load_dataset": "mbds_xsim.dataset.read",
    "load_pairs": "mbds_xsim.dataset.paired",
    "save_scene": "mbds_xsim.scene.file",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that importing the package stays light."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "mbds_xsim.api")), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

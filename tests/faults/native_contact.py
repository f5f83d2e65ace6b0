"""Faults of contact inside an adapter."""

from __future__ import annotations

import importlib
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

__all__ = ["friction_box", "speed_limit"]

_FASTEST = 100.0
"""Bullet's own limit of joint rates [rad/s]."""
_DART_LIMIT = f"""
for joint in joints.values():
    if joint.getNumDofs() == 1:
        joint.setVelocityUpperLimit(0, {_FASTEST})
        joint.setLimitEnforcement(True)
"""


def friction_box(engine: str) -> AbstractContextManager[object]:
    """Bound friction along x and along y, as Bullet and DART do by default."""
    return {"pybullet": _pybullet_box, "dart": _dart_box}[engine]()


def speed_limit(engine: str) -> AbstractContextManager[object]:
    """Leave the limit of joint rates in PyBullet, set the same in DART."""
    return {"pybullet": _slow_pybullet, "dart": _slow_dart}[engine]()


def _pybullet_box() -> AbstractContextManager[object]:
    contact = _adapter("_pybullet_contact").Contact
    set_solver = contact._set_solver

    def set_box(self: Any, law: Any, step: float) -> None:
        set_solver(self, law, step)
        self._client.build("setPhysicsEngineParameter", enableConeFriction=0)

    return mock.patch.object(contact, "_set_solver", set_box)


def _dart_box() -> AbstractContextManager[object]:
    adapter = _adapter("dart")
    statements = adapter.contact_statements
    return mock.patch.object(
        adapter, "contact_statements", lambda *given: statements(*given[:-1], "dantzig")
    )


def _slow_pybullet() -> AbstractContextManager[object]:
    return mock.patch.object(_adapter("_pybullet_model"), "SPEED_CAP", _FASTEST)


def _slow_dart() -> AbstractContextManager[object]:
    adapter = _adapter("dart")
    listing = adapter.build_listing
    return mock.patch.object(adapter, "build_listing", lambda *given: listing(*given) + _DART_LIMIT)


def _adapter(module: str) -> Any:
    return importlib.import_module(f"mbds_xsim_adapters.{module}")

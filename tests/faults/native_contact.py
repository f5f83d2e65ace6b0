"""Faults of contact inside an adapter."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

__all__ = ["friction_box", "rolling_resistance", "slippery_wheel", "speed_limit"]

_FASTEST = 100.0
"""Bullet's own limit of joint rates [rad/s]."""
_DART_LIMIT = f"""
for joint in joints.values():
    if joint.getNumDofs() == 1:
        joint.setVelocityUpperLimit(0, {_FASTEST})
        joint.setLimitEnforcement(True)
"""


_WHEEL, _SLIPPERY = 1, 0.40
"""A body with one sphere, the first of all, and its friction."""
_ROLLING = 0.1
"""Of rolling resistance: a lever of the normal force [m]."""


def friction_box(engine: str) -> AbstractContextManager[object]:
    """Bound friction along x and along y, as Bullet and DART do by default."""
    return {"pybullet": _pybullet_box, "dart": _dart_box}[engine]()


def speed_limit(engine: str) -> AbstractContextManager[object]:
    """Leave the limit of joint rates in PyBullet, set the same in DART."""
    return {"pybullet": _slow_pybullet, "dart": _slow_dart}[engine]()


def slippery_wheel(engine: str) -> AbstractContextManager[object]:
    """Give the first wheel less friction than the others have."""
    slippery = {"mujoco": _mujoco_wheel, "pybullet": _pybullet_wheel}
    return slippery[engine]()


def rolling_resistance(_engine: str) -> AbstractContextManager[object]:
    """Let PyBullet's spheres resist rolling; MuJoCo's rows of rolling are too soft to be felt."""
    return _pybullet_pairs(lambda _: {"rollingFriction": _ROLLING})


def _mujoco_wheel() -> AbstractContextManager[object]:
    adapter = _adapter("mujoco.run")
    text = adapter.text

    def changed(root: Any) -> Any:
        next(root.iter("pair")).set("friction", f"{_SLIPPERY} {_SLIPPERY} 0 0 0")
        return text(root)

    return mock.patch.object(adapter, "text", changed)


def _pybullet_wheel() -> AbstractContextManager[object]:
    return _pybullet_pairs(lambda body: {"lateralFriction": _SLIPPERY} if body == _WHEEL else {})


def _pybullet_pairs(
    change: Callable[[int], dict[str, float]],
) -> AbstractContextManager[object]:
    """Give bodies with spheres other coefficients."""
    contact = _adapter("pybullet.contact").BulletContact
    set_pair = contact.set_pair

    def set_changed(self: Any, number: int, link: int, body: int) -> None:
        set_pair(self, number, link, body)
        if body in self._body:
            self._client.build("changeDynamics", number, link, **change(body))

    return mock.patch.object(contact, "set_pair", set_changed)


def _pybullet_box() -> AbstractContextManager[object]:
    contact = _adapter("pybullet.contact").BulletContact
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
    return mock.patch.object(_adapter("pybullet.model"), "SPEED_CAP", _FASTEST)


def _slow_dart() -> AbstractContextManager[object]:
    adapter = _adapter("dart.run")
    listing = adapter.build_listing
    return mock.patch.object(adapter, "build_listing", lambda *given: listing(*given) + _DART_LIMIT)


def _adapter(module: str) -> Any:
    return importlib.import_module(f"mbds_xsim_adapters.{module}")

"""Faults of the inputs that reach an engine, and of how it resists motion by itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Settings

from .planting import Fault

__all__ = ["DRIVING"]

Change = Callable[[Batch], Batch]


def _force(change: Callable[[Array], Array]) -> Change:
    return lambda batch: dataclasses.replace(batch, force=change(batch.force))


def _torque(change: Callable[[Array], Array]) -> Change:
    return lambda batch: dataclasses.replace(batch, torque=change(batch.torque))


def _in_body_frames(batch: Batch) -> Batch:
    """Take forces in W for forces in the frames that bodies start with."""
    turned = rotation.rotate(batch.orientation[:, None], batch.force)
    return dataclasses.replace(batch, force=turned)


def _early(values: Array) -> Array:
    return np.concatenate([values[:, 1:], values[:, -1:]], axis=1)


def _started(**by: float) -> Change:
    """Start a little otherwise than drawn."""
    return lambda batch: dataclasses.replace(
        batch, **{key: getattr(batch, key) + value for key, value in by.items()}
    )


def _options(**options: float | str) -> Callable[[Settings], Settings]:
    return lambda settings: dataclasses.replace(settings, options={**settings.options, **options})


def _fault(
    name: str,
    scene: str,
    engine: str,
    checks: tuple[str, ...],
    inputs: Change,
    **more: Any,
) -> Fault:
    return Fault(name, scene, (engine,), checks, inputs=inputs, **more)


_LIMIT = ("consistency of positions", "consistency of energy")
_Y, _Z = np.array([1.0, -1.0, 1.0]), np.array([1.0, 1.0, 0.0])

DRIVING = (
    _fault("forces 1 % weak", "3pendulum", "mujoco", _LIMIT, _force(lambda f: 0.99 * f)),
    _fault("forces a frame early", "3pendulum", "exudyn", _LIMIT, _force(_early)),
    _fault(
        "forces in reversed order of time",
        "3pendulum",
        "pybullet",
        _LIMIT,
        _force(lambda f: f[:, ::-1]),
    ),
    _fault("forces mirrored in y", "2ladder", "dart", _LIMIT, _force(lambda f: _Y * f)),
    _fault(
        "forces on bodies in reversed order",
        "2ladder",
        "mujoco",
        _LIMIT,
        _force(lambda f: f[:, :, ::-1]),
    ),
    _fault("forces in body frames", "workbench", "mujoco", _LIMIT, _in_body_frames),
    _fault("torques 1 % weak", "workbench", "dart", _LIMIT, _torque(lambda t: 0.99 * t)),
    _fault(
        "torques on hinges in reversed order",
        "workbench",
        "exudyn",
        _LIMIT,
        _torque(lambda t: t[:, :, ::-1]),
        odd=True,
    ),
    _fault(
        "torques a frame late",
        "simplecubli in flight",
        "dart",
        ("balance",),
        _torque(lambda t: np.roll(t, 1, axis=1)),
    ),
    _fault(
        "noise without its vertical part",
        "balldrop",
        "pybullet",
        ("balance",),
        _force(lambda f: _Z * f),
    ),
    _fault("noise doubled", "ballscroll", "exudyn", ("balance",), _force(lambda f: 2.0 * f)),
    _fault(
        "torques of left and right wheels exchanged",
        "particlecar",
        "exudyn",
        ("cones",),
        _torque(lambda t: t[:, :, [1, 0, 3, 2]]),
    ),
    _fault(
        "start with a rate 1e-6 off",
        "3pendulum",
        "mujoco",
        ("start",),
        _started(angular_velocity=1e-6),
        told="start",
    ),
    Fault(
        "linear damping of 0.04 left on, in the air",
        "balldrop",
        ("pybullet",),
        ("momentum",),
        settings=_options(linear_damping=0.04),
    ),
    Fault(
        "angular damping of 0.04 left on, of a cube",
        "simplecubli",
        ("pybullet",),
        ("momentum",),
        settings=_options(angular_damping=0.04),
    ),
)

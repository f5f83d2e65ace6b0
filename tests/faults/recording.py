"""Faults of what is recorded: the engine is right, and its motion is written down wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

from .planting import Fault

__all__ = ["RECORDING"]

Record = Callable[[Scene, Batch, float, Trajectory], Trajectory]

_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
_FRAME = 6
"""The frame that is recorded wrong where only one is."""


def _each(field: str, change: Callable[[Array, Trajectory], Array]) -> Record:
    """Record one field otherwise; the start stays as it was drawn."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        kept = getattr(motion, field)
        changed = np.concatenate([kept[:, :1], change(kept, motion)[:, 1:]], axis=1)
        fields: dict[str, Any] = {field: changed}
        return dataclasses.replace(motion, **fields)

    return record


def _frames(pick: Callable[[NDArray[np.intp]], NDArray[np.intp]]) -> Record:
    """Record other frames than those that are due."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        due = pick(np.arange(len(motion.time)))
        return dataclasses.replace(motion, **{key: getattr(motion, key)[:, due] for key in _FIELDS})

    return record


def _bodies(one: int, other: int, fields: tuple[str, ...] = _FIELDS) -> Record:
    """Record two bodies in each other's place, from the second frame on."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        changed: dict[str, Any] = {key: getattr(motion, key).copy() for key in fields}
        for key, values in changed.items():
            values[:, 1:, [one, other]] = getattr(motion, key)[:, 1:, [other, one]]
        return dataclasses.replace(motion, **changed)

    return record


def _in_body_frames(spin: Array, motion: Trajectory) -> Array:
    return rotation.rotate(rotation.conjugate(motion.orientation), spin)


def _beside_centres(position: Array, motion: Trajectory) -> Array:
    """Places of points 1 mm from the centres of mass along the bodies' z-axes."""
    return position + rotation.rotate(motion.orientation, np.array([0.0, 0.0, 1e-3]))


def _differences(position: Array, motion: Trajectory) -> Array:
    """Velocities as differences of places, as a converter makes them that has none."""
    velocity = motion.velocity.copy()
    velocity[:, 1:] = np.diff(position, axis=1) / (motion.time[1] - motion.time[0])
    return velocity


def _smoothed(position: Array, _: Trajectory) -> Array:
    smooth = position.copy()
    smooth[:, 1:-1] = (position[:, :-2] + position[:, 1:-1] + position[:, 2:]) / 3.0
    return smooth


def _interpolated(values: Array, _: Trajectory) -> Array:
    """One frame is lost and filled from its neighbours."""
    filled = values.copy()
    filled[:, _FRAME] = (values[:, _FRAME - 1] + values[:, _FRAME + 1]) / 2.0
    return filled


def _repeated(due: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.where(due > _FRAME, due - 1, due)


def _dropped(due: NDArray[np.intp]) -> NDArray[np.intp]:
    """One frame is missing, and the last comes twice to make up for it."""
    return np.minimum(np.where(due >= _FRAME, due + 1, due), due[-1])


def _fault(
    name: str, scene: str, engine: str, checks: tuple[str, ...], motion: Record, odd: bool = False
) -> Fault:
    return Fault(name, scene, (engine,), checks, motion=motion, odd=odd)


RECORDING = (
    _fault(
        "angular velocity in body frames",
        "workbench",
        "dart",
        ("kinematics", "energy"),
        _each("angular_velocity", _in_body_frames),
    ),
    _fault(
        "orientation turned the other way",
        "workbench",
        "mujoco",
        ("gap", "kinematics"),
        _each("orientation", lambda values, _: rotation.conjugate(values)),
    ),
    _fault(
        "places 1 mm beside the centres of mass",
        "2ladder",
        "exudyn",
        ("gap",),
        _each("position", _beside_centres),
    ),
    _fault(
        "velocities from differences of places",
        "3pendulum",
        "mujoco",
        ("kinematics",),
        _each("velocity", lambda _, motion: _differences(motion.position, motion)),
    ),
    _fault(
        "velocities 0.1 % too fast",
        "3pendulum",
        "dart",
        ("kinematics",),
        _each("velocity", lambda values, _: 1.001 * values),
    ),
    _fault(
        "places smoothed over three frames",
        "3pendulum",
        "exudyn",
        ("kinematics", "gap"),
        _each("position", _smoothed),
    ),
    _fault(
        "places of one frame interpolated",
        "2ladder",
        "mujoco",
        ("kinematics", "gap"),
        _each("position", _interpolated),
    ),
    _fault(
        "one frame twice, the later ones late",
        "workbench",
        "exudyn",
        ("kinematics", "error growth-weighted"),
        _frames(_repeated),
    ),
    _fault(
        "one frame twice, the later ones late, under wheels",
        "particlecar",
        "dart",
        ("balance", "wheels"),
        _frames(_repeated),
    ),
    _fault(
        "one frame left out, the last twice",
        "ballscroll",
        "pybullet",
        ("kinematics", "error growth-weighted"),
        _frames(_dropped),
    ),
    _fault(
        "one frame left out, the last twice, of a cube",
        "simplecubli",
        "exudyn",
        ("balance", "momentum"),
        _frames(_dropped),
    ),
    _fault(
        "two links in each other's place",
        "3pendulum",
        "pybullet",
        ("gap",),
        _bodies(1, 2),
        odd=True,
    ),
    _fault(
        "rates of two flywheels exchanged",
        "simplecubli in flight",
        "mujoco",
        ("kinematics", "momentum"),
        _bodies(1, 2, ("angular_velocity",)),
    ),
    _fault(
        "rates of two wheels exchanged",
        "particlecar",
        "mujoco",
        ("kinematics", "wheels"),
        _bodies(1, 4, ("angular_velocity",)),
    ),
    _fault(
        "orientation that is no unit quaternion",
        "ballscroll",
        "mujoco",
        ("finite",),
        _each("orientation", lambda values, _: (1.0 + 1e-6) * values),
    ),
    _fault(
        "angular velocity in degrees, of one body",
        "balldrop",
        "exudyn",
        ("kinematics",),
        _each("angular_velocity", lambda values, _: np.degrees(values)),
    ),
)

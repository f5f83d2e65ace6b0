"""Faults of recordings: motions that are right, written down wrongly."""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Index
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

from .bench import ENGINES
from .planting import Fault

__all__ = ["RECORDED"]

_STATE = ("position", "orientation", "velocity", "angular_velocity")
_POSE = _STATE[:2]
_TWIST = 0.1  # [rad/s]
_FROZEN = 10  # frames


def _taken(motion: Trajectory, frames: Index, *names: str) -> Trajectory:
    return dataclasses.replace(motion, **{name: getattr(motion, name)[:, frames] for name in names})


def _drifting(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    moved = 0.5 * motion.time[:, None, None] * np.array([1.0, 0.0, 0.0])
    return dataclasses.replace(motion, position=motion.position + moved)


def _shaken(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    position = motion.position.copy()
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (*position.shape[:2], 1, 2))
    position[:, 1:, :, :2] += noise[:, 1:]
    return dataclasses.replace(motion, position=position)


def _late_places(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    return _taken(motion, np.maximum(np.arange(len(motion.time)) - 1, 0), *_POSE)


def _left_for_right(scene: Scene, _: Batch, __: float, motion: Trajectory) -> Trajectory:
    names = [body.name for body in scene.bodies]
    sides = {"left": "right", "right": "left"}
    ends = [name.rpartition("_") for name in names]
    others = [f"{before}{bar}{sides.get(side, side)}" for before, bar, side in ends]
    facing = motion.orientation[:, :, [names.index(name) for name in others]]
    return dataclasses.replace(motion, orientation=facing)


def _last_twice(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    last = len(motion.time) - 2
    return _taken(motion, np.minimum(np.arange(len(motion.time)), last), *_STATE)


def _frozen_end(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    last = len(motion.time) - 1 - _FROZEN
    return _taken(motion, np.minimum(np.arange(len(motion.time)), last), *_STATE)


def _one_twice(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    frames = np.arange(len(motion.time))
    return _taken(motion, np.where(frames > len(frames) // 2, frames - 1, frames), *_STATE)


def _twisting(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    turn = rotation.from_vector(np.array([0.0, 0.0, _TWIST]) * motion.time[:, None])
    facing = motion.orientation.copy()
    facing[:, :, -1] = rotation.multiply(facing[:, :, -1], turn)
    return dataclasses.replace(motion, orientation=facing)


def _told_to_twist(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    spin = motion.angular_velocity.copy()
    spin[:, 1:, -1] += rotation.rotate(motion.orientation[:, 1:, -1], np.array([0.0, 0.0, _TWIST]))
    return dataclasses.replace(motion, angular_velocity=spin)


def _in_single_precision(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    kept = {name: getattr(motion, name).copy() for name in _STATE}
    for values in kept.values():
        values[:, 1:] = values[:, 1:].astype(np.float32)
    kept["orientation"] /= rotation.norm(kept["orientation"])[..., None]
    return dataclasses.replace(motion, **kept)


def _parting(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    velocity = motion.velocity.copy()
    velocity[:, 1:, -1, 1] += 0.1
    return dataclasses.replace(motion, velocity=velocity)


def _recorded(name: str, scene: str, *checks: str, **how: object) -> Fault:
    given: dict[str, object] = {"engines": ENGINES, **how}
    return Fault(name=name, scene=scene, checks=checks, **given)  # type: ignore[arg-type]


RECORDED = (
    _recorded("places drift at 0.5 m/s", "particlecar", "displacement", motion=_drifting),
    _recorded("places shaken by 1 mm", "particlecar", "displacement", motion=_shaken),
    _recorded("places a frame late", "particlecar", "displacement", motion=_late_places),
    _recorded(
        "orientations of left and right wheels exchanged",
        "particlecar",
        "displacement",
        motion=_left_for_right,
    ),
    _recorded("last frame twice", "particlecar", "displacement", motion=_last_twice),
    _recorded("last ten frames frozen", "simplecubli", "displacement", motion=_frozen_end),
    _recorded("a frame twice, those after it late", "3pendulum", "displacement", motion=_one_twice),
    _recorded("a rod twists beside its rate", "3pendulum", "displacement", motion=_twisting),
    _recorded(
        "rate of a twist that a rod has not", "3pendulum", "displacement", motion=_told_to_twist
    ),
    _recorded(
        "a rung twists beside its rate",
        "2ladder",
        "kinematics",
        engines=("mujoco", "dart"),
        motion=_twisting,
    ),
    _recorded(
        "rate of a twist that a rung has not",
        "2ladder",
        "kinematics",
        engines=("pybullet", "exudyn"),
        motion=_told_to_twist,
    ),
    _recorded(
        "a ball twists beside its rate",
        "ballscroll",
        "displacement",
        engines=("mujoco", "pybullet"),
        motion=_twisting,
        unseen={
            "mujoco": "0.1 rad/s is 0.64 of what 0.8 s of rolling at 10 m/s leave open; after "
            "2 s the turn itself is 0.2 rad off the reference, of 0.1 allowed"
        },
    ),
    _recorded(
        "rate of a twist that a ball has not",
        "ballscroll",
        "rolling",
        engines=("mujoco", "dart"),
        motion=_told_to_twist,
    ),
    _recorded(
        "all numbers after the start rounded to single precision",
        "3pendulum",
        "precision",
        engines=("mujoco",),
        motion=_in_single_precision,
    ),
    _recorded("velocity of a body aside", "workbench", "gap rate", motion=_parting),
)

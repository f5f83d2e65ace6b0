"""Changes of the recording: the engine is right, and its motion is recorded wrongly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import accelerations
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

from .planting import Change

Frames = NDArray[np.intp]

_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
_FRAME = 6
"""Frame that faults of a single frame record wrongly."""
_TWIST = 0.1  # [rad/s]
_FASTEST = 100.0  # [rad/s]


def each(field: str, change: Callable[[Array, Trajectory], Array]) -> Change:
    """Change the recording of one field; the start stays as it was drawn."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        values = getattr(motion, field)
        changed = np.concatenate([values[:, :1], change(values, motion)[:, 1:]], axis=1)
        fields: dict[str, Any] = {field: changed}
        return dataclasses.replace(motion, **fields)

    return Change(motion=record)


def frames(pick: Callable[[Frames], Frames], fields: tuple[str, ...] = _FIELDS) -> Change:
    """Record other frames in place of those that are due."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        due = pick(np.arange(len(motion.time)))
        return dataclasses.replace(motion, **{key: getattr(motion, key)[:, due] for key in fields})

    return Change(motion=record)


def exchanged(*pairs: tuple[int, int], fields: tuple[str, ...] = _FIELDS) -> Change:
    """Record bodies in each other's place, from the second frame on."""

    def record(_scene: Scene, _batch: Batch, _step: float, motion: Trajectory) -> Trajectory:
        changed: dict[str, Any] = {key: getattr(motion, key).copy() for key in fields}
        for key, values in changed.items():
            for one, other in pairs:
                values[:, 1:, [one, other]] = getattr(motion, key)[:, 1:, [other, one]]
        return dataclasses.replace(motion, **changed)

    return Change(motion=record)


def repeated(due: Frames) -> Frames:
    """Record a frame twice, and the later ones late."""
    return np.where(due > _FRAME, due - 1, due)


def dropped(due: Frames) -> Frames:
    """Leave a frame out, and record the last twice to make up for it."""
    return np.minimum(np.where(due >= _FRAME, due + 1, due), due[-1])


def spin_in_body_frames(spin: Array, motion: Trajectory) -> Array:
    """Record angular velocities in the bodies' own frames."""
    return rotation.rotate(rotation.conjugate(motion.orientation), spin)


def beside_centres(position: Array, motion: Trajectory) -> Array:
    """Record positions of points 1 mm from the centres of mass along the bodies' z-axes."""
    return position + rotation.rotate(motion.orientation, np.array([0.0, 0.0, 1e-3]))


def differences(velocity: Array, motion: Trajectory) -> Array:
    """Record differences of positions as velocities, as converters without velocities do."""
    rates = velocity.copy()
    rates[:, 1:] = np.diff(motion.position, axis=1) / (motion.time[1] - motion.time[0])
    return rates


def smoothed(position: Array, _: Trajectory) -> Array:
    """Average each frame with its neighbours."""
    smooth = position.copy()
    smooth[:, 1:-1] = (position[:, :-2] + position[:, 1:-1] + position[:, 2:]) / 3.0
    return smooth


def interpolated(values: Array, _: Trajectory) -> Array:
    """Fill one frame, which is lost, from its neighbours."""
    filled = values.copy()
    filled[:, _FRAME] = (values[:, _FRAME - 1] + values[:, _FRAME + 1]) / 2.0
    return filled


def drifting(position: Array, motion: Trajectory) -> Array:
    """Let positions drift at 0.5 m/s."""
    return position + 0.5 * motion.time[:, None, None] * np.array([1.0, 0.0, 0.0])


def shaken(position: Array, _: Trajectory) -> Array:
    """Shake positions by 1 mm."""
    moved = position.copy()
    moved[..., :2] += np.random.default_rng(1).normal(0.0, 1e-3, (*position.shape[:2], 1, 2))
    return moved


def lowered(position: Array, _: Trajectory) -> Array:
    """Let the motion go on 1 mm lower."""
    return position - np.array([0.0, 0.0, 1e-3])


def aside(velocity: Array, _: Trajectory) -> Array:
    """Let the last body move aside at 0.1 m/s."""
    parting = velocity.copy()
    parting[:, :, -1, 1] += 0.1
    return parting


def twisting(facing: Array, motion: Trajectory) -> Array:
    """Twist the last body about itself, in addition to its rate."""
    turn = rotation.from_vector(np.array([0.0, 0.0, _TWIST]) * motion.time[:, None])
    twisted = facing.copy()
    twisted[:, :, -1] = rotation.multiply(facing[:, :, -1], turn)
    return twisted


def held_in_the_world(facing: Array, _: Trajectory) -> Array:
    """Keep the last body's initial orientation, however its carrier turns."""
    fixed = facing.copy()
    fixed[:, :, -1] = facing[:, :1, -1]
    return fixed


def told_to_twist(spin: Array, motion: Trajectory) -> Array:
    """Give the last body the rate of a twist that it does not perform."""
    rate = spin.copy()
    rate[:, :, -1] += rotation.rotate(motion.orientation[:, :, -1], np.array([0.0, 0.0, _TWIST]))
    return rate


def in_single_precision(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Round all numbers after the start to single precision."""
    rounded = {name: getattr(motion, name).copy() for name in _FIELDS}
    for values in rounded.values():
        values[:, 1:] = values[:, 1:].astype(np.float32)
    rounded["orientation"] /= rotation.norm(rounded["orientation"])[..., None]
    return dataclasses.replace(motion, **rounded)


def swapped_recording(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Record xyzw where wxyz is published."""
    return dataclasses.replace(motion, orientation=np.roll(motion.orientation, -1, axis=-1))


def cut_spins(scene: Scene, _: Batch, __: float, motion: Trajectory) -> Trajectory:
    """Cut the rates of hinges."""
    mechanism = Mechanism.of(scene)
    native = mechanism.native_rotation(motion.orientation)
    spin = motion.angular_velocity.copy()
    for hinge in mechanism.hinges:
        axis = rotation.rotate(native[:, :, hinge.parent], hinge.axis)
        rate = np.sum((spin[:, :, hinge.child] - spin[:, :, hinge.parent]) * axis, axis=-1)
        excess = rate - np.clip(rate, -_FASTEST, _FASTEST)
        spin[:, :, hinge.child] -= excess[..., None] * axis
    return dataclasses.replace(motion, angular_velocity=spin)


def late(
    *, steps: float = 0.0, frames: float = 0.0, places: bool = True, speeds: bool = True
) -> Change:
    """Record frames some steps or frames late; the first is the start."""

    def record(scene: Scene, batch: Batch, step: float, motion: Trajectory) -> Trajectory:
        delay = steps * step + frames * scene.clock.frame
        linear, angular = _pulls(scene, batch, motion)
        turned = delay * motion.angular_velocity + 0.5 * delay**2 * angular
        moved: dict[str, Any] = {}
        if places:
            moved["position"] = motion.position + delay * motion.velocity + 0.5 * delay**2 * linear
            moved["orientation"] = rotation.multiply(
                rotation.from_vector(turned), motion.orientation
            )
        if speeds:
            moved["velocity"] = motion.velocity + delay * linear
            moved["angular_velocity"] = motion.angular_velocity + delay * angular
        for key, values in moved.items():
            values[:, 0] = getattr(motion, key)[:, 0]
        return dataclasses.replace(motion, **moved)

    return Change(motion=record)


def _pulls(scene: Scene, batch: Batch, motion: Trajectory) -> tuple[Array, Array]:
    """Accelerations just after each frame, under the inputs that then begin."""
    mechanism = Mechanism.of(scene)
    states = BodyStates(
        motion.position,
        mechanism.native_rotation(motion.orientation),
        motion.velocity,
        motion.angular_velocity,
    )
    due = np.minimum(np.arange(len(motion.time)), batch.steps - 1)
    return accelerations(mechanism, states, batch.force[:, due], batch.torque[:, due])

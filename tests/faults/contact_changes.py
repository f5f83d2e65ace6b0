"""Changes of the ground, of contact spheres and of inputs that faults of contact share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np

from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Settings

__all__ = [
    "FRICTION",
    "bouncier",
    "ground",
    "no_contact",
    "no_noise",
    "options",
    "radius",
    "raised",
    "without_inputs",
]

FRICTION = 0.43


def ground(**coefficients: float) -> Callable[[Scene], Scene]:
    """Give the ground other coefficients."""

    def change(scene: Scene) -> Scene:
        assert scene.ground is not None
        changed = msgspec.structs.replace(scene.ground, **coefficients)
        return msgspec.structs.replace(scene, ground=changed)

    return change


def bouncier(by: float) -> Callable[[Scene], Scene]:
    """Add to the restitution of the ground."""

    def changed(scene: Scene) -> Scene:
        assert scene.ground is not None
        return ground(restitution=scene.ground.restitution + by)(scene)

    return changed


def radius(share: float) -> Callable[[Scene], Scene]:
    """Scale the radius of every contact sphere."""

    def changed(scene: Scene) -> Scene:
        spheres = tuple(
            msgspec.structs.replace(sphere, radius=share * sphere.radius)
            for sphere in scene.contacts
        )
        return msgspec.structs.replace(scene, contacts=spheres)

    return changed


def raised(by: float) -> Callable[[Scene], Scene]:
    """Let every sphere touch as if the ground were higher, by its radius."""

    def changed(scene: Scene) -> Scene:
        spheres = tuple(
            msgspec.structs.replace(each, radius=each.radius + by) for each in scene.contacts
        )
        return msgspec.structs.replace(scene, contacts=spheres)

    return changed


def no_contact(scene: Scene) -> Scene:
    """Leave the ground out."""
    return msgspec.structs.replace(scene, contacts=(), ground=None)


def options(**given: float | str) -> Callable[[Settings], Settings]:
    """Set options of an adapter."""
    return lambda settings: dataclasses.replace(settings, options={**settings.options, **given})


def no_noise(batch: Batch) -> Batch:
    """Leave all forces out."""
    return dataclasses.replace(batch, force=np.zeros_like(batch.force))


def without_inputs(frame: int) -> Callable[[Batch], Batch]:
    """Leave the inputs of a frame out."""

    def changed(batch: Batch) -> Batch:
        force, torque = batch.force.copy(), batch.torque.copy()
        left_out = slice(frame, frame + 1)  # nothing of a start alone
        force[:, left_out], torque[:, left_out] = 0.0, 0.0
        return dataclasses.replace(batch, force=force, torque=torque)

    return changed

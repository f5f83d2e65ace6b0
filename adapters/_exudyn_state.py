"""Between body states and Exudyn's coordinates of rigid bodies, for many states at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Mechanism

__all__ = ["BodyCoordinates"]

Array = NDArray[np.float64]


class BodyCoordinates:
    """Six a body: displacement from the reference position, and the rotation vector.

    Their velocities are the body's velocity in W and its angular velocity in its own frame.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism

    def from_bodies(self, bodies: BodyStates) -> tuple[Array, Array]:
        """Coordinates and velocities, each of shape (…, 6 · body)."""
        shift = bodies.position - self._mechanism.com
        spin = rotation.rotate(rotation.conjugate(bodies.native), bodies.angular_velocity)
        return (
            _joined(shift, rotation.to_vector(bodies.native)),
            _joined(bodies.velocity, spin),
        )

    def to_bodies(self, coordinates: Array, velocities: Array) -> BodyStates:
        """Body states of coordinates and velocities, each of shape (…, 6 · body)."""
        shift, vector = _parted(coordinates)
        velocity, spin = _parted(velocities)
        native = rotation.from_vector(vector)
        return BodyStates(
            self._mechanism.com + shift, native, velocity, rotation.rotate(native, spin)
        )


def _joined(first: Array, second: Array) -> Array:
    both = np.concatenate([first, second], axis=-1)
    return both.reshape(*both.shape[:-2], -1)


def _parted(values: Array) -> tuple[Array, Array]:
    parts = values.reshape(*values.shape[:-1], -1, 6)
    return parts[..., :3], parts[..., 3:]

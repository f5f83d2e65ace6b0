"""Spin that nothing in a scene can change.

A body of revolution that is held and pushed only on its axis feels no torque about it: its spin
about the axis is constant, and stays zero if it starts at zero. Its moment of inertia about the
axis then never acts, so an engine may leave that coordinate out and keep only the direction of the
axis. The orientation follows: it is carried along with the axis, without turning about it.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mass import of_revolution
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import INTERVALS
from mbds_xsim.scene.scene import Scene

_EVEN = 1e-12  # relative tolerance of moments of inertia and lengths
STILL = 1e-12
"""Largest spin that counts as zero; rounding leaves 1e-16 [rad/s]."""


@functools.lru_cache(maxsize=64)
def idle_axes(scene: Scene) -> Array:
    """Find the bodies that never spin about their axis.

    Returns:
        Unit axes in native frames, zero if a body has none, shape (body, 3). Bodies to which
        the scene's starts give a spin (one of each interval is drawn) have none.
    """
    mechanism = Mechanism.of(scene)
    axes = np.array([_axis_of_revolution(mechanism, k) for k in range(mechanism.body_count)])
    if axes.any():
        batch = draw_batch(scene, range(len(INTERVALS)), noise=False, inputs=False)
        native = mechanism.native_rotation(batch.orientation)
        spin = spin_about(axes, native, batch.angular_velocity)
        axes[np.abs(spin).max(axis=0) > STILL] = 0.0
    axes.flags.writeable = False
    return axes


def spin_about(axes: Array, native: Array, angular_velocity: Array) -> Array:
    """Return the spin of bodies about axes in native frames [rad/s], shape (…, body)."""
    return rotation.dot(rotation.rotate(native, axes), angular_velocity)


def carried(axes: Array, start: Array, bodies: BodyStates, interval: float) -> BodyStates:
    """Replace the orientation of bodies without spin by the one that their axis carries along.

    Between frames an axis follows the cubic through its directions and their rates, along which
    the rotation is integrated by Magnus' series to fourth order (Blanes, Casas, Oteo, Ros: The
    Magnus expansion and some of its applications, Physics Reports 470, 2009, eq. 253).

    Args:
        axes: Axes as `idle_axes` returns them.
        start: Native rotations at frame 0, shape (…, body, 4).
        bodies: Motion of all bodies, frame by frame, shape (…, frame, body, …); those with an axis
            may be turned about it in any way.
        interval: Interval between frames [s].
    """
    idle = np.flatnonzero(axes.any(axis=-1))
    native, spin = bodies.native.copy(), bodies.angular_velocity.copy()
    turn = native[..., idle, :]
    axis = rotation.rotate(turn, axes[idle])
    across = spin[..., idle, :]
    across -= rotation.dot(across, axis)[..., None] * axis
    spin[..., idle, :] = across
    carry = _carry(axis, rotation.cross(across, axis), interval)
    ahead = rotation.conjugate(turn[..., 1:, :, :])
    missing = np.concatenate(
        [
            rotation.multiply(rotation.conjugate(turn[..., :1, :, :]), start[..., None, idle, :]),
            rotation.multiply(ahead, rotation.multiply(carry, turn[..., :-1, :, :])),
        ],
        axis=-3,
    )
    half = 0.5 * np.cumsum(rotation.angle_about(missing, axes[idle]), axis=-2)[..., None]
    back = np.concatenate([np.cos(half), np.sin(half) * axes[idle]], axis=-1)
    native[..., idle, :] = rotation.multiply(turn, back)
    return BodyStates(bodies.position, native, bodies.velocity, spin)


def _carry(axis: Array, rate: Array, interval: float) -> Array:
    """Return the rotations that carry axes (…, frame, body, 3) from each frame to the next."""
    begin, end = axis[..., :-1, :, :], axis[..., 1:, :, :]
    leave, arrive = interval * rate[..., :-1, :, :], interval * rate[..., 1:, :, :]

    def turning(s: float) -> Array:
        """Return interval · angular velocity of the cubic at a fraction of the interval."""
        at = (
            (1 + 2 * s) * (1 - s) ** 2 * begin
            + s**2 * (3 - 2 * s) * end
            + s * (1 - s) ** 2 * leave
            - s**2 * (1 - s) * arrive
        )
        slope = (
            6 * s * (1 - s) * (end - begin)
            + (1 - s) * (1 - 3 * s) * leave
            + s * (3 * s - 2) * arrive
        )
        return rotation.cross(at, slope) / rotation.dot(at, at)[..., None]

    first, second = (turning(0.5 + sign * math.sqrt(3) / 6) for sign in (-1.0, 1.0))
    return rotation.from_vector(
        0.5 * (first + second) - math.sqrt(3) / 12 * rotation.cross(first, second)
    )


def _axis_of_revolution(mechanism: Mechanism, body: int) -> Array:
    """Return the axis through all attachments of a body; zero if a torque about it can act."""
    none = np.zeros(3)
    link = next(link for link in mechanism.links if link.body == body)
    if link.joint is None or body in mechanism.sphere_body:
        return none
    joints = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    if any(joint.kind != "ball" for joint in joints):
        return none
    points = [joint.in_child if joint.child == body else joint.in_parent for joint in joints]
    for pair in (*mechanism.distances, *mechanism.springs):
        points += [
            point for end, point in zip(pair.bodies, pair.in_body, strict=True) if end == body
        ]
    length = np.linalg.norm(link.joint.in_child)
    if not length > _EVEN * mechanism.scene.length:
        return none
    axis = np.asarray(link.joint.in_child / length)
    if any(np.linalg.norm(np.cross(axis, point)) > _EVEN * length for point in points):
        return none
    _, across, off = of_revolution(mechanism.inertia[body], axis)
    return axis if off <= _EVEN * across else none

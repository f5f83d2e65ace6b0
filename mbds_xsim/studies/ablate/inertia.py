"""Scenes whose bodies have less inertia, with the same masses and centres of mass.

No body can do without any: its spin would be undefined. Dropped means that a thousandth is left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Scene

LEAST = 1e-3  # of an inertia that is dropped
_ON_LINE = 1e-9  # of the longest arm
_replace = msgspec.structs.replace


def rotary_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the whole inertia of bodies; None where it is their particles' own alone."""
    if all(len(body.particles) == 1 for body in scene.bodies):
        return None
    mechanism, kept = Mechanism.of(scene), max(factor, LEAST)
    return _with_inertia(mechanism, {k: kept * t for k, t in enumerate(mechanism.inertia)})


def rod_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the inertia about the line on which a body's ball joints and centre of mass lie."""
    return _about_axes(scene, _rod_axis, factor)


def wheel_inertia(scene: Scene, factor: float) -> Scene | None:
    """Weaken the inertia of bodies about the hinge by which the spanning tree holds them."""
    return _about_axes(scene, _hinge_axis, factor)


def _about_axes(
    scene: Scene, axis_of: Callable[[Mechanism, int], Array | None], factor: float
) -> Scene | None:
    mechanism = Mechanism.of(scene)
    axes = {body: axis_of(mechanism, body) for body in range(mechanism.body_count)}
    tensors = {
        body: _less_about(mechanism.inertia[body], axis, max(factor, LEAST))
        for body, axis in axes.items()
        if axis is not None
    }
    return _with_inertia(mechanism, tensors) if tensors else None


def _less_about(tensor: Array, axis: Array, kept: float) -> Array:
    """Scale the moment about a unit axis; the moments about normals of it stay."""
    return np.asarray(tensor - (1.0 - kept) * (axis @ tensor @ axis) * np.outer(axis, axis))


def _rod_axis(mechanism: Mechanism, body: int) -> Array | None:
    """Direction of a rod; None for a body that another joint holds, or that is no rod."""
    own = [joint for joint in mechanism.joints if body in (joint.parent, joint.child)]
    arms = np.array([j.in_child if j.child == body else j.in_parent for j in own]).reshape(-1, 3)
    lengths = np.linalg.norm(arms, axis=1)
    if any(joint.kind != "ball" for joint in own) or not lengths.max(initial=0.0) > 0:
        return None
    axis = np.asarray(arms[lengths.argmax()] / lengths.max())
    off = np.linalg.norm(np.cross(arms, axis), axis=1).max()
    return axis if off <= _ON_LINE * lengths.max() else None


def _hinge_axis(mechanism: Mechanism, body: int) -> Array | None:
    joint = next(link.joint for link in mechanism.links if link.body == body)
    return joint.axis if joint is not None and joint.kind == "hinge" else None


def _with_inertia(mechanism: Mechanism, tensors: Mapping[int, Array]) -> Scene:
    """Give bodies the inertia about their centres of mass in N, in place of their particles."""
    bodies = list(mechanism.scene.bodies)
    for k, tensor in tensors.items():
        bodies[k] = _given(bodies[k], mechanism.mass[k], mechanism.com[k], tensor)
    # The skeleton is drawn between particles, and some are gone.
    return _replace(mechanism.scene, bodies=tuple(bodies), edges=(), anchors=())


def _given(body: Body, mass: float, com: Array, tensor: Array) -> Body:
    turn = rotation.matrix(np.array(body.orientation))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (turn.T @ tensor @ turn).tolist()
    x, y, z = (turn.T @ (com - np.array(body.position))).tolist()
    inertia = Inertia(float(mass), (xx, yy, zz), (xy, xz, yz), (x, y, z))
    return _replace(body, particles=(), inertia=inertia)

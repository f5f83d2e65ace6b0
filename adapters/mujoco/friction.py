"""Friction that MuJoCo's noslip solver would lose without a word.

It solves for both tangential impulses of a contact at once, from the matrix of what the bodies
yield to them. Below a determinant of 1e-10 it takes the friction as 0: on heavy bodies, which are
refused, and where joints let a point move along one line alone. There a scene is refused if it
starts in contact; otherwise a trajectory ends at the first touch.
"""

from __future__ import annotations

import math

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.collisions import Collisions
from mbds_xsim.scene.joint_inertia import mass_matrix, poses
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Ground

# Least μ² times a contact's yield [1/kg]; its square is the least determinant of `mju_QCQP2`.
_FRICTIONLESS = 1e-5
# Poses of which one must let friction act.
_POSES = 8
# Smaller shares, and gaps [m], are rounding.
_NIL = 1e-9
_ONE_LINE = (
    "joints leave only one line to slip along: MuJoCo's friction solver needs two, and treats "
    "friction along one as none; free a joint, or take another engine"
)


def lost_friction(mechanism: Mechanism) -> dict[tuple[int, ...], str]:
    """Find contacts whose friction would be lost in all of several poses.

    Returns:
        Reason why a trajectory ends at a touch, by the sphere on the ground or the two spheres.

    Raises:
        Unsupported: Friction would be lost on heavy bodies, or in contact at the start.
    """
    scene, lost = mechanism.scene, dict[tuple[int, ...], str]()
    yields, jointed = _free_yields(mechanism), _jointed(mechanism)
    moved = _Moved(mechanism, jointed) if mechanism.joints else None
    on_joints = np.isin(mechanism.sphere_body, list(jointed))
    for k, sphere in enumerate(scene.contacts) if scene.ground else ():
        _check_mass("ground", scene.ground, float(yields[k]))
        if (
            moved is not None
            and on_joints[k]
            and _loses("ground", scene.ground, moved.by_ground(k))
        ):
            spheres = f"the sphere of {sphere.body!r}"
            _refuse_touching("ground", scene.ground, moved.height(k), spheres)
            lost[(k,)] = f"{spheres} meets the ground, and {_ONE_LINE}"
    for one, other in mechanism.sphere_pairs.tolist():
        _check_mass("collisions", scene.collisions, yields[one] + yields[other])
        if moved is not None and on_joints[[one, other]].all():  # others slip in all directions
            names = " and ".join(repr(scene.contacts[k].body) for k in (one, other))
            if _loses("collisions", scene.collisions, moved.by_pair(one, other)):
                gap = moved.distance(one, other)
                _refuse_touching("collisions", scene.collisions, gap, f"those of {names}")
                lost[one, other] = f"spheres of {names} meet, and {_ONE_LINE}"
    return lost


def _jointed(mechanism: Mechanism) -> set[int]:
    """Return the bodies with joints."""
    return {body for joint in mechanism.joints for body in (joint.parent, joint.child)}


def _free_yields(mechanism: Mechanism) -> Array:
    """Return the spheres' speeds per impulse along the ground, without joints [1/kg], (sphere,)."""
    body, radius = mechanism.sphere_body, mechanism.sphere_radius
    return np.asarray(
        1.0 / mechanism.mass[body] + radius**2 / np.linalg.eigvalsh(mechanism.inertia[body])[:, 0]
    )


def _check_mass(where: str, law: Ground | Collisions | None, yields: float) -> None:
    assert law is not None
    least = math.sqrt(_FRICTIONLESS / yields)
    if 0.0 < law.friction < least:
        raise Unsupported(
            f"mujoco: {where}.friction: got {law.friction:g}, allowed is 0, or at least "
            f"{least:.3g} for bodies this heavy: its friction solver treats less as none"
        )


class _Moved:
    """Speeds of spheres per impulse in some poses, with joints and what they carry."""

    def __init__(self, mechanism: Mechanism, jointed: set[int]) -> None:
        self._mechanism, self._bodies = mechanism, _poses(mechanism)
        mass, self._moving = mass_matrix(mechanism, self._bodies, jointed)
        self._inverse = np.linalg.inv(mass)

    def by_ground(self, k: int) -> Array:
        """Return the matrices of what a sphere yields along the ground [1/kg], (pose, 2, 2)."""
        up = np.broadcast_to([0.0, 0.0, 1.0], (_POSES, 3))
        return self._along(up, self._speeds(k, -up))

    def by_pair(self, one: int, other: int) -> Array:
        """Return the same for two spheres, along the plane between them."""
        apart = self._place(one) - self._place(other)
        normal = apart / np.maximum(rotation.norm(apart)[..., None], np.finfo(float).tiny)
        return self._along(normal, self._speeds(one, -normal) - self._speeds(other, normal))

    def height(self, k: int) -> float:
        """Return a sphere's gap to the ground at the start [m]."""
        return float(self._place(k)[0, 2] - self._mechanism.sphere_radius[k])

    def distance(self, one: int, other: int) -> float:
        """Return the gap between two spheres at the start [m]."""
        apart = np.linalg.norm(self._place(one)[0] - self._place(other)[0])
        return float(apart - self._mechanism.sphere_radius[[one, other]].sum())

    def _place(self, k: int) -> Array:
        body, offset = int(self._mechanism.sphere_body[k]), self._mechanism.sphere_offset[k]
        arm = rotation.rotate(self._bodies.native[:, body], offset)
        return np.asarray(self._bodies.position[:, body] + arm)

    def _speeds(self, k: int, way: Array) -> Array:
        """Return velocities of a sphere's point at unit rates, shape (pose, freedom, 3).

        Args:
            k: The sphere.
            way: Unit vectors from its centre to the point, shape (pose, 3).
        """
        body, radius = int(self._mechanism.sphere_body[k]), float(self._mechanism.sphere_radius[k])
        arm = self._place(k) + radius * way - self._bodies.position[:, body]
        spin = self._moving.angular_velocity[:, :, body]
        turned = rotation.cross(spin, np.broadcast_to(arm[:, None], spin.shape))
        return np.asarray(self._moving.velocity[:, :, body] + turned)

    def _along(self, normal: Array, speeds: Array) -> Array:
        press = np.abs(speeds @ normal[..., None]).max(initial=0.0)
        if press <= _NIL * np.abs(speeds).max(initial=0.0):  # comes no nearer in any pose
            return np.zeros((len(normal), 2, 2))
        along = np.array([np.stack(rotation.normal_to(each), axis=-1) for each in normal])
        rates = speeds @ along
        return np.asarray(np.swapaxes(rates, -1, -2) @ self._inverse @ rates)


def _poses(mechanism: Mechanism) -> BodyStates:
    """Return the start, then random poses of all joints that turn."""
    links, chance = to_links(mechanism, poses(mechanism)[:_POSES]), np.random.default_rng(0)
    for k, link in enumerate(mechanism.links):
        if link.joint is not None and link.joint.kind == "ball":
            turns = chance.normal(size=(_POSES - 1, 4))
            links.rotation[1:, k] = turns / rotation.norm(turns)[:, None]
    return to_bodies(mechanism, links)


def _loses(where: str, law: Ground | Collisions | None, yields: Array) -> bool:
    """Return whether friction is lost in every pose, though something can slip in one."""
    assert law is not None
    small, large = np.linalg.eigvalsh(yields).T
    share = float((small / np.maximum(large, np.finfo(float).tiny)).max())
    if share > _NIL:
        _check_mass(where, law, float(np.sqrt(np.maximum(small * large, 0.0)).max()))
        return False
    return law.friction > 0.0 and float(large.max()) * law.friction**2 > _FRICTIONLESS * _NIL


def _refuse_touching(where: str, law: Ground | Collisions | None, gap: float, spheres: str) -> None:
    assert law is not None
    if gap <= _NIL:
        raise Unsupported(
            f"mujoco: {where}.friction: got {law.friction:g}, allowed is 0 for {spheres}, in "
            f"contact at the start, as {_ONE_LINE}"
        )

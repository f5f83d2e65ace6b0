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
    yields = _free_yields(mechanism).tolist()
    jointed = {body for joint in mechanism.joints for body in (joint.parent, joint.child)}
    moved = _Moved(mechanism, jointed) if mechanism.joints else None
    on_joints = np.isin(mechanism.sphere_body, list(jointed))
    on_ground = [[k] for k in range(len(scene.contacts))] if scene.ground else []
    for spheres in (*on_ground, *mechanism.sphere_pairs.tolist()):
        one = len(spheres) == 1
        where = "ground" if one else "collisions"
        law: Ground | Collisions = getattr(scene, where)
        _check_mass(where, law, sum(yields[k] for k in spheres))
        if moved is None or not on_joints[spheres].all():  # others slip in all directions
            continue
        if _loses(where, law, moved.yields(spheres)):
            names = " and ".join(repr(scene.contacts[k].body) for k in spheres)
            if moved.gap(spheres) <= _NIL:
                raise Unsupported(
                    f"mujoco: {where}.friction: got {law.friction:g}, allowed is 0 for "
                    f"{'the sphere' if one else 'those'} of {names}, in contact at the start, as "
                    f"{_ONE_LINE}"
                )
            what = f"the sphere of {names} meets the ground" if one else f"spheres of {names} meet"
            lost[tuple(spheres)] = f"{what}, and {_ONE_LINE}"
    return lost


def _free_yields(mechanism: Mechanism) -> Array:
    """Return the spheres' speeds per impulse along the ground, without joints [1/kg], (sphere,)."""
    body, radius = mechanism.sphere_body, mechanism.sphere_radius
    return np.asarray(
        1.0 / mechanism.mass[body] + radius**2 / np.linalg.eigvalsh(mechanism.inertia[body])[:, 0]
    )


def _check_mass(where: str, law: Ground | Collisions, yields: float) -> None:
    least = math.sqrt(_FRICTIONLESS / yields)
    if 0.0 < law.friction < least:
        raise Unsupported(
            f"mujoco: {where}.friction: got {law.friction:g}, allowed is 0, or at least "
            f"{least:.3g} for bodies this heavy: its friction solver treats less as none"
        )


class _Moved:
    """Speeds per impulse of a sphere on the ground, or of two, in some poses, with joints."""

    def __init__(self, mechanism: Mechanism, jointed: set[int]) -> None:
        self._mechanism, self._bodies = mechanism, _poses(mechanism)
        mass, self._moving = mass_matrix(mechanism, self._bodies, jointed)
        self._inverse = np.linalg.inv(mass)

    def yields(self, spheres: list[int]) -> Array:
        """Return matrices of what they yield along the plane between them [1/kg], (pose, 2, 2)."""
        first, *others = spheres
        normal = np.broadcast_to([0.0, 0.0, 1.0], (_POSES, 3))
        for other in others:
            apart = self._place(first) - self._place(other)
            normal = apart / np.maximum(rotation.norm(apart)[..., None], np.finfo(float).tiny)
        speeds = self._speeds(first, -normal)
        for other in others:
            speeds = speeds - self._speeds(other, normal)
        press = np.abs(speeds @ normal[..., None]).max(initial=0.0)
        if press <= _NIL * np.abs(speeds).max(initial=0.0):  # comes no nearer in any pose
            return np.zeros((len(normal), 2, 2))
        along = np.array([np.stack(rotation.normal_to(each), axis=-1) for each in normal])
        rates = speeds @ along
        return np.asarray(np.swapaxes(rates, -1, -2) @ self._inverse @ rates)

    def gap(self, spheres: list[int]) -> float:
        """Return their gap, or that to the ground, at the start [m]."""
        place, radius = [self._place(k)[0] for k in spheres], self._mechanism.sphere_radius[spheres]
        distance = place[0][2] if len(place) == 1 else np.linalg.norm(place[0] - place[1])
        return float(distance - radius.sum())

    def _place(self, k: int) -> Array:
        mechanism = self._mechanism
        return self._bodies.points(int(mechanism.sphere_body[k]), mechanism.sphere_offset[k])

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


def _poses(mechanism: Mechanism) -> BodyStates:
    """Return the start, then random poses of all joints that turn."""
    links, chance = to_links(mechanism, poses(mechanism)[:_POSES]), np.random.default_rng(0)
    for k, link in enumerate(mechanism.links):
        if link.joint is not None and link.joint.kind == "ball":
            turns = chance.normal(size=(_POSES - 1, 4))
            links.rotation[1:, k] = turns / rotation.norm(turns)[:, None]
    return to_bodies(mechanism, links)


def _loses(where: str, law: Ground | Collisions, yields: Array) -> bool:
    """Return whether friction is lost in every pose, though something can slip in one."""
    small, large = np.linalg.eigvalsh(yields).T
    share = float((small / np.maximum(large, np.finfo(float).tiny)).max())
    if share > _NIL:
        _check_mass(where, law, float(np.sqrt(np.maximum(small * large, 0.0)).max()))
        return False
    return law.friction > 0.0 and float(large.max()) * law.friction**2 > _FRICTIONLESS * _NIL

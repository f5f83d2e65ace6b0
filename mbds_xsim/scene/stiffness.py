"""Rates at which the springs and dampers of a scene can move it while its joints hold."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.assembly import assemble, inverse_mass_root
from mbds_xsim.scene.constraints import constraint_rows, dense_jacobian
from mbds_xsim.scene.joint_space import BodyStates, rate_row
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PointPair
from mbds_xsim.scene.scene import Scene

# Share of the largest singular value below which constraint rows are redundant.
_RANK = 1e-9


def spring_step(scene: Scene, *, angle: float, decay: float) -> float:
    """Return the longest step [s] of at most `angle` [rad] of spring phase and `decay` of damping.

    It is for explicit methods, which are unstable if a decay is faster than their steps. It is
    infinite without springs.
    """
    oscillating, decaying = spring_rates(scene)
    return min(
        limit / rate if rate > 0 else np.inf
        for limit, rate in ((angle, oscillating), (decay, decaying))
    )


@functools.lru_cache(maxsize=64)
def spring_rates(scene: Scene) -> tuple[float, float]:
    """Bound the rates at which spring–dampers and drives oscillate and decay at the start [1/s].

    They are √λ(K Y) and λ(C Y), where λ is the largest eigenvalue and Y the inverse effective mass
    between the springs' ends: their relative acceleration per unit force while joints hold. Each
    spring may pull in the direction in which its ends yield most, since it turns as the mechanism
    moves. Only the joints of the spanning tree hold, since at a dead point of a loop nothing would
    move. Both are 0 without springs.
    """
    mechanism = Mechanism.of(scene)
    joints = (*mechanism.compliant, *(drive.joint for drive in mechanism.drives))
    if not (mechanism.springs or joints):
        return 0.0, 0.0
    start = assemble(mechanism)
    pairs = [_apart(mechanism, start, spring) for spring in mechanism.springs]
    turns = [rate_row(mechanism, joint, start).toarray() for joint in joints]
    free = _free(mechanism, start, np.concatenate([*pairs, *turns]))
    laws: list[Any] = [spring for spring in mechanism.springs for _ in range(3)]  # one for each row
    laws += [*mechanism.compliant, *(drive.servo for drive in mechanism.drives)]
    stiffness, damping = np.array([(law.stiffness, law.damping) for law in laws]).T
    return float(np.sqrt(_largest(stiffness, free))), _largest(damping, free)


def _free(mechanism: Mechanism, start: BodyStates, relative_rows: Array) -> Array:
    """Weight rows by inverse masses, and remove the directions held by joints of the tree."""
    root = inverse_mass_root(mechanism, start.native).toarray()
    rows = constraint_rows(mechanism, start)
    loops = [joint.index for joint in mechanism.loops]
    tree = (rows.owner < len(mechanism.joints)) & ~np.isin(rows.owner, loops)
    return _without(dense_jacobian(rows, mechanism.body_count)[tree] @ root, relative_rows @ root)


def _apart(mechanism: Mechanism, start: BodyStates, spring: PointPair) -> Array:
    """Return rows for the velocity of the second end relative to the first, (3, 6 · body)."""
    rows = np.zeros((3, mechanism.body_count, 6))
    for body, point, sign in zip(spring.bodies, spring.in_body, (-1.0, 1.0), strict=True):
        if body != WORLD_INDEX:
            arm = rotation.rotate(start.native[body], point)
            rows[:, body, :3] += sign * np.eye(3)
            rows[:, body, 3:] += sign * np.cross(arm, np.eye(3))
    return rows.reshape(3, -1)


def _without(constraints: Array, rows: Array) -> Array:
    """Remove from rows their components in the span of constraint rows."""
    _, sizes, basis = np.linalg.svd(constraints, full_matrices=False)
    basis = basis[sizes > _RANK * sizes.max(initial=0.0)]
    return np.asarray(rows - rows @ basis.T @ basis)


def _largest(weight: Array, rows: Array) -> float:
    weighted = np.sqrt(weight)[:, None] * rows
    return float(np.linalg.norm(weighted, 2) ** 2)

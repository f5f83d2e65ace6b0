"""Can contact explain what bodies gain in each step?

The ground gives a group of bodies an impulse at each sphere that may touch. What no impulses there,
of any size and direction, make of the momentum that the group gained is the finding: drag, damping,
torques that are wrong or missing, a wrong mass or inertia, moments that no point contact has. And
what no impulses within Coulomb's cones make of it: friction or gravity that is another.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.cones import Cones, cones_of, unexplained
from mbds_xsim.checks.finding import Figures, Record, check
from mbds_xsim.checks.gains import Axle, axles_of, gains_of
from mbds_xsim.checks.ground import Push, pushes_of

_DEPENDENT = 1e-3  # of the largest singular value: directions that impulses hardly reach
_IMPACT = 5e-3  # of an impact's impulse: tumbling cars leave up to 3.4e-3, in MuJoCo
_FAINT = 0.05  # of the weight: less of it is hardly a contact, whose impulse says little
_SURE = 1e-3  # of the weight: what motion within a step may leave open where drifts add up


@dataclass(frozen=True, eq=False)
class _Left:
    """What is left over in the steps of a group, in N·s; axes are (trajectory, step, …)."""

    rows: Array
    """Impulse, its moment over the longest arm, spins over radii (or that arm), (…, row)."""
    given: Array
    """The same of what was gained, (…, row)."""
    columns: Array
    """What unit impulses at the spheres give of it, (…, row, sphere, 3)."""
    scale: Array
    """The vertical impulse, or the weight's where that is larger, (…)."""
    vague: Array
    """What motion within the step leaves open, (…)."""
    beside: Array
    """What it leaves open besides of the impulses' sizes and directions, beside impacts, (…)."""
    axles: list[Axle]
    flying: Mask
    """Steps in which nothing touches, (…)."""
    known: Mask
    """Steps whose two frames are finite, (…)."""


@check("balance", "balance")
def balance(record: Record) -> Figures:
    """Measure what no impulses at spheres that touch explain, over the weight's or their own.

    None without contact, or where something else supports what may touch.
    """
    groups = [(push, _left_of(record, push)) for push in pushes_of(record)]
    return _figures(record, [(push, left, _parts(left)) for push, left in groups])


@check("balance drift", "balance")
def balance_drift(record: Record) -> Figures:
    """Add up what is not explained of spins about axles, over the impulse of the weight in a step.

    A small torque that is always there shows in it. None without bodies of revolution on axles.
    """
    groups = [(push, _left_of(record, push)) for push in pushes_of(record)]
    return _figures(record, [(push, left, _drifts(record, push, left)) for push, left in groups])


@check("cones", "balance")
def cones(record: Record) -> Figures:
    """Measure what no impulses within Coulomb's cones explain, over the weight's or their own.

    Impulses that push, with friction within μ times the push, and with just so much against the
    slip of a sphere that slips through the whole step. None as of `balance`.
    """
    found = []
    for push in pushes_of(record):
        left = _left_of(record, push)
        rows = _confined(left, cones_of(record, push))
        found.append((push, left, _parts(replace(left, rows=rows, vague=left.vague + left.beside))))
    return _figures(record, found)


def _figures(record: Record, groups: list[tuple[Push, _Left, dict[str, Array]]]) -> Figures:
    names = [f"{name}, {push.name}" for push, _, parts in groups for name in parts]
    columns = [
        np.where(left.known, part, np.nan) for _, left, parts in groups for part in parts.values()
    ]
    return Figures(record.by_step(columns), names)


def _parts(left: _Left) -> dict[str, Array]:
    """Impulse, moment and spins left over, each over the scale, (trajectory, step)."""
    impulse, moment = (np.linalg.norm(left.rows[..., k : k + 3], axis=-1) for k in (0, 3))
    # In flight it is a matter for `momentum`, whose budget goes with the order of the method.
    moment = np.where(left.flying, 0.0, moment)
    off = {"impulse": impulse - left.vague, "moment": moment - left.vague}
    for axle, spin in zip(left.axles, np.moveaxis(left.rows[..., 6:], -1, 0), strict=True):
        off[axle.name] = np.abs(spin) - (0.0 if axle.sphere is None else left.vague)
    return {name: np.maximum(part, 0.0) / left.scale for name, part in off.items()}


def _drifts(record: Record, push: Push, left: _Left) -> dict[str, Array]:
    """Sums up to each step over the weight's impulse, (trajectory, step)."""
    weight = push.mass * record.usual_pull * record.frame
    spins = np.moveaxis(left.rows[..., 6:], -1, 0)
    sure = left.vague < _SURE * weight
    return {
        axle.name: np.abs(np.cumsum(spin * (sure | (axle.sphere is None)), axis=1)) / weight
        for axle, spin in zip(left.axles, spins, strict=True)
    }


@functools.lru_cache(maxsize=4)
def _left_of(record: Record, push: Push) -> _Left:
    """Take off what impulses at the spheres explain, and what acts without contact.

    The latter since near soft contact velocities may belong to a moment beside the frame's.
    """
    gains, axles = gains_of(record, push), axles_of(record.mechanism, push)
    size = float(np.nanmax(rotation.norm(gains.arm), initial=np.finfo(float).tiny))
    radii = np.array([axle.radius or size for axle in axles])
    given = np.concatenate([gains.linear, gains.angular / size, gains.spin / radii], axis=-1)
    known = np.isfinite(given).all(axis=-1) & np.isfinite(gains.arm).all(axis=(2, 3))
    given = np.where(known[..., None], given, 0.0)
    up, weight = np.maximum(given[..., 2], 0.0), push.mass * record.usual_pull * record.frame
    faint = gains.touches.any(axis=2) & (up < _FAINT * weight)
    given[faint, 2] = 0.0
    touches = gains.touches & (known & ~faint)[..., None]
    columns = np.where(touches[..., None, :, None], _columns(gains.arm / size, len(axles)), 0.0)
    for k, axle in enumerate(axles):
        if axle.sphere is not None:
            lever = gains.lever[..., k, :] / axle.radius
            columns[..., 6 + k, axle.sphere, :] = np.where(
                touches[..., axle.sphere, None], lever, 0.0
            )
    # A step is quiet where the ground carries the weight steadily, before and after it as well.
    quiet = push.resting[:, 1:] & push.resting[:, :-1]
    most = up * np.hypot(1.0, record.ground.friction)
    vague = np.where(known, (gains.vague * most + gains.blur) / size, 0.0)
    flying = ~touches.any(axis=2)
    sides = np.pad(up, ((0, 0), (1, 1)))
    beside = np.maximum(np.maximum(sides[:, :-2], sides[:, 2:]) - up, 0.0)
    return _Left(
        rows=_unexplained(columns, given),
        given=given,
        columns=columns,
        scale=np.maximum(up, weight),
        vague=vague + np.where(faint, _FAINT * weight, np.where(quiet, 0.0, _IMPACT * up)),
        beside=np.where(faint | quiet | flying, 0.0, _IMPACT * beside),
        axles=axles,
        flying=flying,
        known=known,
    )


def _columns(arm: Array, axles: int) -> Array:
    """What unit impulses at the spheres give, (trajectory, step, row, sphere, 3)."""
    columns = np.zeros((*arm.shape[:2], 6 + axles, *arm.shape[2:]))
    x, y, z = np.moveaxis(arm, -1, 0)
    for k in range(3):
        columns[..., k, :, k] = 1.0
    columns[..., 3, :, 1], columns[..., 3, :, 2] = -z, y
    columns[..., 4, :, 0], columns[..., 4, :, 2] = z, -x
    columns[..., 5, :, 0], columns[..., 5, :, 1] = -y, x
    return columns


def _unexplained(columns: Array, given: Array) -> Array:
    """Rest of a least-squares solution, (trajectory, step, row)."""
    some = columns.any(axis=(2, 3, 4))
    flat = columns[some].reshape(-1, columns.shape[2], 3 * columns.shape[3])
    fall = np.zeros((*flat.shape[:2], 1))
    fall[:, 2] = 1.0
    turn, size, _ = np.linalg.svd(np.concatenate([flat, fall], axis=-1), full_matrices=False)
    turn = turn * (size > _DEPENDENT * size[:, :1])[:, None]
    left = given.copy()
    left[some] -= np.einsum("src,sqc,sq->sr", turn, turn, given[some], optimize=True)
    return left


def _confined(left: _Left, cones: Cones) -> Array:
    """Rest of the best impulses within the cones, (trajectory, step, row)."""
    some, rows = ~left.flying, left.given.copy()
    rows[some] = unexplained(left.columns[some], left.given[some], cones[some])
    return rows

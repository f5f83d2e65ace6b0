"""Do joints stay between their limits, and do stops give no energy?"""

from __future__ import annotations

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.conservation import energy_of, input_work
from mbds_xsim.checks.coordinates import clear_of_own, coordinate_of, stop_gap
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.flights import summed
from mbds_xsim.checks.joint_work import losses
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_inertia import kicks
from mbds_xsim.scene.joint_space import joint_rate
from mbds_xsim.scene.mechanism import PlacedJoint


@check("past limits", "penetration")
def past_limits(record: Record) -> Figures | None:
    """Measure how far joints are past their limits: hinges [rad], sliders over the scene's length.

    Of recorded frames, as `penetration`. None where no joint has limits.
    """
    parts = [
        joint.beyond(coordinate_of(record, joint))
        / (1.0 if joint.kind == "hinge" else record.scene.length)
        for joint in record.mechanism.limited
    ]
    return Figures(record.by_frame(parts), [f"joint {j.name}" for j in record.mechanism.limited])


@check("stop passivity", lambda record: record.energy_budget)
def stop_passivity(record: Record) -> Figures | None:
    """Measure the energy that stops create over the energy scale; None where there are none.

    It is what the energy balance gains over each period in which a stop may act, up to any of its
    frames: an impact takes (1 − e²) of the energy of the approach, and rest none. Soft stops that
    have given nothing back yet only show less.
    """
    if not record.mechanism.limited or record.scene.contacts:
        return None
    energy, (loss, vague) = energy_of(record), losses(record)
    balance = energy.total - input_work(record) + loss
    stopped = ~record.flying()
    error = np.where(stopped, vague, 0.0).sum(axis=1)
    gained = np.zeros(record.finite.shape)
    gained[:, 1:] = summed(np.diff(balance, axis=1)[..., None], stopped)[..., 0]
    rise = np.where(record.finite, np.maximum(gained, 0.0), np.nan)
    return Figures((rise / energy.scale[:, None])[..., None], uncertainty=error / energy.scale)


def kicked(record: Record, pull: Array | float = 0.0) -> tuple[Array, Array]:
    """Bound what impulses of stops change velocities of bodies by within a step.

    They change the rate of a joint that can reach its stop by no more than the step's ends show and
    the joint falls towards it between them, and with it all that it moves.

    Args:
        record: Of a scene with limits.
        pull: Sizes of the accelerations of joints with limits, (trajectory, step, joint).

    Returns:
        Linear [m/s] and angular [rad/s], shapes (trajectory, step, body).
    """
    limited, states = record.mechanism.limited, record.bodies[:, :-1]
    jumps = np.stack([_jump(record, joint) for joint in limited], axis=-1)
    deep = np.stack([_deepest(record, joint) for joint in limited], axis=-1)
    fallen = np.minimum(record.frame * pull, np.sqrt(2.0 * pull * deep))
    jumps = np.where(np.isfinite(jumps), jumps + np.nan_to_num(fallen), 0.0)
    some = jumps.any(axis=-1)
    found = np.zeros((2, *states.position.shape[:-1]))
    moved = kicks(record.mechanism, limited, states[some])
    for each, given in zip(found, moved, strict=True):
        each[some] = np.einsum("pjb,pj->pb", rotation.norm(given), jumps[some])
    return found[0], found[1]


def _jump(record: Record, joint: PlacedJoint) -> Array:
    """By how much its rate changes, (trajectory, step); NaN where it reaches no stop."""
    gained = np.abs(np.diff(joint_rate(joint, record.world), axis=1))
    return np.where(clear_of_own(joint, record.world, record.frame), np.nan, gained)


def _deepest(record: Record, joint: PlacedJoint) -> Array:
    """How far it is from its stop at the farther end of each step, shape (trajectory, step)."""
    gap = np.maximum(stop_gap(joint, coordinate_of(record, joint)), 0.0)
    return np.maximum(gap[:, 1:], gap[:, :-1])

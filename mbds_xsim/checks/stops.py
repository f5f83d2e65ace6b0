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


@check("past limits", "penetration", of_positions=True)
def past_limits(record: Record) -> Figures | None:
    """Measure how far joints are past their limits: hinges [rad], sliders over the scene's length.

    Only recorded frames count, as in `penetration`. None if no joint has limits.
    """
    parts = [
        joint.beyond(coordinate_of(record, joint))
        / (1.0 if joint.kind == "hinge" else record.scene.length)
        for joint in record.mechanism.limited
    ]
    return Figures(record.by_frame(parts), [f"joint {j.name}" for j in record.mechanism.limited])


@check("stop passivity", lambda record: record.energy_budget)
def stop_passivity(record: Record) -> Figures | None:
    """Measure the energy that stops create, over the energy scale.

    It is the gain of the energy balance over each period in which a stop may act, up to any of its
    frames: an impact takes (1 − e²) of the approach energy, and rest takes none. Soft stops that
    have not yet given their energy back only reduce it. None without stops, or with contacts.
    """
    if not record.mechanism.limited or record.scene.contacts:
        return None
    energy, (loss, step_error) = energy_of(record), losses(record)
    balance = energy.total - input_work(record) + loss
    stopped = ~record.flying()
    error = np.where(stopped, step_error, 0.0).sum(axis=1)
    gain = np.zeros(record.finite.shape)
    gain[:, 1:] = summed(np.diff(balance, axis=1)[..., None], stopped)[..., 0]
    rise = np.where(record.finite, np.maximum(gain, 0.0), np.nan)
    return Figures((rise / energy.scale[:, None])[..., None], uncertainty=error / energy.scale)


def kicked(record: Record, pull: Array | float) -> tuple[Array, Array]:
    """Bound the changes of body velocities that impulses of stops cause within a step.

    If a joint can reach its stop, they change its rate by at most the difference between the step's
    ends plus what pulls it there in the frame, and with it the velocities of all that it moves. For
    mean velocities, twice its largest speed is enough, however often it rebounds.

    Args:
        record: Record of a scene with joint limits.
        pull: Sizes of the accelerations of joints with limits, (trajectory, step, joint).

    Returns:
        Linear [m/s] and angular [rad/s] bounds, shapes (trajectory, step, body).
    """
    limited, states = record.mechanism.limited, record.bodies[:, :-1]
    jumps = np.stack([_jump(record, joint) for joint in limited], axis=-1)
    gaps = np.maximum(np.stack([stop_gap(record, joint) for joint in limited], axis=-1), 0.0)
    rates = np.stack([np.abs(joint_rate(joint, record.world)) for joint in limited], axis=-1)
    farther, faster = (np.maximum(each[:, 1:], each[:, :-1]) for each in (gaps, rates))
    falls = np.minimum(record.frame * pull, 2.0 * np.sqrt(faster**2 + 2.0 * pull * farther))
    jumps = np.where(np.isfinite(jumps), jumps + np.nan_to_num(falls), 0.0)
    stopped = jumps.any(axis=-1)
    bounds = np.zeros((2, *states.position.shape[:-1]))
    responses = kicks(record.mechanism, limited, states[stopped])
    for bound, response in zip(bounds, responses, strict=True):
        bound[stopped] = np.einsum("pjb,pj->pb", rotation.norm(response), jumps[stopped])
    return bounds[0], bounds[1]


def _jump(record: Record, joint: PlacedJoint) -> Array:
    """Compute a joint's change of rate, (trajectory, step); NaN where it reaches no stop."""
    change = np.abs(np.diff(joint_rate(joint, record.world), axis=1))
    return np.where(clear_of_own(record, joint), np.nan, change)

"""All checks of one trajectory set, in the order in which a report lists them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mbds_xsim.checks import (
    balance,
    coefficients,
    collisions,
    conservation,
    displacement,
    eccentric,
    friction,
    integrity,
    kinematics,
    passivity,
    rebounds,
    stops,
)
from mbds_xsim.checks.finding import Check, Finding
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import Method

CHECKS: tuple[Check, ...] = (
    integrity.finite,
    integrity.precision,
    integrity.start,
    integrity.gap,
    integrity.angle_gap,
    integrity.gap_rate,
    integrity.angle_gap_rate,
    integrity.planarity,
    displacement.displacement,
    kinematics.kinematics,
    kinematics.velocity_lag,
    conservation.energy_balance,
    conservation.momentum,
    coefficients.coefficients,
    stops.past_limits,
    stops.stop_passivity,
    passivity.penetration,
    passivity.contact_gap,
    passivity.passivity,
    passivity.energy_rise,
    balance.balance,
    balance.balance_drift,
    balance.cones,
    friction.friction,
    friction.wheels,
    friction.rolling,
    rebounds.restitution,
    eccentric.eccentric_restitution,
    eccentric.eccentric_friction,
    collisions.collision_gap,
    collisions.collision_restitution,
    collisions.collision_friction,
    passivity.hop,
    passivity.resting,
)
"""All checks; each returns a finding, or None if it does not apply to the scene."""


def audit(
    scene: Scene,
    batch: Batch,
    trajectory: Trajectory,
    method: Method | None = None,
    *,
    step: float | None = None,
    contact_time: float | None = None,
) -> list[Finding]:
    """Run every check that applies to the scene.

    Args:
        scene: Simulated scene.
        batch: Starts and inputs.
        trajectory: Recorded motion.
        method: Integration method, which decides budgets and velocity lag; None: unknown, and
            first order is assumed.
        step: Integration step [s]; the frame interval if None.
        contact_time: Declared time over which the engine spreads an impact [s]; None: unknown.
    """
    return audited(Record(scene, batch, trajectory, method, step, contact_time))


def audited(record: Record, checks: Iterable[Check] = CHECKS) -> list[Finding]:
    """Run those of the checks that apply to the scene of a record."""
    # A blow-up may overflow on its way to infinity; the check `finite` reports it.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        findings = (check(record) for check in checks)
        return [finding for finding in findings if finding is not None]

"""All checks of one trajectory set, in the order in which a report lists them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mbds_xsim.checks.balance import balance, balance_drift, cones
from mbds_xsim.checks.coefficients import coefficients
from mbds_xsim.checks.collisions import collision_friction, collision_gap, collision_restitution
from mbds_xsim.checks.conservation import energy_balance, momentum
from mbds_xsim.checks.displacement import displacement
from mbds_xsim.checks.eccentric import eccentric_friction, eccentric_restitution
from mbds_xsim.checks.finding import Check, Finding
from mbds_xsim.checks.friction import friction, rolling, wheels
from mbds_xsim.checks.ground import restitution
from mbds_xsim.checks.integrity import (
    angle_gap,
    angle_gap_rate,
    finite,
    gap,
    gap_rate,
    planarity,
    precision,
    start,
)
from mbds_xsim.checks.kinematics import kinematics, velocity_lag
from mbds_xsim.checks.passivity import (
    contact_gap,
    energy_rise,
    hop,
    passivity,
    penetration,
    resting,
)
from mbds_xsim.checks.record import Record
from mbds_xsim.checks.stops import past_limits, stop_passivity
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import Method

CHECKS: tuple[Check, ...] = (
    finite,
    precision,
    start,
    gap,
    angle_gap,
    gap_rate,
    angle_gap_rate,
    planarity,
    displacement,
    kinematics,
    velocity_lag,
    energy_balance,
    momentum,
    coefficients,
    past_limits,
    stop_passivity,
    penetration,
    contact_gap,
    passivity,
    energy_rise,
    balance,
    balance_drift,
    cones,
    friction,
    wheels,
    rolling,
    restitution,
    eccentric_restitution,
    eccentric_friction,
    collision_gap,
    collision_restitution,
    collision_friction,
    hop,
    resting,
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

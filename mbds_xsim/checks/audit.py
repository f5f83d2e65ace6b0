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
"""Each gives a finding, or None where it does not apply to the scene."""


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
        scene: What was simulated.
        batch: Its starts and inputs.
        trajectory: What was recorded.
        method: How it was made, which decides budgets and velocity lag; None: unknown, and
            first order is assumed.
        step: Integration step [s]; the frame interval where it is left out.
        contact_time: Over which the engine spreads an impact [s], as it declares; None: unknown.
    """
    return audited(Record(scene, batch, trajectory, method, step, contact_time))


def audited(record: Record, checks: Iterable[Check] = CHECKS) -> list[Finding]:
    """Run checks, all if none are named, that apply to the scene of a record."""
    # A blow-up may overflow on its way to infinity; the check `finite` reports it.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = (check(record) for check in checks)
        return [finding for finding in found if finding is not None]

"""Error budgets of a scene."""

from __future__ import annotations

from typing import Annotated

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral

Positive = Annotated[float, bounds.positive]


class Budget(Neutral):
    """Largest deviations with which a trajectory passes; `docs/checks.md` defines each figure."""

    error_1s: Positive = 1e-3
    """RMS particle error at 1 s relative to the scene's length (low and medium intervals)."""
    error: Positive = 1e-2
    """Largest growth-weighted RMS particle error relative to the scene's length."""
    error_turn: Positive = 0.1
    """Largest growth-weighted angle between a body and its reference solution [rad]."""
    gap: Positive = 1e-4
    """Distance between a joint's anchor points [m]."""
    angle_gap: Positive = 1e-3
    """Angle between a hinge's axes, or misalignment of a slider or fixed joint [rad]."""
    energy: Positive = 1e-3
    """Energy balance error relative to the energy scale, for methods of order 2 or higher."""
    energy_first_order: Positive = 1e-2
    """Energy balance error relative to the energy scale, for methods of order 1."""
    planarity: Positive = 1e-6
    """Excursion out of the scene's dimensions, relative to its length."""
    penetration: Positive = 0.02
    """Overlap of a contact sphere with ground or another sphere, relative to the scene's length."""
    contact_gap: Positive = 2e-3
    """Gap across which the ground pushes a sphere, relative to the scene's length."""
    passivity: Positive = 1e-3
    """Energy that contact creates, relative to the energy scale; height that a ball gains by it,
    relative to the scene's length."""
    friction: Positive = 0.02
    """Deviation of the horizontal ground impulse from Coulomb's law, over μ times the vertical."""
    balance: Positive = 1e-3
    """Impulse in a step that no contact explains, relative to the impulse of weight or ground."""
    rolling: Positive = 1e-3
    """Slip of a rolling ball, relative to its largest speed."""
    restitution: Positive = 0.01
    """Deviation of a ball's observed coefficient of restitution from the scene's."""
    resting: Positive = 1e-3
    """Distance that a body at rest moves, relative to the scene's length."""

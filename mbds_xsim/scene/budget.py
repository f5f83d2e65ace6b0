"""What a trajectory may deviate and still pass."""

from __future__ import annotations

from typing import Annotated

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral

Positive = Annotated[float, bounds.positive]


class Budget(Neutral):
    """What a trajectory may deviate and still pass; `docs/checks.md` defines each figure."""

    error_1s: Positive = 1e-3
    """RMS particle error at 1 s over the scene's length (low and medium intervals)."""
    error: Positive = 1e-2
    """Largest growth-weighted RMS particle error over the scene's length."""
    error_turn: Positive = 0.1
    """Largest growth-weighted angle between a body and the reference's [rad]."""
    gap: Positive = 1e-4
    """Distance between a joint's anchor points [m]."""
    angle_gap: Positive = 1e-3
    """Angle between a hinge's axes, or of a slider's or fixed joint's misalignment [rad]."""
    energy: Positive = 1e-3
    """Energy balance over the energy scale, for methods of order 2 and more."""
    energy_first_order: Positive = 1e-2
    """The same for methods of order 1."""
    planarity: Positive = 1e-6
    """Excursion out of the scene's dimensions over its length."""
    penetration: Positive = 0.02
    """Overlap of a contact sphere with what it touches, over the scene's length."""
    contact_gap: Positive = 2e-3
    """Distance from the ground at which it carries a sphere, over the scene's length."""
    passivity: Positive = 1e-3
    """Energy that contact creates over the energy scale; height that a ball gains by it, over the
    scene's length."""
    friction: Positive = 0.02
    """Horizontal impulse of the ground beside Coulomb's law, over μ times the vertical one."""
    balance: Positive = 1e-3
    """Impulse of a step that no contact explains, over the weight's or the ground's own."""
    rolling: Positive = 1e-3
    """Slip of a ball that rolls over its largest speed."""
    restitution: Positive = 0.01
    """Deviation of the coefficient of restitution that a ball's rebound shows."""
    resting: Positive = 1e-3
    """Distance that a body at rest moves over the scene's length."""

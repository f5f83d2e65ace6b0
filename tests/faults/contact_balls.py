"""Faults of contact under balls that roll and bounce."""

from __future__ import annotations

import dataclasses
import math

from mbds_xsim.scene.state import Batch

from .bench import ENGINES
from .contact_changes import (
    FRICTION,
    bouncier,
    ground,
    no_contact,
    options,
    radius,
    raised,
    without_inputs,
)
from .native_contact import friction_box
from .planting import Fault

__all__ = ["BALLS"]

_KICK, _LIFT = 10, 2.0 * 9.81
"""Frame in which the ball is pushed up, and by how much: a mass of 1 kg by twice its weight [N]."""


def _kicked(batch: Batch) -> Batch:
    """Push the ball up for a frame, so that it hops."""
    force = batch.force.copy()
    force[:, _KICK : _KICK + 1, 0, 2] += _LIFT
    return dataclasses.replace(batch, force=force)


BALLS = (
    Fault(
        "friction squared, as by a product of both bodies'",
        "ballscroll",
        ENGINES,
        ("friction",),
        told="friction of",
        model=ground(friction=FRICTION**2),
        odd=True,
    ),
    Fault(
        "no friction",
        "ballscroll",
        ENGINES,
        ("friction",),
        told="friction of",
        model=ground(friction=0.0),
        odd=True,
    ),
    Fault(
        "friction in proportion to slips up to 0.3 m/s",
        "ballscroll",
        ("exudyn",),
        ("friction", "rolling"),
        settings=options(slip_speed=0.3),
    ),
    Fault(
        "friction pyramid within the cone",
        "ballscroll at 45°",
        ("mujoco", "exudyn"),
        ("friction",),
        told="friction of",
        model=ground(friction=FRICTION / math.sqrt(2.0)),
        odd=True,
    ),
    Fault(
        "friction box around the cone",
        "ballscroll at 45°",
        ("pybullet", "dart"),
        ("friction",),
        native=friction_box,
        odd=True,
    ),
    Fault(
        "restitution 0.05 too high",
        "balldrop",
        ENGINES,
        ("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=bouncier(0.05),
        odd=True,
    ),
    Fault(
        "restitution 0.05 too low",
        "balldrop",
        ENGINES,
        ("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=bouncier(-0.05),
        odd=True,
    ),
    Fault(
        "no bounce below 4 m/s",
        "balldrop",
        ("pybullet",),
        ("restitution", "error growth-weighted"),
        settings=options(bounce_threshold=4.0),
    ),
    Fault(
        "elastic ground",
        "balldrop",
        ENGINES,
        ("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=1.0),
        odd=True,
    ),
    Fault("ball hops", "ballscroll", ENGINES, ("hop",), inputs=_kicked),
    Fault(
        "default contact, on which a sliding ball hops",
        "ballscroll",
        ("mujoco",),
        ("hop",),
        settings=options(contact_substeps=0),
    ),
    Fault(
        "contact spheres 5 % too small",
        "balldrop",
        ENGINES,
        ("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        "contact spheres 5 % too large",
        "balldrop",
        ENGINES,
        ("contact gap",),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault("contact left out", "ballscroll", ENGINES, ("penetration",), model=no_contact, odd=True),
    Fault(
        "noise of a frame left out after a bounce",
        "balldrop",
        ENGINES,
        ("balance",),
        inputs=without_inputs(48),
    ),
    Fault(
        "ground 2 mm low, under a ball that bounces",
        "balldrop",
        ENGINES,
        ("contact gap",),
        told="radius of contact",
        model=raised(-2e-3),
    ),
)

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
        name="friction squared, as by a product of both bodies'",
        scene="ballscroll",
        engines=ENGINES,
        checks=("friction",),
        told="friction of",
        model=ground(friction=FRICTION**2),
        odd=True,
    ),
    Fault(
        name="no friction",
        scene="ballscroll",
        engines=ENGINES,
        checks=("friction",),
        told="friction of",
        model=ground(friction=0.0),
        odd=True,
    ),
    Fault(
        name="friction in proportion to slips up to 0.3 m/s",
        scene="ballscroll",
        engines=("exudyn",),
        checks=("friction", "rolling"),
        settings=options(slip_speed=0.3),
    ),
    Fault(
        name="friction pyramid within the cone",
        scene="ballscroll at 45°",
        engines=("mujoco", "exudyn"),
        checks=("friction",),
        told="friction of",
        model=ground(friction=FRICTION / math.sqrt(2.0)),
        odd=True,
    ),
    Fault(
        name="friction box around the cone",
        scene="ballscroll at 45°",
        engines=("pybullet", "dart"),
        checks=("friction",),
        native=friction_box,
        odd=True,
    ),
    Fault(
        name="restitution 0.05 too high",
        scene="balldrop",
        engines=ENGINES,
        checks=("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=bouncier(0.05),
        odd=True,
    ),
    Fault(
        name="restitution 0.05 too low",
        scene="balldrop",
        engines=ENGINES,
        checks=("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=bouncier(-0.05),
        odd=True,
    ),
    Fault(
        name="no bounce below 4 m/s",
        scene="balldrop",
        engines=("pybullet",),
        checks=("restitution", "error growth-weighted"),
        settings=options(bounce_threshold=4.0),
    ),
    Fault(
        name="elastic ground",
        scene="balldrop",
        engines=ENGINES,
        checks=("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=1.0),
        odd=True,
    ),
    Fault(
        name="ball hops",
        scene="ballscroll",
        engines=ENGINES,
        checks=("hop",),
        inputs=_kicked,
    ),
    Fault(
        name="default contact, on which a sliding ball hops",
        scene="ballscroll",
        engines=("mujoco",),
        checks=("hop",),
        settings=options(contact_substeps=0),
    ),
    Fault(
        name="contact spheres 5 % too small",
        scene="balldrop",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        name="contact spheres 5 % too large",
        scene="balldrop",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        name="contact left out",
        scene="ballscroll",
        engines=ENGINES,
        checks=("penetration",),
        model=no_contact,
        odd=True,
    ),
    Fault(
        name="noise of a frame left out after a bounce",
        scene="balldrop",
        engines=ENGINES,
        checks=("balance",),
        inputs=without_inputs(48),
    ),
    Fault(
        name="ground 2 mm low, under a ball that bounces",
        scene="balldrop",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=raised(-2e-3),
    ),
)

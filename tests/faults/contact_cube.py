"""Faults of contact of a cube that tumbles, flies or stands."""

from __future__ import annotations

import dataclasses

from mbds_xsim.scene.state import Batch

from .bench import ENGINES
from .contact_changes import ground, options, radius, without_inputs
from .native import no_reaction
from .native_contact import rolling_resistance
from .planting import Fault

__all__ = ["CUBE"]


def _weak_torque(batch: Batch) -> Batch:
    return dataclasses.replace(batch, torque=0.95 * batch.torque)


CUBE = (
    Fault(
        "elastic ground, corners of a cube",
        "simplecubli",
        ("pybullet", "exudyn"),
        ("eccentric restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=1.0),
    ),
    Fault(
        "impact of a single step, in which friction comes too late",
        "simplecubli",
        ("mujoco",),
        ("eccentric restitution", "eccentric friction"),
        settings=options(impact_steps=1),
    ),
    Fault(
        "corners of a cube 5 % too small",
        "simplecubli set down",
        ENGINES,
        ("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        "corners of a cube 5 % too large",
        "simplecubli set down",
        ENGINES,
        ("contact gap", "passivity"),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        "corners of a thrown cube 20 % too small",
        "simplecubli",
        ("mujoco", "exudyn"),
        ("contact gap", "penetration"),
        told="radius of contact",
        model=radius(0.8),
    ),
    Fault(
        "corners of a thrown cube 5 % too small",
        "simplecubli",
        ("pybullet", "dart"),
        ("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        "corners of a thrown cube 5 % too large",
        "simplecubli",
        ("mujoco", "dart"),
        ("contact gap",),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        "hinge torque without its reaction, in flight",
        "simplecubli in flight",
        ENGINES,
        ("momentum",),
        native=no_reaction,
    ),
    Fault(
        "torques 5 % too weak",
        "simplecubli",
        ("mujoco", "pybullet"),
        ("balance", "balance drift"),
        inputs=_weak_torque,
    ),
    Fault(
        "torques of a frame left out after an impact",
        "simplecubli",
        ("mujoco", "pybullet"),
        ("balance", "balance drift"),
        inputs=without_inputs(48),
    ),
    Fault(
        "friction 0.35, of a thrown cube",
        "simplecubli for 2 s",
        ("mujoco", "dart"),
        ("impact coefficients",),
        told="friction of",
        model=ground(friction=0.35),
    ),
    Fault(
        "restitution 0.90, of a thrown cube",
        "simplecubli for 2 s",
        ("pybullet", "mujoco"),
        ("impact coefficients",),
        unseen={
            "mujoco": "springs of twelve steps leave 0.009 of restitution by themselves; what is "
            "left of 0.033 takes 100 trajectories of 4 s to tell"
        },
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=0.90),
    ),
    Fault(
        "restitution 0.88, of a thrown cube",
        "simplecubli for 2 s",
        ("dart", "mujoco"),
        ("impact coefficients",),
        unseen={
            "mujoco": "eleven impacts on springs of twelve steps know restitution to 0.037; those "
            "of 3 s do show it"
        },
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=0.88),
    ),
    Fault(
        "rolling resistance of 0.1 m",
        "simplecubli",
        ("pybullet",),
        ("balance",),
        native=rolling_resistance,
    ),
)

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
        name="elastic ground, corners of a cube",
        scene="simplecubli",
        engines=("pybullet", "exudyn"),
        checks=("eccentric restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=1.0),
    ),
    Fault(
        name="impact of a single step, in which friction comes too late",
        scene="simplecubli",
        engines=("mujoco",),
        checks=("eccentric restitution", "eccentric friction"),
        settings=options(impact_steps=1),
    ),
    Fault(
        name="corners of a cube 5 % too small",
        scene="simplecubli set down",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        name="corners of a cube 5 % too large",
        scene="simplecubli set down",
        engines=ENGINES,
        checks=("contact gap", "passivity"),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        name="corners of a thrown cube 20 % too small",
        scene="simplecubli",
        engines=("mujoco", "exudyn"),
        checks=("contact gap", "penetration"),
        told="radius of contact",
        model=radius(0.8),
    ),
    Fault(
        name="corners of a thrown cube 5 % too small",
        scene="simplecubli",
        engines=("pybullet", "dart"),
        checks=("contact gap",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        name="corners of a thrown cube 5 % too large",
        scene="simplecubli",
        engines=("mujoco", "dart"),
        checks=("contact gap",),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        name="hinge torque without its reaction, in flight",
        scene="simplecubli in flight",
        engines=ENGINES,
        checks=("momentum",),
        native=no_reaction,
    ),
    Fault(
        name="torques 5 % too weak",
        scene="simplecubli",
        engines=("mujoco", "pybullet"),
        checks=("balance", "balance drift"),
        inputs=_weak_torque,
    ),
    Fault(
        name="torques of a frame left out after an impact",
        scene="simplecubli",
        engines=("mujoco", "pybullet"),
        checks=("balance", "balance drift"),
        inputs=without_inputs(48),
    ),
    Fault(
        name="friction 0.35, of a thrown cube",
        scene="simplecubli for 2 s",
        engines=("mujoco", "dart"),
        checks=("impact coefficients",),
        told="friction of",
        model=ground(friction=0.35),
    ),
    Fault(
        name="restitution 0.90, of a thrown cube",
        scene="simplecubli for 2 s",
        engines=("pybullet", "mujoco"),
        checks=("impact coefficients",),
        unseen={
            "mujoco": "springs of twelve steps leave 0.009 of restitution by themselves; what is "
            "left of 0.033 takes 100 trajectories of 4 s to tell"
        },
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=0.90),
    ),
    Fault(
        name="restitution 0.88, of a thrown cube",
        scene="simplecubli for 2 s",
        engines=("dart", "mujoco"),
        checks=("impact coefficients",),
        unseen={
            "mujoco": "eleven impacts on springs of twelve steps know restitution to 0.037; those "
            "of 3 s do show it"
        },
        told="restitution of",
        untold=("mujoco",),
        model=ground(restitution=0.88),
    ),
    Fault(
        name="rolling resistance of 0.1 m",
        scene="simplecubli",
        engines=("pybullet",),
        checks=("balance",),
        native=rolling_resistance,
    ),
)

"""Faults of contact under wheels."""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

from .bench import ENGINES
from .contact_changes import FRICTION, ground, no_contact, no_noise, radius
from .native import axle_damping
from .native_contact import slippery_wheel, speed_limit
from .planting import Fault
from .smooth import gravity, heavier, stouter

__all__ = ["CAR"]

_FASTEST = 100.0
"""[rad/s]"""


def _cut_spins(scene: Scene, _: Batch, __: float, motion: Trajectory) -> Trajectory:
    """Cut the rates of hinges."""
    mechanism = Mechanism.of(scene)
    native = mechanism.native_rotation(motion.orientation)
    spin = motion.angular_velocity.copy()
    for hinge in mechanism.hinges:
        axis = rotation.rotate(native[:, :, hinge.parent], hinge.axis)
        rate = np.sum((spin[:, :, hinge.child] - spin[:, :, hinge.parent]) * axis, axis=-1)
        excess = rate - np.clip(rate, -_FASTEST, _FASTEST)
        spin[:, :, hinge.child] -= excess[..., None] * axis
    return dataclasses.replace(motion, angular_velocity=spin)


def _lowered(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Let all that follows the start go on 1 mm lower."""
    position = motion.position.copy()
    position[:, 1:, :, 2] -= 1e-3
    return dataclasses.replace(motion, position=position)


CAR = (
    Fault(
        "friction squared, under wheels",
        "particlecar",
        ENGINES,
        ("wheels",),
        told="friction of",
        model=ground(friction=FRICTION**2),
    ),
    Fault(
        "wheels 5 % too small",
        "particlecar",
        ENGINES,
        ("wheels",),
        told="radius of contact",
        model=radius(0.95),
    ),
    Fault(
        "wheels 5 % too large",
        "particlecar",
        ENGINES,
        ("wheels", "passivity"),
        told="radius of contact",
        model=radius(1.05),
    ),
    Fault(
        "contact left out, under wheels", "particlecar", ENGINES, ("penetration",), model=no_contact
    ),
    Fault(
        "speed of hinges held at 100 rad/s",
        "particlecar at 100 rad/s",
        ("pybullet", "dart"),
        ("wheels",),
        native=speed_limit,
    ),
    Fault(
        "speed of hinges recorded up to 100 rad/s",
        "particlecar at 100 rad/s",
        ("mujoco", "exudyn"),
        ("wheels",),
        motion=_cut_spins,
    ),
    Fault(
        "axle damping of 0.001 N·m·s",
        "particlecar for 0.8 s",
        ("mujoco", "dart"),
        ("balance", "balance drift"),
        native=axle_damping,
    ),
    Fault(
        "one wheel 5 % heavier",
        "particlecar for 0.8 s",
        ("mujoco", "pybullet"),
        ("balance", "balance drift"),
        told="mass [kg] of",
        model=heavier("front_left", 0.05),
    ),
    Fault(
        "chassis 5 % heavier",
        "particlecar for 0.8 s",
        ("mujoco", "pybullet"),
        ("balance", "balance drift"),
        told="mass [kg] of",
        model=heavier("chassis", 0.05),
    ),
    Fault(
        "no noise, on wheels",
        "particlecar for 0.8 s",
        ("mujoco", "pybullet"),
        ("balance", "balance drift"),
        inputs=no_noise,
    ),
    Fault(
        "ground 1 mm low", "particlecar", ("mujoco", "pybullet"), ("contact gap",), motion=_lowered
    ),
    Fault(
        "friction of one wheel 0.40",
        "particlecar for 0.8 s",
        ("mujoco", "pybullet"),
        ("cones",),
        told="friction of",
        native=slippery_wheel,
    ),
    Fault(
        "gravity 1 % strong, on wheels",
        "particlecar for 0.8 s",
        ("mujoco", "dart"),
        ("cones",),
        told="gravity [m/s²]",
        model=gravity(1.01 * 9.81),
    ),
    Fault(
        "chassis of 30 % more inertia",
        "particlecar for 0.8 s",
        ("pybullet",),
        ("cones",),
        told="inertia",
        unseen={
            "pybullet": "while wheels slip its yaw takes up to 4e-4 of the weight, which friction "
            "0.1 rad aside could make, and a car that rolls yaws as its wheels let it"
        },
        model=stouter("chassis", 0.3),
    ),
)

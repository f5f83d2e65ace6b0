"""Faults of contact: what users and adapters get wrong about the ground and what moves on it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import msgspec
import numpy as np

from mbds_xsim import rotation
from mbds_xsim.engine import Settings
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory

from .bench import ENGINES
from .native import axle_damping, no_reaction
from .native_contact import friction_box, speed_limit
from .planting import Fault
from .smooth import heavier

__all__ = ["CONTACT"]

_FRICTION = 0.43
_FASTEST = 100.0
"""[rad/s]"""
_KICK, _LIFT = 10, 2.0 * 9.81
"""Frame in which the ball is pushed up, and by how much: a mass of 1 kg by twice its weight [N]."""
_DROPPED = 48
"""Frame whose inputs are left out."""


def _ground(**coefficients: float) -> Callable[[Scene], Scene]:
    """Give the ground other coefficients."""

    def changed(scene: Scene) -> Scene:
        assert scene.ground is not None
        ground = msgspec.structs.replace(scene.ground, **coefficients)
        return msgspec.structs.replace(scene, ground=ground)

    return changed


def _bouncier(by: float) -> Callable[[Scene], Scene]:
    def changed(scene: Scene) -> Scene:
        assert scene.ground is not None
        return _ground(restitution=scene.ground.restitution + by)(scene)

    return changed


def _radius(share: float) -> Callable[[Scene], Scene]:
    """Scale the radius of every contact sphere."""

    def changed(scene: Scene) -> Scene:
        spheres = tuple(
            msgspec.structs.replace(sphere, radius=share * sphere.radius)
            for sphere in scene.contacts
        )
        return msgspec.structs.replace(scene, contacts=spheres)

    return changed


def _no_contact(scene: Scene) -> Scene:
    return msgspec.structs.replace(scene, contacts=(), ground=None)


def _options(**options: float | str) -> Callable[[Settings], Settings]:
    return lambda settings: dataclasses.replace(settings, options={**settings.options, **options})


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


def _kicked(batch: Batch) -> Batch:
    """Push the ball up for a frame, so that it hops."""
    force = batch.force.copy()
    force[:, _KICK : _KICK + 1, 0, 2] += _LIFT
    return dataclasses.replace(batch, force=force)


def _lowered(_: Scene, __: Batch, ___: float, motion: Trajectory) -> Trajectory:
    """Let all that follows the start go on 1 mm lower."""
    position = motion.position.copy()
    position[:, 1:, :, 2] -= 1e-3
    return dataclasses.replace(motion, position=position)


def _no_noise(batch: Batch) -> Batch:
    return dataclasses.replace(batch, force=np.zeros_like(batch.force))


def _weak_torque(batch: Batch) -> Batch:
    return dataclasses.replace(batch, torque=0.95 * batch.torque)


def _dropped_torque(batch: Batch) -> Batch:
    """Leave out the torques of a frame after the first impact."""
    torque = batch.torque.copy()
    torque[:, _DROPPED] = 0.0
    return dataclasses.replace(batch, torque=torque)


def _dropped_noise(batch: Batch) -> Batch:
    """Leave out the noise of a frame after some bounces."""
    force = batch.force.copy()
    force[:, _DROPPED] = 0.0
    return dataclasses.replace(batch, force=force)


CONTACT = (
    Fault(
        name="friction squared, as by a product of both bodies'",
        scene="ballscroll",
        engines=ENGINES,
        checks=("friction",),
        told="friction of",
        model=_ground(friction=_FRICTION**2),
        odd=True,
    ),
    Fault(
        name="friction squared, under wheels",
        scene="particlecar",
        engines=ENGINES,
        checks=("wheels",),
        told="friction of",
        model=_ground(friction=_FRICTION**2),
    ),
    Fault(
        name="no friction",
        scene="ballscroll",
        engines=ENGINES,
        checks=("friction",),
        told="friction of",
        model=_ground(friction=0.0),
        odd=True,
    ),
    Fault(
        name="friction in proportion to slips up to 0.3 m/s",
        scene="ballscroll",
        engines=("exudyn",),
        checks=("friction", "rolling"),
        settings=_options(slip_speed=0.3),
    ),
    Fault(
        name="friction pyramid within the cone",
        scene="ballscroll at 45°",
        engines=("mujoco", "exudyn"),
        checks=("friction",),
        told="friction of",
        model=_ground(friction=_FRICTION / math.sqrt(2.0)),
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
        model=_bouncier(0.05),
        odd=True,
    ),
    Fault(
        name="restitution 0.05 too low",
        scene="balldrop",
        engines=ENGINES,
        checks=("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=_bouncier(-0.05),
        odd=True,
    ),
    Fault(
        name="no bounce below 4 m/s",
        scene="balldrop",
        engines=("pybullet",),
        checks=("restitution", "error growth-weighted"),
        settings=_options(bounce_threshold=4.0),
    ),
    Fault(
        name="elastic ground",
        scene="balldrop",
        engines=ENGINES,
        checks=("restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=_ground(restitution=1.0),
        odd=True,
    ),
    Fault(
        name="elastic ground, corners of a cube",
        scene="simplecubli",
        engines=ENGINES,
        checks=("eccentric restitution",),
        told="restitution of",
        untold=("mujoco",),
        model=_ground(restitution=1.0),
    ),
    Fault(
        name="impact of a single step, in which friction comes too late",
        scene="simplecubli",
        engines=("mujoco",),
        checks=("eccentric restitution", "eccentric friction"),
        settings=_options(impact_steps=1),
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
        settings=_options(contact_substeps=0),
    ),
    Fault(
        name="contact spheres 5 % too small",
        scene="balldrop",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=_radius(0.95),
    ),
    Fault(
        name="contact spheres 5 % too large",
        scene="balldrop",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=_radius(1.05),
    ),
    Fault(
        name="wheels 5 % too small",
        scene="particlecar",
        engines=ENGINES,
        checks=("wheels",),
        told="radius of contact",
        model=_radius(0.95),
    ),
    Fault(
        name="wheels 5 % too large",
        scene="particlecar",
        engines=ENGINES,
        checks=("wheels", "passivity"),
        told="radius of contact",
        model=_radius(1.05),
    ),
    Fault(
        name="corners of a cube 5 % too small",
        scene="simplecubli set down",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=_radius(0.95),
    ),
    Fault(
        name="corners of a cube 5 % too large",
        scene="simplecubli set down",
        engines=ENGINES,
        checks=("contact gap", "passivity"),
        told="radius of contact",
        model=_radius(1.05),
    ),
    Fault(
        name="corners of a thrown cube 20 % too small",
        scene="simplecubli",
        engines=ENGINES,
        checks=("contact gap", "penetration"),
        told="radius of contact",
        model=_radius(0.8),
    ),
    Fault(
        name="corners of a thrown cube 5 % too small",
        scene="simplecubli",
        engines=("pybullet", "dart"),
        checks=("contact gap",),
        told="radius of contact",
        model=_radius(0.95),
    ),
    Fault(
        name="corners of a thrown cube 5 % too large",
        scene="simplecubli",
        engines=ENGINES,
        checks=("contact gap",),
        told="radius of contact",
        model=_radius(1.05),
    ),
    Fault(
        name="contact left out",
        scene="ballscroll",
        engines=ENGINES,
        checks=("penetration",),
        model=_no_contact,
        odd=True,
    ),
    Fault(
        name="contact left out, under wheels",
        scene="particlecar",
        engines=ENGINES,
        checks=("penetration",),
        model=_no_contact,
    ),
    Fault(
        name="speed of hinges held at 100 rad/s",
        scene="particlecar at 100 rad/s",
        engines=("pybullet", "dart"),
        checks=("wheels",),
        native=speed_limit,
    ),
    Fault(
        name="speed of hinges recorded up to 100 rad/s",
        scene="particlecar at 100 rad/s",
        engines=("mujoco", "exudyn"),
        checks=("wheels",),
        motion=_cut_spins,
    ),
    Fault(
        name="hinge torque without its reaction, in flight",
        scene="simplecubli in flight",
        engines=ENGINES,
        checks=("momentum",),
        native=no_reaction,
    ),
    Fault(
        name="axle damping of 0.001 N·m·s",
        scene="particlecar for 0.8 s",
        engines=("mujoco", "dart"),
        checks=("balance", "balance drift"),
        native=axle_damping,
    ),
    Fault(
        name="one wheel 5 % heavier",
        scene="particlecar for 0.8 s",
        engines=("mujoco", "pybullet"),
        checks=("balance", "balance drift"),
        told="mass [kg] of",
        model=heavier("front_left", 0.05),
    ),
    Fault(
        name="chassis 5 % heavier",
        scene="particlecar for 0.8 s",
        engines=("mujoco", "pybullet"),
        checks=("balance", "balance drift"),
        told="mass [kg] of",
        model=heavier("chassis", 0.05),
    ),
    Fault(
        name="no noise, on wheels",
        scene="particlecar for 0.8 s",
        engines=("mujoco", "pybullet"),
        checks=("balance", "balance drift"),
        inputs=_no_noise,
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
        inputs=_dropped_torque,
    ),
    Fault(
        name="noise of a frame left out after a bounce",
        scene="balldrop",
        engines=ENGINES,
        checks=("balance",),
        inputs=_dropped_noise,
    ),
    Fault(
        name="ground 1 mm low",
        scene="particlecar",
        engines=("mujoco", "pybullet"),
        checks=("contact gap",),
        motion=_lowered,
    ),
)

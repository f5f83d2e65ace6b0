"""All the faults: what users and adapters get wrong, each where it can be seen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mbds_xsim.base import rotation

from . import changes as to
from . import native
from . import recording as recorded
from .bench import ENGINES
from .planting import Change, Fault

__all__ = ["FAULTS", "change_of"]

_ALL = ", ".join(ENGINES)
_LIMIT = "consistency of positions, consistency of energy"
_LAG = f"kinematics, velocity lag, {_LIMIT}"
_FRICTION = 0.43


def _fault(name: str, scene: str, engines: str, checks: str, change: Change, **more: Any) -> Fault:
    """Make a fault; names of engines and checks are separated by commas."""
    named = tuple(checks.split(", ")) if checks else ()
    return Fault(name, scene, tuple(engines.split(", ")), named, change, **more)


def _as(value: Any) -> to.Figure:
    return lambda _: value


def _more(by: float) -> to.Figure:
    return lambda kept: kept + by


def change_of(name: str) -> Change:
    """Give the change of a fault."""
    return next(fault.change for fault in FAULTS if fault.name == name)


SMOOTH = (
    _fault("default damping of 0.04 left on", "3pendulum", "pybullet", f"energy, {_LIMIT}",
        to.options(linear_damping=0.04, angular_damping=0.04), odd=True),
    _fault("joint damping of 0.01 N·m·s left in", "3pendulum", "mujoco, dart", f"energy, {_LIMIT}",
        Change(native=native.joint_damping, told="damping"), odd=True),
    _fault("joint motors left on", "3pendulum", "pybullet", "energy, error growth-weighted",
        Change(native=native.motors_left_on), odd=True),
    _fault("default solref on the loops", "2ladder", "mujoco", f"gap, {_LIMIT}",
        to.options(loop_time_constant=0.0)),
    _fault("one rung 1 % heavier", "2ladder", _ALL, _LIMIT, to.heavier("rung1", 0.01)),
    _fault("inertia axes swapped", "workbench", "mujoco, pybullet, dart", _LIMIT,
        to.part("bodies", "forearm",
            to.changed(inertia=to.changed(moments=lambda m: (m[1], m[0], m[2]))),
            "inertia [kg·m²] of forearm")),
    _fault("quaternion order swapped at the start", "3pendulum", "mujoco, exudyn", "start",
        Change(inputs=to.swapped_start, told="start: orientation"), odd=True),
    _fault("quaternion order swapped in the recording", "3pendulum", "dart, pybullet", "start",
        Change(motion=recorded.swapped_recording)),
    _fault("hinge axis flipped", "workbench", _ALL, _LIMIT,
        to.flipped("shoulder"), odd=True),
    _fault("frames half a step late", "3pendulum", _ALL, f"kinematics, {_LIMIT}",
        recorded.late(steps=0.5)),
    _fault("positions half a step late", "3pendulum", _ALL, _LAG,
        recorded.late(steps=0.5, speeds=False)),
    _fault("velocities half a step late", "3pendulum", _ALL, _LAG,
        recorded.late(steps=0.5, places=False)),
    _fault("velocities half a step late, first order with loops", "2ladder", "pybullet, dart",
        "kinematics, velocity lag", recorded.late(steps=0.5, places=False)),
    _fault("frames half a frame late", "3pendulum", _ALL, f"error growth-weighted, {_LIMIT}",
        recorded.late(frames=0.5), odd=True),
    _fault("force 5 cm off the centre of mass", "3pendulum", "pybullet, dart, exudyn", _LIMIT,
        Change(native=native.force_off_center)),
    _fault("hinge torque without its reaction", "workbench", _ALL, f"momentum, {_LIMIT}",
        Change(native=native.no_reaction), odd=True),
    _fault("inputs a frame late", "3pendulum", _ALL, _LIMIT, Change(inputs=to.late_inputs)),
    _fault("gravity 9.80", "3pendulum", _ALL, _LIMIT, to.gravity(9.80)),
    # What is left of their own inertia only keeps the rods' regular.
    _fault("particles free instead of welded", "3pendulum", _ALL, _LIMIT,
        to.particles("", "inertia [kg·m²] of link1", inertia=to.scaled(1e-3)), odd=True),
    _fault("one particle 1 % heavier", "3pendulum", _ALL, _LIMIT, to.heavier("link2", 0.01)),
    _fault("all particles 1 % heavier", "3pendulum", _ALL, _LIMIT,
        to.particles("", "mass [kg] of link1", mass=to.scaled(1.01))),
    _fault("axis of a hinge without a drive flipped", "workbench", "mujoco, dart", "",
        to.flipped("rocker pin"),
        unseen=dict.fromkeys(
            ("mujoco", "dart"), "only the sign of the hinge's angle changes, which nothing uses")),
    _fault("inertia about the rods doubled", "3pendulum", _ALL, "",
        Change(model=to.thick_rods, told="inertia [kg·m²] of link1"),
        unseen=dict.fromkeys(
            ENGINES, "nothing turns a rod about itself, so no motion depends on it")),
)  # fmt: skip

BALLS = (
    _fault("friction squared, as by a product of both bodies'", "ballscroll", _ALL, "friction",
        to.ground("friction", _as(_FRICTION**2)), odd=True),
    _fault("no friction", "ballscroll", _ALL, "friction",
        to.ground("friction", _as(0.0)), odd=True),
    _fault("friction in proportion to slips up to 0.3 m/s", "ballscroll", "exudyn",
        "friction, rolling", to.options(slip_speed=0.3)),
    _fault("friction pyramid within the cone", "ballscroll at 45°", "mujoco, exudyn", "friction",
        to.ground("friction", _as(_FRICTION / math.sqrt(2.0))), odd=True),
    _fault("friction box around the cone", "ballscroll at 45°", "pybullet, dart", "friction",
        Change(native=native.friction_box), odd=True),
    _fault("restitution 0.05 too high", "balldrop", _ALL, "restitution",
        to.ground("restitution", _more(0.05)), untold=("mujoco",), odd=True),
    _fault("restitution 0.05 too low", "balldrop", _ALL, "restitution",
        to.ground("restitution", _more(-0.05)), untold=("mujoco",), odd=True),
    _fault("no bounce below 4 m/s", "balldrop", "pybullet", "restitution, error growth-weighted",
        to.options(bounce_threshold=4.0)),
    _fault("elastic ground", "balldrop", _ALL, "restitution", to.ground("restitution", _as(1.0)),
        untold=("mujoco",), odd=True),
    _fault("ball hops", "ballscroll", _ALL, "hop", to.force(to.kicked)),
    _fault("default contact, on which a sliding ball hops", "ballscroll", "mujoco", "hop",
        to.options(contact_substeps=0)),
    _fault("contact spheres 5 % too small", "balldrop", _ALL, "contact gap",
        to.radius(to.scaled(0.95))),
    _fault("contact spheres 5 % too large", "balldrop", _ALL, "contact gap",
        to.radius(to.scaled(1.05))),
    _fault("contact left out", "ballscroll", _ALL, "penetration", Change(model=to.bare), odd=True),
    _fault("noise of a frame left out after a bounce", "balldrop", _ALL, "balance",
        to.without_inputs(48)),
    _fault("ground 2 mm low, under a ball that bounces", "balldrop", _ALL, "contact gap",
        to.radius(_more(-2e-3))),
)  # fmt: skip

CAR = (
    _fault("friction squared, under wheels", "particlecar", _ALL, "wheels",
        to.ground("friction", _as(_FRICTION**2))),
    _fault("wheels 5 % too small", "particlecar", _ALL, "wheels", to.radius(to.scaled(0.95))),
    _fault("wheels 5 % too large", "particlecar", _ALL, "wheels, passivity",
        to.radius(to.scaled(1.05))),
    _fault("contact left out, under wheels", "particlecar", _ALL, "penetration",
        Change(model=to.bare)),
    _fault("speed of hinges held at 100 rad/s", "particlecar at 100 rad/s", "pybullet, dart",
        "wheels", Change(native=native.speed_limit)),
    _fault("speed of hinges recorded up to 100 rad/s", "particlecar at 100 rad/s", "mujoco, exudyn",
        "wheels", Change(motion=recorded.cut_spins)),
    _fault("axle damping of 0.001 N·m·s", "particlecar for 0.8 s", "mujoco, dart",
        "balance, balance drift", Change(native=native.axle_damping)),
    _fault("one wheel 5 % heavier", "particlecar for 0.8 s", "mujoco, pybullet",
        "balance, balance drift", to.heavier("front_left", 0.05)),
    _fault("chassis 5 % heavier", "particlecar for 0.8 s", "mujoco, pybullet",
        "balance, balance drift", to.heavier("chassis", 0.05)),
    _fault("no noise, on wheels", "particlecar for 0.8 s", "mujoco, pybullet",
        "balance, balance drift", to.force(np.zeros_like)),
    _fault("ground 1 mm low", "particlecar", "mujoco, pybullet", "contact gap",
        recorded.each("position", recorded.lowered)),
    _fault("friction of one wheel 0.40", "particlecar for 0.8 s", "mujoco, pybullet", "cones",
        Change(native=native.slippery_wheel, told="friction of")),
    _fault("gravity 1 % strong, on wheels", "particlecar for 0.8 s", "mujoco, dart", "cones",
        to.gravity(1.01 * 9.81)),
    _fault("chassis of 30 % more inertia", "particlecar for 0.8 s", "pybullet", "cones",
        to.stouter("chassis", 0.3),
        unseen={
            "pybullet": "while wheels slip its yaw takes up to 4e-4 of the weight, which friction "
            "0.1 rad aside could make, and a car that rolls yaws as its wheels let it"}),
)  # fmt: skip

CUBE = (
    _fault("elastic ground, corners of a cube", "simplecubli", "pybullet, exudyn",
        "eccentric restitution", to.ground("restitution", _as(1.0)), untold=("mujoco",)),
    _fault("impact of a single step, in which friction comes too late", "simplecubli", "mujoco",
        "eccentric restitution, eccentric friction", to.options(impact_steps=1)),
    _fault("corners of a cube 5 % too small", "simplecubli set down", _ALL, "contact gap",
        to.radius(to.scaled(0.95))),
    _fault("corners of a cube 5 % too large", "simplecubli set down", _ALL,
        "contact gap, passivity", to.radius(to.scaled(1.05))),
    _fault("corners of a thrown cube 20 % too small", "simplecubli", "mujoco, exudyn",
        "contact gap, penetration", to.radius(to.scaled(0.8))),
    _fault("corners of a thrown cube 5 % too small", "simplecubli", "pybullet, dart", "contact gap",
        to.radius(to.scaled(0.95))),
    _fault("corners of a thrown cube 5 % too large", "simplecubli", "mujoco, dart", "contact gap",
        to.radius(to.scaled(1.05))),
    _fault("hinge torque without its reaction, in flight", "simplecubli in flight", _ALL,
        "momentum", Change(native=native.no_reaction)),
    _fault("torques 5 % too weak", "simplecubli", "mujoco, pybullet", "balance, balance drift",
        to.torque(to.times(0.95))),
    _fault("torques of a frame left out after an impact", "simplecubli", "mujoco, pybullet",
        "balance, balance drift", to.without_inputs(48)),
    _fault("friction 0.35, of a thrown cube", "simplecubli for 3 s", "mujoco, dart",
        "impact coefficients", to.ground("friction", _as(0.35))),
    _fault("restitution 0.90, of a thrown cube", "simplecubli for 3 s", "pybullet, mujoco",
        "impact coefficients", to.ground("restitution", _as(0.90)), untold=("mujoco",),
        unseen={
            "mujoco": "springs of some steps leave 0.009 of restitution by themselves; what is "
            "left of 0.033 takes 100 trajectories of 4 s to tell"}),
    _fault("restitution 0.88, of a thrown cube", "simplecubli for 3 s", "dart, mujoco",
        "impact coefficients", to.ground("restitution", _as(0.88)), untold=("mujoco",)),
    _fault("rolling resistance of 0.1 m", "simplecubli", "pybullet", "balance",
        Change(native=native.rolling_resistance)),
)  # fmt: skip

RECORDED = (
    _fault("places drift at 0.5 m/s", "particlecar", _ALL, "displacement",
        recorded.each("position", recorded.drifting)),
    _fault("places shaken by 1 mm", "particlecar", _ALL, "displacement",
        recorded.each("position", recorded.shaken)),
    _fault("places a frame late", "particlecar", _ALL, "displacement",
        recorded.frames(lambda due: np.maximum(due - 1, 0), ("position", "orientation"))),
    _fault("orientations of left and right wheels exchanged", "particlecar", _ALL, "displacement",
        recorded.exchanged((1, 2), (3, 4), fields=("orientation",))),
    _fault("last frame twice", "particlecar", _ALL, "displacement",
        recorded.frames(lambda due: np.minimum(due, due[-1] - 1))),
    _fault("last ten frames frozen", "simplecubli", _ALL, "displacement",
        recorded.frames(lambda due: np.minimum(due, due[-1] - 10))),
    _fault("a frame twice, those after it late", "3pendulum", _ALL, "displacement",
        recorded.frames(lambda due: np.where(due > len(due) // 2, due - 1, due))),
    _fault("a rod twists beside its rate", "3pendulum", _ALL, "displacement",
        recorded.each("orientation", recorded.twisting)),
    _fault("rate of a twist that a rod has not", "3pendulum", _ALL, "displacement",
        recorded.each("angular_velocity", recorded.told_to_twist)),
    _fault("a rung twists beside its rate", "2ladder", "mujoco, dart", "kinematics",
        recorded.each("orientation", recorded.twisting)),
    _fault("rate of a twist that a rung has not", "2ladder", "pybullet, exudyn", "kinematics",
        recorded.each("angular_velocity", recorded.told_to_twist)),
    _fault("a ball twists beside its rate", "ballscroll", "mujoco, pybullet", "displacement",
        recorded.each("orientation", recorded.twisting),
        unseen={
            "mujoco": "0.1 rad/s is 0.64 of what 0.8 s of rolling at 10 m/s leave open; after "
            "2 s the turn itself is 0.2 rad off the reference, of 0.1 allowed"}),
    _fault("rate of a twist that a ball has not", "ballscroll", "mujoco, dart", "rolling",
        recorded.each("angular_velocity", recorded.told_to_twist)),
    _fault("a flywheel faces as it started", "simplecubli", "mujoco", "angle gap",
        recorded.each("orientation", recorded.held_in_the_world)),
    _fault("all numbers after the start rounded to single precision", "3pendulum", "mujoco",
        "precision", Change(motion=recorded.in_single_precision)),
    _fault("velocity of a body aside", "workbench", _ALL, "gap rate",
        recorded.each("velocity", recorded.aside)),
    _fault("angular velocity in body frames", "workbench", "dart", "kinematics, energy",
        recorded.each("angular_velocity", recorded.spin_in_body_frames)),
    _fault("orientation turned the other way", "workbench", "mujoco", "gap, kinematics",
        recorded.each("orientation", lambda values, _: rotation.conjugate(values))),
    _fault("places 1 mm beside the centres of mass", "2ladder", "exudyn", "gap",
        recorded.each("position", recorded.beside_centres)),
    _fault("velocities from differences of places", "3pendulum", "mujoco", "kinematics",
        recorded.each("velocity", recorded.differences)),
    _fault("velocities 0.1 % too fast", "3pendulum", "dart", "kinematics",
        recorded.each("velocity", lambda values, _: 1.001 * values)),
    _fault("places smoothed over three frames", "3pendulum", "exudyn", "kinematics, gap",
        recorded.each("position", recorded.smoothed)),
    _fault("places of one frame interpolated", "2ladder", "mujoco", "kinematics, gap",
        recorded.each("position", recorded.interpolated)),
    _fault("one frame twice, the later ones late", "workbench", "exudyn",
        "kinematics, error growth-weighted", recorded.frames(recorded.repeated)),
    _fault("one frame twice, the later ones late, under wheels", "particlecar", "dart",
        "balance, wheels", recorded.frames(recorded.repeated)),
    _fault("one frame left out, the last twice", "ballscroll", "pybullet",
        "kinematics, error growth-weighted", recorded.frames(recorded.dropped)),
    _fault("one frame left out, the last twice, of a cube", "simplecubli", "exudyn",
        "balance, momentum", recorded.frames(recorded.dropped)),
    _fault("two links in each other's place", "3pendulum", "pybullet", "gap",
        recorded.exchanged((1, 2)), odd=True),
    _fault("rates of two flywheels exchanged", "simplecubli in flight", "mujoco",
        "kinematics, momentum", recorded.exchanged((1, 2), fields=("angular_velocity",))),
    _fault("rates of two wheels exchanged", "particlecar", "mujoco", "kinematics, wheels",
        recorded.exchanged((1, 4), fields=("angular_velocity",))),
    _fault("orientation that is no unit quaternion", "ballscroll", "mujoco", "finite",
        recorded.each("orientation", lambda values, _: (1.0 + 1e-6) * values)),
    _fault("angular velocity in degrees, of one body", "balldrop", "exudyn", "kinematics",
        recorded.each("angular_velocity", lambda values, _: np.degrees(values))),
)  # fmt: skip

MODELLING = (
    _fault("gravity tilted by 0.1°", "3pendulum", "exudyn", _LIMIT, to.tilted(0.1)),
    _fault("ground tilted by 0.5°", "ballscroll", "dart", "friction", to.tilted(0.5)),
    _fault("anchor of a hinge 1 mm along the rod", "3pendulum", "mujoco", "gap",
        to.part("joints", "joint2", to.changed(anchor=to.moved(0.0, 0.0, 1e-3)), "anchor")),
    _fault("anchor of a hinge 1 mm along its axis", "workbench", "dart", "",
        to.part("joints", "shoulder", to.changed(anchor=to.moved(3e-4, 1e-3, 1e-4)), "anchor"),
        unseen={"dart": "anchored anywhere on its axis a hinge is the same hinge"}),
    _fault("hinge axis turned by 0.1°", "workbench", "mujoco", f"angle gap, {_LIMIT}",
        to.part("joints", "elbow", to.changed(axis=to.moved(0.0, 0.0, 2e-3)), "axis")),
    _fault("centre of mass 1 mm off", "workbench", "exudyn", _LIMIT,
        to.part("bodies", "rotor", to.changed(inertia=to.changed(com=to.moved(1e-3, 0.0, 0.0))),
            "anchor [m] of rotor axle")),
    _fault("one moment of inertia 5 % large", "workbench", "mujoco", _LIMIT,
        to.part("bodies", "forearm",
            to.changed(inertia=to.changed(moments=to.scaled(1.0, 1.05, 1.0))), "inertia")),
    _fault("spring 1 % stiff", "workbench", "exudyn", _LIMIT,
        to.part("springs", "cart spring", to.changed(stiffness=to.scaled(1.01)),
            "stiffness [N/m] of cart spring")),
    _fault("damper 5 % weak", "workbench", "mujoco", _LIMIT,
        to.part("springs", "cart spring", to.changed(damping=to.scaled(0.95)),
            "damping [N·s/m] of cart spring")),
    _fault("spring of a hinge 5 % stiff", "workbench with sprung joints", "mujoco, pybullet",
        _LIMIT,
        to.part("joints", "elbow", to.changed(stiffness=to.scaled(1.05)), "stiffness of elbow"),
        untold=("pybullet",)),
    _fault("damper of a hinge left out", "workbench with sprung joints", _ALL, _LIMIT,
        to.part("joints", "elbow", to.changed(damping=_as(0.0)), "damping of elbow"),
        untold=("pybullet",)),
    _fault("damper of a slider 5 % weak", "workbench with sprung joints", "dart, exudyn", _LIMIT,
        to.part("joints", "rail", to.changed(damping=to.scaled(0.95)),
            "damping of rail")),
    _fault("servo 5 % stiff", "workbench with sprung joints", "mujoco, exudyn", _LIMIT,
        to.part("servos", "", to.changed(stiffness=to.scaled(1.05)), "stiffness of shoulder")),
    _fault("servo of which the targets alone act", "workbench with sprung joints", "mujoco, dart",
        _LIMIT, Change(model=to.changed(servos=lambda _: ()), told="joints")),
    _fault("limit of a servo 5 % large", "workbench with a limited servo",
        "mujoco, pybullet, dart, exudyn", _LIMIT,
        to.part("servos", "", to.changed(limit=to.scaled(1.05)), "limit of the servo of shoulder"),
        untold=("exudyn",)),
    _fault("limit of a servo left out", "workbench with a limited servo",
        "mujoco, pybullet, dart", _LIMIT,
        to.part("servos", "", to.changed(limit=_as(1e9)), "limit of the servo of shoulder")),
    _fault("rotor 5 % heavy", "workbench with rotors", "mujoco, pybullet, exudyn", _LIMIT,
        to.part("joints", "elbow", to.changed(armature=to.scaled(1.05)), "armature of elbow")),
    _fault("rotor left out", "workbench with rotors", "mujoco, pybullet", _LIMIT,
        to.part("joints", "elbow", to.changed(armature=_as(0.0)), "armature")),
    _fault("gear of a ratio 1 % large", "workbench with a gear", "mujoco, pybullet",
        f"angle gap, angle gap rate, {_LIMIT}",
        to.part("couplings", "", to.changed(ratio=to.scaled(1.01)), "ratio of rotor axle"),
        untold=("pybullet",)),
    _fault("gear left out", "workbench with a gear", "mujoco, pybullet",
        f"angle gap, angle gap rate, {_LIMIT}",
        Change(model=to.changed(couplings=lambda _: ()), told="couplings"), untold=("pybullet",)),
    _fault("dry friction of a hinge 10 % large", "workbench with dry friction",
        "mujoco, pybullet, dart", _LIMIT,
        to.part("joints", "elbow", to.changed(friction=to.scaled(1.1)), "dry friction of elbow"),
        untold=("pybullet",)),
    _fault("dry friction of a slider left out", "workbench with dry friction",
        "mujoco, pybullet, dart", _LIMIT,
        to.part("joints", "rail", to.changed(friction=_as(0.0)), "dry friction"),
        untold=("pybullet",)),
    _fault("stop of a hinge 0.05 rad early", "workbench with stops", "mujoco, pybullet, dart",
        _LIMIT,
        to.part("joints", "elbow", to.changed(limits=_as((-1.0, 0.2))), "upper limit of elbow"),
        untold=("pybullet",)),
    _fault("stop of a slider left out", "workbench with stops", "mujoco, pybullet, dart",
        f"past limits, {_LIMIT}",
        to.part("joints", "rail", to.changed(limits=_as(None)), "joints"),
        untold=("pybullet",)),
    _fault("rebound from a stop a fifth high", "workbench with rebounds", "mujoco", _LIMIT,
        to.part("joints", "elbow", to.changed(restitution=_as(0.6)), "")),
    _fault("spring 1 mm long", "workbench", "mujoco", _LIMIT,
        to.part("springs", "stay", to.changed(rest_length=_more(1e-3)), "rest length [m] of stay")),
    _fault("flywheel of 5 % more inertia", "simplecubli in flight", "exudyn", "momentum",
        to.particles("flywheel_x", "inertia", inertia=to.scaled(2.0))),
    _fault("ground 2 mm high, under wheels", "particlecar", "exudyn", "contact gap, passivity",
        to.radius(_more(2e-3))),
    _fault("centre of a wheel's sphere 3 mm ahead", "particlecar", "mujoco", "wheels",
        to.part("contacts", "front_left", to.changed(center=to.moved(3e-3, 0.0, 0.0)),
            "centre of contact")),
)  # fmt: skip

DRIVING = (
    _fault("forces 1 % weak", "3pendulum", "mujoco", _LIMIT, to.force(to.times(0.99))),
    _fault("forces a frame early", "3pendulum", "exudyn", _LIMIT, to.force(to.early)),
    _fault("forces in reversed order of time", "3pendulum", "pybullet", _LIMIT,
        to.force(lambda force: force[:, ::-1])),
    _fault("forces mirrored in y", "2ladder", "dart", _LIMIT, to.force(to.times(1.0, -1.0, 1.0))),
    _fault("forces on bodies in reversed order", "2ladder", "mujoco", _LIMIT,
        to.force(lambda force: force[:, :, ::-1])),
    _fault("forces in body frames", "workbench", "mujoco", _LIMIT,
        Change(inputs=to.in_body_frames)),
    _fault("torques 1 % weak", "workbench", "dart", _LIMIT, to.torque(to.times(0.99))),
    _fault("torques on hinges in reversed order", "workbench", "exudyn", _LIMIT,
        to.torque(lambda torque: torque[:, :, ::-1]), odd=True),
    _fault("torques a frame late", "simplecubli in flight", "dart", "balance",
        to.torque(lambda torque: np.roll(torque, 1, axis=1))),
    _fault("noise without its vertical part", "balldrop", "pybullet", "balance",
        to.force(to.times(1.0, 1.0, 0.0))),
    _fault("noise doubled", "ballscroll", "exudyn", "balance", to.force(to.times(2.0))),
    _fault("torques of left and right wheels exchanged", "particlecar", "exudyn", "cones",
        to.torque(lambda torque: torque[:, :, [1, 0, 3, 2]])),
    _fault("start with a rate 1e-6 off", "3pendulum", "mujoco", "start",
        to.started(angular_velocity=1e-6)),
    _fault("linear damping of 0.04 left on, in the air", "balldrop", "pybullet", "momentum",
        to.options(linear_damping=0.04)),
    _fault("angular damping of 0.04 left on, of a cube", "simplecubli", "pybullet", "momentum",
        to.options(angular_damping=0.04)),
)  # fmt: skip

FAULTS = (*SMOOTH, *BALLS, *CAR, *CUBE, *RECORDED, *MODELLING, *DRIVING)

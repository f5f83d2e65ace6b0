"""All stability studies: scenes made harder by one value.

To add a study, define a `Study` here and list it in `STUDIES`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import msgspec

from mbds_xsim.base.errors import check_name
from mbds_xsim.scene.sampling_terms import HingeRate, Swing, Throw, Turn, span_of
from mbds_xsim.scene.scene import (
    PARTICLE_INERTIA,
    WORLD,
    Body,
    Ground,
    Inertia,
    Joint,
    Particle,
    Scene,
    SpringDamper,
)
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.stability import Study

SCENES = Study(
    "scenes", "the paper's scenes and an overconstrained mechanism, at steps up to 50 ms", "scene",
    "", ("ballscroll", "balldrop", "5pendulum", "6pendulum", "2ladder", "3ladder", "particlecar",
    "simplecubli", "bricard"), load_scene,
)  # fmt: skip


# Heavy bodies on light ones: a rung on ropes whose knots weigh 1 kg each.
#
# The load stretches the ropes and so decides how fast they swing sideways: with a tension T, rods
# of length l and particles of mass m the fastest rate is 2 √(T / (m l)), 1400 rad/s at a ratio of
# 1e4. That rate limits an explicit method's step, however still the ropes hang.

_LADDER_TILT = (math.radians(20.0),) * 2
_RUNG = "rung1"


def _heavy_ladder(ratio: float) -> Scene:
    scene = load_scene("1ladder")
    bodies = tuple(_heavy(body, ratio) if body.name == _RUNG else body for body in scene.bodies)
    swing = Turn((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angle=_LADDER_TILT, rate=(1.0, 1.0))
    return msgspec.structs.replace(scene, bodies=bodies, sampling=(swing,))


def _heavy(rung: Body, ratio: float) -> Body:
    share = ratio / len(rung.particles)
    particles = tuple(
        msgspec.structs.replace(p, mass=share, inertia=share * PARTICLE_INERTIA)
        for p in rung.particles
    )
    return msgspec.structs.replace(rung, particles=particles)


MASS_RATIO = Study(
    "mass-ratio", "a heavy rung on two ropes of light particles, which close a loop",
    "mass of the rung over that of a neighbour", "", (1.0, 10.0, 100.0, 1e3, 1e4), _heavy_ladder,
)  # fmt: skip


# Ever more links in a rope of one length and one mass.
#
# The shorter the links, the faster the rope swings sideways: 2 √(g n / l) at its top, with n links
# of length l. An explicit method's step shrinks with n.

_ROPE_LENGTH = 2.0  # [m]
_MASS = 2.0  # [kg]
_SLIM = 0.01  # inertia of a particle over mass times length² of its link
_ROPE_TILT = (math.radians(60.0),) * 2


def _rope(links: float) -> Scene:
    count = round(links)
    rod, mass = _ROPE_LENGTH / count, _MASS / count
    names = [f"link{k}" for k in range(1, count + 1)]
    inertia = _SLIM * mass * rod**2
    return Scene(
        name="rope",
        bodies=tuple(
            Body(name, particles=(Particle((0.0, 0.0, -rod * k), mass, inertia),))
            for k, name in enumerate(names, 1)
        ),
        joints=tuple(
            Joint(f"joint{k}", "ball", parent, name, (0.0, 0.0, -rod * (k - 1)))
            for k, (parent, name) in enumerate(zip(["world", *names], names, strict=False), 1)
        ),
        length=_ROPE_LENGTH,
        sampling=(Turn((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angle=_ROPE_TILT, rate=(0.0, 0.0)),),
    )


CHAIN_LENGTH = Study(
    "chain-length", "a rope of 2 m and 2 kg in ever more links on ball joints", "links", "",
    (1.0, 4.0, 16.0, 32.0, 64.0, 128.0), _rope, least=1,
)  # fmt: skip


def _sized(family: str, size: float) -> Scene:
    return load_scene(f"{round(size)}{family}")


LOOPS = Study(
    "loops", "rope ladders in the wind, one closed loop more with every rung", "rungs", "",
    (1.0, 2.0, 3.0, 5.0, 8.0), partial(_sized, "ladder"), least=1,
)  # fmt: skip


# Ever more links of the paper's pendulum, at one of its medium starts.
#
# Unlike the rope of `chain-length` it grows: links keep their length and mass. So it shows whether
# a model that was trained on one length has learned links, or only that chain.

LINKS = Study(
    "links", "the paper's pendulum, one rod of 0.5 m and 1 kg more with every link", "links", "",
    (1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0), partial(_sized, "pendulum"), least=1,
)  # fmt: skip


_SWING_TILT = (math.pi / 3, math.pi / 3)


def _fast_swing(speed: float) -> Scene:
    scene = load_scene("2pendulum")
    names = tuple(body.name for body in scene.bodies)
    swing = Swing(names, polar=_SWING_TILT, speed=(speed, speed))
    return msgspec.structs.replace(scene, sampling=(swing,))


SWING = Study(
    "swing", "a double pendulum in space, up to ten times as fast as the paper's",
    "speed of each particle relative to its joint", "m/s", (0.0, 2.0, 5.0, 10.0, 20.0), _fast_swing,
)  # fmt: skip


# Pace of the paper's sixfold pendulum: up to ten times its fastest starts.
#
# Directions are those of a medium start; each speed is relative to the joint above, as the paper's
# interval is, so that the last particle is up to six times as fast.


def _fast_links(factor: float) -> Scene:
    scene = load_scene("6pendulum")
    (drawn,) = (draw for draw in scene.sampling if isinstance(draw, Swing))
    speed = factor * span_of(drawn.speed, "high")[1]
    polar = span_of(drawn.polar, "medium")
    swing = msgspec.structs.replace(drawn, polar=polar, speed=(speed, speed))
    return msgspec.structs.replace(scene, sampling=(swing,))


PACE = Study(
    "pace", "the paper's sixfold pendulum, up to ten times as fast as its fastest starts",
    "speed over the fastest of the paper's", "", (0.0, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0), _fast_links,
)  # fmt: skip


# Stiff springs: a pendulum on a spring whose own oscillation is of no interest.
#
# It is fast and small, yet it limits the step. At the rate ω = √(k/m), semi-implicit Euler is
# stable for h ω < 2 and RK4 for h ω < 2.83; the trapezoidal rule and generalised-alpha are stable
# at any step (Hairer & Wanner, Solving ODEs II, IV.2).

_SPRING_LENGTH = 1.0  # unstretched length, which is the spring's at the start [m]
_SPRING_TILT = math.radians(60.0)


def _spring_pendulum(stiffness: float) -> Scene:
    place = (_SPRING_LENGTH * math.sin(_SPRING_TILT), 0.0, -_SPRING_LENGTH * math.cos(_SPRING_TILT))
    bob = Body("bob", particles=(Particle(place),), velocity=(0.0, 0.0, 0.0))
    ends = ((0.0, 0.0, 0.0), place)
    spring = SpringDamper("spring", (WORLD, "bob"), ends, stiffness=stiffness)
    return Scene(name="spring pendulum", bodies=(bob,), springs=(spring,), length=_SPRING_LENGTH)


STIFFNESS = Study(
    "stiffness", "a pendulum of 1 kg on a spring, which itself swings at √k = 10 to 1000 rad/s",
    "stiffness", "N/m", (1e2, 1e3, 1e4, 1e5, 1e6), _spring_pendulum,
)  # fmt: skip


# Spin of a body in free flight, not about a principal axis: it tumbles, without chaos.
#
# The rotation has a step limit of its own: an explicit method gains energy with ω h, as it uses
# the gyroscopic moment of the last step, and an engine may limit the turn per step or the rate.

_DIRECTION = (0.6, 0.3, 0.74161984870956629)  # unit
_ARM = 0.5  # [m]
_MASSES = (0.5, 1.0, 2.0)  # of the particles on x, y and z [kg]


def _spinning(rate: float) -> Scene:
    arms = [(k, sign * _ARM) for k in range(3) for sign in (1.0, -1.0)]
    particles = tuple(
        Particle((arm * (k == 0), arm * (k == 1), arm * (k == 2)), _MASSES[k], 0.0)
        for k, arm in arms
    )
    spin = (_DIRECTION[0] * rate, _DIRECTION[1] * rate, _DIRECTION[2] * rate)
    still = (0.0, 0.0, 0.0)
    jack = Body("jack", particles=particles, velocity=still, angular_velocity=spin)
    return Scene(name="spin", bodies=(jack,), length=2.0 * _ARM, gravity=still)


SPIN = Study(
    "spin", "a free body of three different moments of inertia that tumbles", "spin", "rad/s",
    (1.0, 10.0, 30.0, 100.0, 300.0, 1000.0), _spinning,
)  # fmt: skip


# Bodies that meet the ground, made harder by one value.

_SLOWEST = 0.7
"""Rate of the slowest wheel over the fastest's: rates are unequal, as the paper's are."""


def _fast_car(rate: float) -> Scene:
    scene = load_scene("particlecar")
    wheels = next(draw for draw in scene.sampling if isinstance(draw, HingeRate))
    faster = msgspec.structs.replace(wheels, rate=(_SLOWEST * rate, rate))
    return msgspec.structs.replace(scene, sampling=(faster,))


WHEELS = Study(
    "wheels", "a car whose wheels spin, unequally, up to ten times as fast as the paper's",
    "rate of the fastest wheel", "rad/s", (10.0, 30.0, 100.0, 300.0, 1000.0), _fast_car,
    known=False,
)  # fmt: skip


_NONE = (0.0, 0.0)
_UP = (_NONE, _NONE, (1.0, 1.0))  # [m]


def _ball(throw: Throw, dimension: Literal[2, 3] = 2, ground: Ground | None = None) -> Scene:
    """Make the scene of a ball that starts as thrown, above its usual ground or another."""
    scene = load_scene("ballscroll")
    return msgspec.structs.replace(
        scene, sampling=(throw,), ground=ground or scene.ground, dimension=dimension
    )


def _thrown_ball(speed: float) -> Scene:
    down = (_NONE, _NONE, (-speed, -speed))
    return _ball(Throw("ball", displacement=_UP, velocity=down))


THROW = Study(
    "throw", "a ball thrown down at the ground, up to ten times as fast as the paper's falls",
    "speed", "m/s", (0.0, 5.0, 15.0, 50.0, 80.0, 150.0), _thrown_ball,
)  # fmt: skip


_SPEED = (3.5, 3.5)  # along x and along y [m/s]


def _sliding(friction: float) -> Scene:
    along = (_SPEED, _SPEED, _NONE)
    return _ball(Throw("ball", velocity=along), 3, Ground(friction, 0.0))


FRICTION = Study(
    "friction", "a ball that slides at 45° to the axes until it rolls", "coefficient of friction",
    "", (0.0, 0.1, 0.43, 1.0, 2.0), _sliding,
)  # fmt: skip


def _dropped_ball(restitution: float) -> Scene:
    return _ball(Throw("ball", displacement=_UP), ground=Ground(0.43, restitution))


RESTITUTION = Study(
    "restitution", "a ball dropped from 1 m, for 2 s: up to three impacts",
    "coefficient of restitution", "", (0.0, 0.2, 0.5, 0.8, 0.95, 1.0), _dropped_ball, frames=20,
)  # fmt: skip


# Cranks of equal length on one rod, which all turn alike.

_CRANK = 1.0  # length [m]
_APART = 1.0  # between cranks [m]
_THIN = 1e-3  # inertia of a rod about its own line over that across it
_AXIS = (0.0, -1.0, 0.0)


def _cranks(count: int, angle: float, rate: float) -> Scene:
    """Make the linkage of uniform rods of 1 kg per metre, in the x–z plane.

    Args:
        count: Number of cranks, 2 or more.
        angle: Angle of the cranks above the horizontal [rad].
        rate: Rate at which the angle grows [rad/s].
    """
    reach = (_CRANK * math.cos(angle), 0.0, _CRANK * math.sin(angle))
    speed = (-rate * reach[2], 0.0, rate * reach[0])
    turn = (math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0)
    width = (count - 1) * _APART
    bodies = [
        Body(
            f"crank{k}",
            inertia=_rod(_CRANK),
            position=(_APART * k + 0.5 * reach[0], 0.0, 0.5 * reach[2]),
            orientation=turn,
            velocity=(0.5 * speed[0], 0.0, 0.5 * speed[2]),
            angular_velocity=(0.0, -rate, 0.0),
        )
        for k in range(count)
    ]
    coupler = Body(
        "coupler",
        inertia=_rod(width),
        position=(reach[0] + 0.5 * width, 0.0, reach[2]),
        velocity=speed,
        angular_velocity=(0.0, 0.0, 0.0),
    )
    joints = []
    for k, crank in enumerate(bodies):
        foot, pin = (_APART * k, 0.0, 0.0), (_APART * k + reach[0], 0.0, reach[2])
        joints.append(Joint(f"foot{k}", "hinge", "world", crank.name, foot, _AXIS))
        joints.append(Joint(f"pin{k}", "hinge", crank.name, "coupler", pin, _AXIS))
    return Scene(
        name="cranks", bodies=(*bodies, coupler), joints=tuple(joints), length=_CRANK, dimension=2
    )


def _rod(length: float) -> Inertia:
    moment = length**3 / 12.0
    return Inertia(mass=length, moments=(_THIN * moment, moment, moment))


# Ever more constraints than there are coordinates to constrain.
#
# Hinges also constrain directions in which a planar mechanism cannot move anyway, and every crank
# beyond the second holds a rod that two hold already: with n cranks 4 n − 5 constraints are
# redundant. The multipliers are not unique, but the motion is: that of one pendulum, which turns
# over here. Twice in a turn all rods lie in line, where even more constraints are dependent.

_START = math.radians(-50.0)
_RATE = 7.0  # [rad/s]

REDUNDANCY = Study(
    "redundancy",
    "cranks that turn over with one rod, four redundant constraints more with every crank",
    "cranks", "", (2.0, 3.0, 4.0, 6.0, 8.0), lambda count: _cranks(round(count), _START, _RATE),
    least=2,
)  # fmt: skip


# Through a pose in which a mechanism could go on in two ways.
#
# Where both cranks of a parallelogram lie in line with its rod, their constraints lose rank: from
# there it may move on as a parallelogram or turn into an antiparallelogram, whose cranks turn in
# opposite directions. The rates at the start lead through that pose as a parallelogram.

_SINGULAR_RATE = -2.0  # [rad/s]

SINGULAR = Study(
    "singular", "a parallelogram that starts at, or shortly before, its singular pose",
    "angle before the singular pose", "rad", (1.0, 0.3, 0.02, 1e-3, 1e-6, 0.0),
    partial(_cranks, 2, rate=_SINGULAR_RATE),
)  # fmt: skip


STUDIES: dict[str, Study] = {study.name: study for study in (
    SCENES, MASS_RATIO, CHAIN_LENGTH, LOOPS, REDUNDANCY, SINGULAR, STIFFNESS, SPIN, WHEELS, THROW,
    SWING, PACE, LINKS, FRICTION, RESTITUTION,
)}  # fmt: skip
"""Studies by name, in the order in which they are listed and run."""


def study_named(name: str) -> Study:
    """Find a study, or raise UnknownName."""
    check_name("study", name, STUDIES)
    return STUDIES[name]

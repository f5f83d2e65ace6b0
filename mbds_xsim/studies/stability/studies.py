"""All studies by name; a further one is a `Study` beside these, and a word here."""

from __future__ import annotations

import math
from typing import Literal

import msgspec

from mbds_xsim.base.errors import UnknownName
from mbds_xsim.scene.sampling_terms import HingeRate, Throw
from mbds_xsim.scene.scene import Body, Ground, Inertia, Joint, Scene
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.stability import chains
from mbds_xsim.studies.stability.study import Study

# Bodies that meet the ground, made harder by one value.

_SLOWEST = 0.7
"""Of the fastest wheel's rate: they are unequal, as the paper's are."""


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
    """Make the ball start as thrown, above its usual ground or another."""
    scene = load_scene("ballscroll")
    return msgspec.structs.replace(
        scene, sampling=(throw,), ground=ground or scene.ground, dimension=dimension
    )


def _thrown(speed: float) -> Scene:
    down = (_NONE, _NONE, (-speed, -speed))
    return _ball(Throw("ball", displacement=_UP, velocity=down))


THROW = Study(
    "throw", "a ball thrown down at the ground, up to ten times as fast as the paper's falls",
    "speed", "m/s", (0.0, 5.0, 15.0, 50.0, 80.0, 150.0), _thrown,
)  # fmt: skip


_SPEED = (3.5, 3.5)  # along x and along y [m/s]


def _sliding(friction: float) -> Scene:
    along = (_SPEED, _SPEED, _NONE)
    return _ball(Throw("ball", velocity=along), 3, Ground(friction, 0.0))


FRICTION = Study(
    "friction", "a ball that slides at 45° to the axes until it rolls", "coefficient of friction",
    "", (0.0, 0.1, 0.43, 1.0, 2.0), _sliding,
)  # fmt: skip


def _dropped(restitution: float) -> Scene:
    return _ball(Throw("ball", displacement=_UP), ground=Ground(0.43, restitution))


RESTITUTION = Study(
    "restitution", "a ball dropped from 1 m, for 2 s: up to three impacts",
    "coefficient of restitution", "", (0.0, 0.2, 0.5, 0.8, 0.95, 1.0), _dropped, frames=20,
)  # fmt: skip


# Cranks of equal length on one rod, which all turn alike.

_CRANK = 1.0  # length [m]
_APART = 1.0  # between cranks [m]
_SLIM = 1e-3  # of a rod's inertia about its own line
_AXIS = (0.0, -1.0, 0.0)


def _cranks(count: int, angle: float, rate: float) -> Scene:
    """Make the linkage of uniform rods of 1 kg per metre, in the x–z plane.

    Args:
        count: Cranks, 2 or more.
        angle: Of the cranks above the horizontal [rad].
        rate: At which it grows [rad/s].
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
    joints = [
        joint
        for k in range(count)
        for joint in (
            Joint(f"foot{k}", "hinge", "world", f"crank{k}", (_APART * k, 0.0, 0.0), _AXIS),
            Joint(
                f"pin{k}", "hinge", f"crank{k}", "coupler",
                (_APART * k + reach[0], 0.0, reach[2]), _AXIS,
            ),
        )
    ]  # fmt: skip
    return Scene(
        name="cranks", bodies=(*bodies, coupler), joints=tuple(joints), length=_CRANK, dimension=2
    )


def _rod(length: float) -> Inertia:
    moment = length**3 / 12.0
    return Inertia(mass=length, moments=(_SLIM * moment, moment, moment))


# Ever more constraints than there are coordinates to constrain.
#
# Hinges in a plane constrain what the plane keeps anyway, and every crank beyond the second holds a
# rod that two hold already: with n cranks 4 n − 5 constraints are redundant. The multipliers have
# no unique solution, the motion has: that of one pendulum, which turns over here. Twice in a turn
# all rods lie in line, where still more constraints hang on each other.

_START = math.radians(-50.0)
_RATE = 7.0  # [rad/s]


def _parallel(count: float) -> Scene:
    return _cranks(max(2, round(count)), _START, _RATE)


REDUNDANCY = Study(
    "redundancy",
    "cranks that turn over with one rod, four redundant constraints more with every crank",
    "cranks", "", (2.0, 3.0, 4.0, 6.0, 8.0), _parallel,
)  # fmt: skip


# Through a pose in which a mechanism could go on in two ways.
#
# Where both cranks of a parallelogram lie in line with its rod, their constraints lose rank: from
# there it may move on as a parallelogram or turn into an antiparallelogram, in which the cranks
# turn against each other. The rates at the start lead through that pose as a parallelogram.

_SINGULAR_RATE = -2.0  # [rad/s]


def _parallelogram(angle: float) -> Scene:
    return _cranks(2, angle, _SINGULAR_RATE)


SINGULAR = Study(
    "singular", "a parallelogram that starts at, or shortly before, its singular pose",
    "angle before the singular pose", "rad", (1.0, 0.3, 0.02, 1e-3, 1e-6, 0.0), _parallelogram,
)  # fmt: skip


_ALL = (
    chains.SCENES, chains.MASS_RATIO, chains.CHAIN_LENGTH, chains.LOOPS, REDUNDANCY,
    SINGULAR, chains.STIFFNESS, chains.SPIN, WHEELS, THROW, chains.SWING,
    chains.PACE, chains.LINKS, FRICTION, RESTITUTION,
)  # fmt: skip

STUDIES: dict[str, Study] = {study.name: study for study in _ALL}
"""In the order in which they are listed and run."""


def study_named(name: str) -> Study:
    """Find a study.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in STUDIES:
        raise UnknownName.of("study", name, list(STUDIES))
    return STUDIES[name]

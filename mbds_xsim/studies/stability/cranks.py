"""Cranks of equal length on one rod, which all turn alike."""

from __future__ import annotations

import math

from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.studies.stability.definition import Study

_CRANK = 1.0  # length [m]
_APART = 1.0  # between cranks [m]
_SLIM = 1e-3  # of a rod's inertia about its own line
_AXIS = (0.0, -1.0, 0.0)


def cranks(count: int, angle: float, rate: float) -> Scene:
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
    return cranks(max(2, round(count)), _START, _RATE)


REDUNDANCY = Study(
    name="redundancy",
    sentence="cranks that turn over with one rod, four redundant constraints more with every crank",
    quantity="cranks",
    unit="",
    values=(2.0, 3.0, 4.0, 6.0, 8.0),
    make=_parallel,
)


# Through a pose in which a mechanism could go on in two ways.
#
# Where both cranks of a parallelogram lie in line with its rod, their constraints lose rank: from
# there it may move on as a parallelogram or turn into an antiparallelogram, in which the cranks
# turn against each other. The rates at the start lead through that pose as a parallelogram.

_SINGULAR_RATE = -2.0  # [rad/s]


def _parallelogram(angle: float) -> Scene:
    return cranks(2, angle, _SINGULAR_RATE)


SINGULAR = Study(
    name="singular",
    sentence="a parallelogram that starts at, or shortly before, its singular pose",
    quantity="angle before the singular pose",
    unit="rad",
    values=(1.0, 0.3, 0.02, 1e-3, 1e-6, 0.0),
    make=_parallelogram,
)

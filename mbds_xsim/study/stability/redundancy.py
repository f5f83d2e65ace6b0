"""Ever more constraints than there are coordinates to constrain.

Hinges in a plane constrain what the plane keeps anyway, and every crank beyond the second holds a
rod that two hold already: with n cranks 4 n − 5 constraints are redundant. The multipliers have no
unique solution, the motion has: that of one pendulum, which turns over here. Twice in a turn all
rods lie in line, where still more constraints hang on each other.
"""

import math

from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.cranks import cranks
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_START = math.radians(-50.0)
_RATE = 7.0  # [rad/s]


def _parallel(count: float) -> Scene:
    return cranks(max(2, round(count)), _START, _RATE)


STUDY = Study(
    name="redundancy",
    sentence="cranks that turn over with one rod, four redundant constraints more with every crank",
    quantity="cranks",
    unit="",
    values=(2.0, 3.0, 4.0, 6.0, 8.0),
    make=_parallel,
)

"""Through a pose in which a mechanism could go on in two ways.

Where both cranks of a parallelogram lie in line with its rod, their constraints lose rank: from
there it may move on as a parallelogram or turn into an antiparallelogram, in which the cranks turn
against each other. The rates at the start lead through that pose as a parallelogram.
"""

from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.cranks import cranks
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_RATE = -2.0  # [rad/s]


def _parallelogram(angle: float) -> Scene:
    return cranks(2, angle, _RATE)


STUDY = Study(
    name="singular",
    sentence="a parallelogram that starts at, or shortly before, its singular pose",
    quantity="angle before the singular pose",
    unit="rad",
    values=(1.0, 0.3, 0.02, 1e-3, 1e-6, 0.0),
    make=_parallelogram,
)

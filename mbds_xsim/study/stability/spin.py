"""Spin of a body in free flight, about no axis in particular: it tumbles, without chaos.

The rotation has a step limit of its own: an explicit method makes energy with ω h, as the
gyroscopic moment is that of the last step, and an engine may cut the turn of a step or the rate.
"""

from mbds_xsim.scene import Body, Particle, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

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
    return Scene(
        name="spin",
        bodies=(
            Body("jack", particles=particles, velocity=(0.0, 0.0, 0.0), angular_velocity=spin),
        ),
        length=2.0 * _ARM,
        gravity=(0.0, 0.0, 0.0),
    )


STUDY = Study(
    name="spin",
    sentence="a free body of three different moments of inertia that tumbles",
    quantity="spin",
    unit="rad/s",
    values=(1.0, 10.0, 30.0, 100.0, 300.0, 1000.0),
    make=_spinning,
)

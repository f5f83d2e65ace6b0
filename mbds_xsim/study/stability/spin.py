"""Spin of a body in free flight about its middle axis, where it is unstable.

The rotation's own step limit: energy of an explicit method grows with (ω h), and an engine may cut
the turn of a step or the rate itself.
"""

from mbds_xsim.scene import Body, Particle, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_TIP = 0.01  # of the rate, about the two other axes
_ARM = 0.5  # [m]
_MASSES = (0.5, 1.0, 2.0)  # of the particles on x, y and z [kg]


def _spinning(rate: float) -> Scene:
    arms = [(k, sign * _ARM) for k in range(3) for sign in (1.0, -1.0)]
    particles = tuple(
        Particle((arm * (k == 0), arm * (k == 1), arm * (k == 2)), _MASSES[k], 0.0)
        for k, arm in arms
    )
    spin = (_TIP * rate, rate, _TIP * rate)
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
    sentence="a free body that spins about its middle axis of inertia",
    quantity="spin",
    unit="rad/s",
    values=(1.0, 10.0, 30.0, 100.0, 300.0, 1000.0),
    make=_spinning,
)

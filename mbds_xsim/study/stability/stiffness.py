"""Stiff springs: a pendulum on a spring whose own oscillation is of no interest.

It is fast and small, and limits the step all the same. At the rate ω = √(k/m), semi-implicit Euler
bears h ω < 2 and RK4 h ω < 2.78; the trapezoidal rule and generalised-alpha bear any step (Hairer
& Wanner, Solving ODEs II, IV.2).
"""

import math

from mbds_xsim.scene import WORLD, Body, Particle, Scene, SpringDamper
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_LENGTH = 1.0  # of the spring, unstretched at the start [m]
_TILT = math.radians(60.0)


def _spring_pendulum(stiffness: float) -> Scene:
    place = (_LENGTH * math.sin(_TILT), 0.0, -_LENGTH * math.cos(_TILT))
    bob = Body("bob", particles=(Particle(place),), velocity=(0.0, 0.0, 0.0))
    ends = ((0.0, 0.0, 0.0), place)
    return Scene(
        name="spring pendulum",
        bodies=(bob,),
        springs=(SpringDamper("spring", (WORLD, "bob"), ends, stiffness=stiffness),),
        length=_LENGTH,
    )


STUDY = Study(
    name="stiffness",
    sentence="a pendulum of 1 kg on a spring, which itself swings at √k = 10 to 1000 rad/s",
    quantity="stiffness",
    unit="N/m",
    values=(1e2, 1e3, 1e4, 1e5, 1e6),
    make=_spring_pendulum,
)

"""Ever more links in a rope of one length and one mass.

The shorter the links, the faster the rope swings sideways: 2 √(g n / l) at its top, with n links
of length l. An explicit method's step shrinks with n.
"""

import math

from mbds_xsim.sampling_terms import Turn
from mbds_xsim.scene import Body, Joint, Particle, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_LENGTH = 2.0  # [m]
_MASS = 2.0  # [kg]
_SLIM = 0.01  # inertia of a particle over mass times length² of its link
_TILT = (math.radians(60.0),) * 2


def _rope(links: float) -> Scene:
    count = max(1, round(links))
    rod, mass = _LENGTH / count, _MASS / count
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
        length=_LENGTH,
        sampling=(Turn((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angle=_TILT, rate=(0.0, 0.0)),),
    )


STUDY = Study(
    name="chain-length",
    sentence="a rope of 2 m and 2 kg in ever more links on ball joints",
    quantity="links",
    unit="",
    values=(1.0, 4.0, 16.0, 32.0, 64.0, 128.0),
    make=_rope,
)

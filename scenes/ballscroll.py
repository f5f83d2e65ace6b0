"""A ball on the ground that starts with too little spin: it slides, then rolls."""

from __future__ import annotations

from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.sampling_terms import Levels, Roll, Throw
from mbds_xsim.scene.scene import PARTICLE_RADIUS, Body, ContactSphere, Particle, Scene

from .paper import GROUND, NOISE, SOURCE

_CENTRE = (0.0, 0.0, PARTICLE_RADIUS)
_NONE = (0.0, 0.0)


def ballscroll() -> Scene:
    """Make one particle on the ground, moving along x.

    Without noise its motion is known exactly: from the velocity v and the spin ω it slides for
    t = 2 (v − ω r) / (7 μ g), and then rolls at (5 v + 2 ω r) / 7.
    """
    return Scene(
        name="ballscroll",
        description="one particle that slides along the ground until it rolls",
        source=SOURCE,
        dimension=1,
        bodies=(Body("ball", particles=(Particle(_CENTRE),)),),
        contacts=(ContactSphere("ball", _CENTRE, PARTICLE_RADIUS),),
        ground=GROUND,
        length=1.0,
        noise=NOISE,
        sampling=(
            Throw("ball", velocity=(Levels((1.0, 3.0), (3.0, 7.0), (7.0, 10.0)), _NONE, _NONE)),
            Roll("ball", share=(0.0, 1.0)),
        ),
        budget=Budget(error_1s=2e-3, error=2e-3),
    )

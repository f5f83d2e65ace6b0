"""Chain pendulum: N rods with one particle each, hung from the origin by ball joints."""

from __future__ import annotations

import math

from mbds_xsim.base.text import counted
from mbds_xsim.scene.sampling_terms import Levels, Swing
from mbds_xsim.scene.scene import Body, Joint, Particle, Scene

from .paper import NOISE, SMOOTH_SOURCE

ROD = 0.5
"""Length of a massless rod [m]."""


def pendulum(links: int) -> Scene:
    """Make the chain of `links` rods.

    Each particle is welded to its rod, so its inertia counts; it has no spin about the rod. The
    paper gives particles, gravity and frames; the geometry and the intervals are this project's.
    """
    rods, names = counted(links, "massless rod"), [f"link{k}" for k in range(1, links + 1)]
    bodies = tuple(
        Body(name, particles=(Particle((0.0, 0.0, -ROD * k)),)) for k, name in enumerate(names, 1)
    )
    joints = tuple(
        Joint(f"joint{k}", "ball", parent, name, (0.0, 0.0, -ROD * (k - 1)))
        for k, (parent, name) in enumerate(zip(["world", *names], names, strict=False), 1)
    )
    return Scene(
        name=f"{links}pendulum",
        description=f"{rods} of {ROD} m, each with one particle at its lower end",
        source=SMOOTH_SOURCE,
        bodies=bodies,
        joints=joints,
        length=ROD * links,
        noise=NOISE,
        sampling=(
            Swing(
                bodies=tuple(names),
                polar=Levels((0.0, math.pi / 6), (0.0, math.pi / 2), (0.0, math.pi)),
                speed=Levels((0.0, 0.5), (0.0, 1.0), (0.0, 2.0)),
            ),
        ),
        anchors=((0.0, 0.0, 0.0),),
        edges=((links, 0), *((k, k + 1) for k in range(links - 1))),
    )

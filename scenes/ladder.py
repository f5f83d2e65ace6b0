"""Rope ladder: two ropes hung from two anchors, rungs between their knots, blown by wind."""

from __future__ import annotations

import math

from mbds_xsim.base.text import counted
from mbds_xsim.scene.sampling_terms import Levels, Turn, Wind
from mbds_xsim.scene.scene import Body, Joint, Particle, Scene

from .paper import NOISE, SMOOTH_SOURCE

ROD = 0.1
"""Length of a massless rope rod [m]."""
RODS_PER_RUNG = 6
HALF_WIDTH = 0.3
"""Distance of a rope from the middle [m]."""
RUNG_PARTICLES = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Positions of a rung's particles along y [m]; its massless ends reach the ropes."""
_SIDES = {"left": -HALF_WIDTH, "right": HALF_WIDTH}


def ladder(rungs: int) -> Scene:
    """Make the ladder of `rungs` rungs: 13 bodies, 17 particles and one closed loop per rung.

    The paper gives particles, gravity, frames and the wind's role; the geometry and the intervals
    are this project's.
    """
    rods, steps = RODS_PER_RUNG * rungs, counted(rungs, "rung")
    bodies: list[Body] = []
    joints: list[Joint] = []
    for side, y in _SIDES.items():
        above = "world"
        for k in range(1, rods + 1):
            name = f"{side}{k}"
            bodies.append(Body(name, particles=(Particle((0.0, y, -ROD * k)),)))
            joints.append(Joint(name, "ball", above, name, (0.0, y, -ROD * (k - 1))))
            above = name
    for k in range(1, rungs + 1):
        name, z = f"rung{k}", -ROD * RODS_PER_RUNG * k
        bodies.append(Body(name, particles=tuple(Particle((0.0, y, z)) for y in RUNG_PARTICLES)))
        for side, y in _SIDES.items():
            knot = f"{side}{RODS_PER_RUNG * k}"
            joints.append(Joint(f"{name}_{side}", "ball", knot, name, (0.0, y, z)))
    return Scene(
        name=f"{rungs}ladder",
        description=f"rope ladder of {steps}, {rods} massless rods of {ROD} m a side",
        source=SMOOTH_SOURCE,
        bodies=tuple(bodies),
        joints=tuple(joints),
        length=ROD * rods,
        noise=NOISE,
        sampling=(
            Turn(
                point=(0.0, 0.0, 0.0),
                axis=(0.0, 1.0, 0.0),
                angle=(-math.pi / 9, math.pi / 9),
                rate=(-1.0, 1.0),
            ),
            Wind(mean=Levels((0.0, 0.5), (0.5, 1.5), (1.5, 3.0))),
        ),
        anchors=tuple((0.0, y, 0.0) for y in _SIDES.values()),
        edges=_edges(rungs),
    )


def _edges(rungs: int) -> tuple[tuple[int, int], ...]:
    """Return edges of ropes from their anchors, of rungs, and from rung ends to their knots."""
    rods, across = RODS_PER_RUNG * rungs, len(RUNG_PARTICLES)
    first_rung, particle_count = 2 * rods, 2 * rods + rungs * across
    edges: list[tuple[int, int]] = []
    for side in range(2):
        edges.append((particle_count + side, side * rods))
        edges += [(side * rods + k, side * rods + k + 1) for k in range(rods - 1)]
    for k in range(rungs):
        start, knot = first_rung + k * across, RODS_PER_RUNG * (k + 1) - 1
        edges += [(start + j, start + j + 1) for j in range(across - 1)]
        edges += [(knot, start), (rods + knot, start + across - 1)]
    return tuple(edges)

"""A disc of particles, thrown in the x–z plane: it falls and bounces."""

from __future__ import annotations

import math
from itertools import product

from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.sampling_terms import Levels, Throw
from mbds_xsim.scene.scene import PARTICLE_RADIUS, Body, ContactSphere, Particle, Scene

from .paper import GROUND, NOISE, SOURCE
from .particles import Cell, Point, neighbours

SPACING = 2.0 * PARTICLE_RADIUS
"""Spacing of neighbouring particles, which touch [m]."""
RADIUS = 5.0 * PARTICLE_RADIUS
"""Radius of the contact sphere, which reaches as far as the outermost particles [m]."""
LOWEST, HIGHEST = 1.0, 3.0
"""Range of the centre's height at the start [m]."""
_CENTRE = (0.0, 0.0, LOWEST)
_RINGS = 2
_NONE = (0.0, 0.0)


def balldrop() -> Scene:
    """Make the hexagonal disc of 19 particles with one contact sphere around it."""
    cells = _hexagon()
    return Scene(
        name="balldrop",
        description="a disc of 19 particles, dropped and thrown, that bounces on the ground",
        source=SOURCE,
        dimension=2,
        bodies=(Body("disc", particles=tuple(Particle(_place(cell)) for cell in cells)),),
        contacts=(ContactSphere("disc", _CENTRE, RADIUS),),
        ground=GROUND,
        length=1.0,
        noise=NOISE,
        sampling=(
            Throw(
                "disc",
                displacement=(_NONE, _NONE, (0.0, HIGHEST - LOWEST)),
                orientation="about_y",
                velocity=(Levels((-1.0, 1.0), (-3.0, 3.0), (-6.0, 6.0)), _NONE, _NONE),
                angular_velocity=(_NONE, (-10.0, 10.0), _NONE),
            ),
        ),
        edges=tuple(neighbours(cells, apart=2)),
        budget=Budget(error_1s=2e-2, error=2e-2),
    )


def _hexagon() -> list[Cell]:
    """Return cells of a hexagonal grid, whose coordinates add up to 0, from the middle outwards."""
    reach = range(-_RINGS, _RINGS + 1)
    cells = [(p, q, -p - q) for p, q in product(reach, reach) if abs(p + q) <= _RINGS]
    return sorted(cells, key=lambda cell: max(map(abs, cell)))


def _place(cell: Cell) -> Point:
    p, q, _ = cell
    return (SPACING * (p + 0.5 * q), 0.0, LOWEST + SPACING * math.sqrt(0.75) * q)

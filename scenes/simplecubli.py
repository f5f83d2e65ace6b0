"""A cube with three driven flywheels, thrown: it tumbles through the air and over the ground."""

from __future__ import annotations

from itertools import product

from mbds_xsim.scene.budget import Budget
from mbds_xsim.scene.sampling_terms import HingeRate, HingeTorque, Levels, Throw
from mbds_xsim.scene.scene import PARTICLE_RADIUS, Body, ContactSphere, Joint, Particle, Scene

from .paper import GROUND, NOISE, SOURCE
from .particles import Cell, Point, neighbours, wheel, wheel_edges

SIDE = 0.4
"""Side of the cube through its corner particles [m]."""
OFFSET = 0.12
"""Distance of a flywheel's hub from the middle, along its axis [m]."""
RING = 0.06
"""Radius of the ring of a flywheel's particles [m]."""
LOWEST, HIGHEST = 0.6, 1.5
"""Range of the middle's height at the start [m]."""
_ENDS = (0, 3)  # an edge of the cube has its particles at 0, 1, 2, 3 thirds of the side
_AXES: dict[str, Point] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def simplecubli() -> Scene:
    """Make the cube frame with its flywheels; its eight corners touch the ground."""
    cells = _frame()
    frame = [_place(cell) for cell in cells]
    corners = [_place(cell) for cell in cells if set(cell) <= set(_ENDS)]
    firsts = [*list(_AXES.values())[1:], _AXES["x"]]
    flywheels = tuple(f"flywheel_{axis}" for axis in _AXES)
    parts = list(zip(flywheels, _hubs(), _AXES.values(), firsts, strict=True))
    return Scene(
        name="simplecubli",
        description="a cube frame of 32 particles with three driven flywheels of 13, thrown",
        source=SOURCE,
        bodies=(
            Body("frame", particles=tuple(map(Particle, frame))),
            *(wheel(name, hub, axis, first, RING) for name, hub, axis, first in parts),
        ),
        joints=tuple(
            Joint(name, "hinge", "frame", name, hub, axis) for name, hub, axis, _ in parts
        ),
        contacts=tuple(ContactSphere("frame", corner, PARTICLE_RADIUS) for corner in corners),
        ground=GROUND,
        length=SIDE,
        noise=NOISE,
        sampling=(
            Throw(
                "frame",
                displacement=((0.0, 0.0), (0.0, 0.0), (0.0, HIGHEST - LOWEST)),
                orientation="uniform",
                velocity=((-1.0, 1.0),) * 3,
                angular_velocity=((-2.0, 2.0),) * 3,
            ),
            HingeRate(flywheels, rate=(-10.0, 10.0)),
            HingeTorque(
                flywheels,
                torque=Levels((0.0, 0.5), (0.5, 1.5), (1.5, 3.0)),
                hold=10,
                random_sign=True,
            ),
        ),
        edges=(*neighbours(cells), *wheel_edges(_hubs(), frame)),
        budget=Budget(error=1.25e-3),
    )


def _frame() -> list[Cell]:
    """Return cells along the edges of the cube, in thirds of its side."""
    thirds = range(4)
    cells = product(thirds, thirds, thirds)
    return [(i, j, k) for i, j, k in cells if sum(n in _ENDS for n in (i, j, k)) >= 2]


def _place(cell: Cell) -> Point:
    x, y, z = (SIDE * (n / 3 - 0.5) for n in cell)
    return (x, y, LOWEST + z)


def _hubs() -> list[Point]:
    return [(OFFSET * x, OFFSET * y, LOWEST + OFFSET * z) for x, y, z in _AXES.values()]

"""A car of particles on four driven wheels that start at unequal speeds."""

from __future__ import annotations

from itertools import product

from mbds_xsim.scene.sampling_terms import HingeRate, HingeTorque, Levels
from mbds_xsim.scene.scene import PARTICLE_RADIUS, Body, ContactSphere, Joint, Particle, Scene

from .paper import GROUND, NOISE, SOURCE
from .particles import Edge, Point, neighbours, wheel, wheel_edges

LENGTHS = (-0.4, -0.2, 0.0, 0.2, 0.4)
WIDTHS = (-0.15, 0.15)
HEIGHTS = (0.2, 0.3)
"""Positions of the chassis particles along x, y and z [m]."""
WHEEL = 0.2
"""Radius of a wheel's contact sphere, and height of its hub [m]."""
_HUBS: dict[str, Point] = {
    "front_left": (0.4, 0.25, WHEEL),
    "front_right": (0.4, -0.25, WHEEL),
    "rear_left": (-0.4, 0.25, WHEEL),
    "rear_right": (-0.4, -0.25, WHEEL),
}
_FORWARDS, _AXLE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def particlecar() -> Scene:
    """Make the car, upright on the ground, heading along x: a positive rate rolls forwards.

    It rolls at the speed that suits the mean of the wheels' rates, so all four slip at first.
    """
    wheels = tuple(_HUBS)
    return Scene(
        name="particlecar",
        description="a chassis of 20 particles on four driven wheels of 13, at unequal speeds",
        source=SOURCE,
        bodies=(
            Body("chassis", particles=tuple(map(Particle, _chassis()))),
            *(
                wheel(name, hub, _AXLE, _FORWARDS, WHEEL - PARTICLE_RADIUS)
                for name, hub in _HUBS.items()
            ),
        ),
        joints=tuple(
            Joint(name, "hinge", "chassis", name, hub, axis=_AXLE) for name, hub in _HUBS.items()
        ),
        contacts=tuple(ContactSphere(name, hub, WHEEL) for name, hub in _HUBS.items()),
        ground=GROUND,
        length=0.8,
        noise=NOISE,
        sampling=(
            HingeRate(
                wheels,
                rate=Levels((10.0, 30.0), (30.0, 70.0), (70.0, 100.0)),
                travel=(WHEEL, 0.0, 0.0),
            ),
            HingeTorque(wheels, torque=(-2.0, 2.0), hold=10),
        ),
        edges=_edges(),
    )


def _chassis() -> list[Point]:
    return list(product(LENGTHS, WIDTHS, HEIGHTS))


def _edges() -> tuple[Edge, ...]:
    cells = product(*(range(len(values)) for values in (LENGTHS, WIDTHS, HEIGHTS)))
    grid = neighbours([(i, j, k) for i, j, k in cells])
    return (*grid, *wheel_edges(_HUBS.values(), _chassis()))

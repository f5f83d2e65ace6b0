"""Heavy bodies on light ones: a rung on ropes whose knots weigh 1 kg each.

The load stretches the ropes and so decides how fast they swing sideways: with a tension T, rods
of length l and particles of mass m the fastest rate is 2 √(T / (m l)), 1400 rad/s at a ratio of
1e4. An explicit method's step is limited by it, however still the ropes hang.
"""

import math

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Turn
from mbds_xsim.scene import PARTICLE_INERTIA, Body, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_TILT = (math.radians(20.0),) * 2
_RUNG = "rung1"


def _loaded_ladder(ratio: float) -> Scene:
    scene = load_scene("1ladder")
    bodies = tuple(_loaded(body, ratio) if body.name == _RUNG else body for body in scene.bodies)
    swing = Turn((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angle=_TILT, rate=(1.0, 1.0))
    return msgspec.structs.replace(scene, bodies=bodies, sampling=(swing,))


def _loaded(rung: Body, ratio: float) -> Body:
    share = ratio / len(rung.particles)
    particles = tuple(
        msgspec.structs.replace(p, mass=share, inertia=share * PARTICLE_INERTIA)
        for p in rung.particles
    )
    return msgspec.structs.replace(rung, particles=particles)


STUDY = Study(
    name="mass-ratio",
    sentence="a heavy rung on two ropes of light particles, which close a loop",
    quantity="mass of the rung over that of a neighbour",
    unit="",
    values=(1.0, 10.0, 100.0, 1e3, 1e4),
    make=_loaded_ladder,
)

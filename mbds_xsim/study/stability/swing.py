"""Speed of a swing: a double pendulum that starts up to ten times as fast as the paper's."""

import math

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Swing
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_TILT = (math.pi / 3, math.pi / 3)


def _fast_swing(speed: float) -> Scene:
    scene = load_scene("2pendulum")
    names = tuple(body.name for body in scene.bodies)
    swing = Swing(names, polar=_TILT, speed=(speed, speed))
    return msgspec.structs.replace(scene, sampling=(swing,))


STUDY = Study(
    name="swing",
    sentence="a double pendulum in space, up to ten times as fast as the paper's",
    quantity="speed of each particle relative to its joint",
    unit="m/s",
    values=(0.0, 2.0, 5.0, 10.0, 20.0),
    make=_fast_swing,
)

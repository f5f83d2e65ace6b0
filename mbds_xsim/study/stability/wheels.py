"""Spin of a car's wheels, up to ten times the paper's fastest."""

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import HingeRate
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_SLOWEST = 0.7
"""Of the fastest wheel's rate: they are unequal, as the paper's are."""


def _fast_car(rate: float) -> Scene:
    scene = load_scene("particlecar")
    wheels = next(draw for draw in scene.sampling if isinstance(draw, HingeRate))
    faster = msgspec.structs.replace(wheels, rate=(_SLOWEST * rate, rate))
    return msgspec.structs.replace(scene, sampling=(faster,))


STUDY = Study(
    name="wheels",
    sentence="a car whose wheels spin, unequally, up to ten times as fast as the paper's",
    quantity="rate of the fastest wheel",
    unit="rad/s",
    values=(10.0, 30.0, 100.0, 300.0, 1000.0),
    make=_fast_car,
    known=False,
)

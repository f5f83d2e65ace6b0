"""Friction: a ball that slides at 45° to the axes until it rolls."""

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Throw
from mbds_xsim.scene import Ground, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_SPEED = (3.5, 3.5)  # along x and along y [m/s]


def _sliding(friction: float) -> Scene:
    scene = load_scene("ballscroll")
    return msgspec.structs.replace(
        scene,
        sampling=(Throw("ball", velocity=(_SPEED, _SPEED, (0.0, 0.0))),),
        ground=Ground(friction, 0.0),
        dimension=3,
    )


STUDY = Study(
    name="friction",
    sentence="a ball that slides at 45° to the axes until it rolls",
    quantity="coefficient of friction",
    unit="",
    values=(0.0, 0.1, 0.43, 1.0, 2.0),
    make=_sliding,
)

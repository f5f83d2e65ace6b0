"""Restitution: a ball dropped on the ground, from one that stays there to one that never stops."""

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Throw
from mbds_xsim.scene import Ground, Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_NONE = (0.0, 0.0)
_HEIGHT = (1.0, 1.0)  # [m]


def _dropped(restitution: float) -> Scene:
    scene = load_scene("ballscroll")
    return msgspec.structs.replace(
        scene,
        sampling=(Throw("ball", displacement=(_NONE, _NONE, _HEIGHT)),),
        ground=Ground(0.43, restitution),
        dimension=2,
    )


STUDY = Study(
    name="restitution",
    sentence="a ball dropped from 1 m, for 2 s: up to three impacts",
    quantity="coefficient of restitution",
    unit="",
    values=(0.0, 0.2, 0.5, 0.8, 0.95, 1.0),
    make=_dropped,
    frames=20,
)

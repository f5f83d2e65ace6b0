"""Speed of an impact: a ball thrown at the ground, which it can cross within a step."""

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Throw
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

_HEIGHT = 1.0  # [m]
_NONE = (0.0, 0.0)


def _thrown(speed: float) -> Scene:
    scene = load_scene("ballscroll")
    throw = Throw(
        "ball",
        displacement=(_NONE, _NONE, (_HEIGHT, _HEIGHT)),
        velocity=(_NONE, _NONE, (-speed, -speed)),
    )
    return msgspec.structs.replace(scene, sampling=(throw,), dimension=2)


STUDY = Study(
    name="throw",
    sentence="a ball thrown down at the ground, up to ten times as fast as the paper's falls",
    quantity="speed",
    unit="m/s",
    values=(0.0, 5.0, 15.0, 50.0, 80.0, 150.0),
    make=_thrown,
)

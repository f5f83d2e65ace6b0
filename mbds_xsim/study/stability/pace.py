"""Pace of the paper's sixfold pendulum: up to ten times its fastest starts.

Directions are those of a medium start; each speed is relative to the joint above, as the paper's
interval is, so that the last particle is up to six times as fast.
"""

import msgspec

from mbds_xsim.registry import load_scene
from mbds_xsim.sampling_terms import Swing, span_of
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]


def _paced(factor: float) -> Scene:
    scene = load_scene("6pendulum")
    (drawn,) = (draw for draw in scene.sampling if isinstance(draw, Swing))
    speed = factor * span_of(drawn.speed, "high")[1]
    polar = span_of(drawn.polar, "medium")
    swing = msgspec.structs.replace(drawn, polar=polar, speed=(speed, speed))
    return msgspec.structs.replace(scene, sampling=(swing,))


STUDY = Study(
    name="pace",
    sentence="the paper's sixfold pendulum, up to ten times as fast as its fastest starts",
    quantity="speed over the fastest of the paper's",
    unit="",
    values=(0.0, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0),
    make=_paced,
)

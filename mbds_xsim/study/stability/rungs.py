"""Ever more loops: rope ladders of more rungs in the wind."""

from mbds_xsim.registry import load_scene
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]


def _ladder(rungs: float) -> Scene:
    return load_scene(f"{max(1, round(rungs))}ladder")


STUDY = Study(
    name="loops",
    sentence="rope ladders in the wind, one closed loop more with every rung",
    quantity="rungs",
    unit="",
    values=(1.0, 2.0, 3.0, 5.0, 8.0),
    make=_ladder,
)

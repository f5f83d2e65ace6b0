"""The built-in scenes as they are: which of them bears which step."""

from mbds_xsim.registry import load_scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]

STUDY = Study(
    name="scenes",
    sentence="the paper's scenes and an overconstrained mechanism, at steps up to 50 ms",
    quantity="scene",
    unit="",
    values=(
        "ballscroll", "balldrop", "5pendulum", "6pendulum", "2ladder", "3ladder", "particlecar",
        "simplecubli", "bricard",
    ),
    make=load_scene,
)  # fmt: skip

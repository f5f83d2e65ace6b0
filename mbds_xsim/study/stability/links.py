"""Ever more links of the paper's pendulum, at one of its medium starts.

Unlike the rope of `chain-length` it grows: links keep their length and mass. So it asks of a model
that was trained on one length whether it learned links, or that chain.
"""

from mbds_xsim.registry import load_scene
from mbds_xsim.scene import Scene
from mbds_xsim.study.stability.definition import Study

__all__ = ["STUDY"]


def _chain(links: float) -> Scene:
    return load_scene(f"{max(1, round(links))}pendulum")


STUDY = Study(
    name="links",
    sentence="the paper's pendulum, one rod of 0.5 m and 1 kg more with every link",
    quantity="links",
    unit="",
    values=(1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0),
    make=_chain,
)

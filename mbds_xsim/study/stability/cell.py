"""One cell of a map: a run in a process of its own."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mbds_xsim import registry
from mbds_xsim.engine import Settings
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.stability.verdict import Verdict, judge

__all__ = ["Judged", "run_cell"]


@dataclass(frozen=True)
class Judged:
    """A run's verdict, and what it took."""

    verdict: Verdict
    wall_s: float


def run_cell(
    scene: Scene, batch: Batch, engine: str, settings: Settings, truth: Trajectory | None
) -> Judged:
    """Simulate one start in this process and judge it.

    Raises:
        InputError: The engine cannot do the scene or the settings are not allowed.
    """
    adapter = registry.load_adapter(engine)
    with adapter.open(scene, settings) as run:
        begin = time.perf_counter()
        trajectory = run.rollout(batch)
        wall = time.perf_counter() - begin
    method = adapter.methods[settings.method]
    return Judged(judge(scene, batch, trajectory, truth, method, settings.step), wall)

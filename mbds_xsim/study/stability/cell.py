"""The cells of one row of a map: one scene, one method, several steps."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from mbds_xsim import isolate, registry
from mbds_xsim.engine import Settings
from mbds_xsim.scene import Scene
from mbds_xsim.simulate import recorded
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.stability.verdict import Verdict, judge

__all__ = ["Judged", "run_cell", "run_cells"]


@dataclass(frozen=True)
class Judged:
    """A run's verdict, and what it took."""

    verdict: Verdict
    wall_s: float


def run_cells(
    scene: Scene,
    batch: Batch,
    engine: str,
    settings: Sequence[Settings],
    truth: Trajectory | None,
    patience: float,
) -> list[Judged]:
    """Run cells one after the other in this process, as many as are begun within a time [s].

    It is that of the processor, and begins when the engine is there.

    Raises:
        InputError: The engine cannot do the scene or some settings are not allowed.
    """
    registry.load_adapter(engine)
    isolate.begin()
    begin = time.process_time()
    done: list[Judged] = []
    for one in settings:
        if done and time.process_time() - begin > patience:
            break
        done.append(run_cell(scene, batch, engine, one, truth))
    return done


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
        trajectory = recorded(run, batch)
        wall = time.perf_counter() - begin
    method = adapter.methods[settings.method]
    return Judged(judge(scene, batch, trajectory, truth, method, settings.step), wall)

"""The one stopwatch around a rollout."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mbds_xsim.engine import ModelSize, Readback, Settings
from mbds_xsim.registry import load_adapter
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory

__all__ = ["Simulation", "simulate"]


@dataclass(frozen=True, eq=False)
class Simulation:
    """What an engine made of a batch, and how long it took."""

    engine: str
    version: str
    settings: Settings
    trajectory: Trajectory
    readback: Readback
    size: ModelSize
    setup_s: float
    """Loading the model [s]."""
    rollout_s: float
    """Simulating the whole batch [s]."""
    cpu_s: float
    """Processor time of that [s]."""


def simulate(scene: Scene, batch: Batch, engine: str, settings: Settings) -> Simulation:
    """Run a batch in this process.

    Raises:
        Unsupported: The engine cannot represent the scene.
        EngineMissing: The engine is not installed.
    """
    adapter = load_adapter(engine)
    begin = time.perf_counter()
    with adapter.open(scene, settings) as run:
        loaded = time.perf_counter()
        readback = run.readback(batch)
        start, spent = time.perf_counter(), time.process_time()
        trajectory = run.rollout(batch)
        end, spent = time.perf_counter(), time.process_time() - spent
        _check_shape(engine, trajectory, batch)
        return Simulation(
            engine=engine,
            version=adapter.version(),
            settings=settings,
            trajectory=trajectory,
            readback=readback,
            size=run.size,
            setup_s=loaded - begin,
            rollout_s=end - start,
            cpu_s=spent,
        )


def _check_shape(engine: str, trajectory: Trajectory, batch: Batch) -> None:
    """Refuse what would not fit beside the other engines' trajectories."""
    expected = (len(batch), batch.steps + 1, *batch.position.shape[1:])
    if trajectory.position.shape != expected:
        msg = f"{engine} gave positions of shape {trajectory.position.shape}, not {expected}"
        raise ValueError(msg)

"""The one stopwatch around a rollout."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from mbds_xsim import isolate, rotation
from mbds_xsim.engine import ModelSize, Readback, Run, Settings
from mbds_xsim.registry import load_adapter
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory

__all__ = ["Simulation", "recorded", "simulate"]


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
    isolate.begin()
    begin = time.perf_counter()
    with adapter.open(scene, settings) as run:
        loaded = time.perf_counter()
        readback = run.readback(batch)
        start, spent = time.perf_counter(), time.process_time()
        trajectory = recorded(run, batch)
        end, spent = time.perf_counter(), time.process_time() - spent
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


def recorded(run: Run, batch: Batch) -> Trajectory:
    """Run a batch, and hold what comes back against what a `Run` promises.

    Frames from a failure on are NaN, whatever an adapter left in them; signs of quaternions go on
    from the start's, whichever an engine gives.

    Raises:
        ValueError: An array has another shape or type than it must, or failures are not told.
    """
    trajectory = run.rollout(batch)
    rows = (len(batch), batch.steps + 1, batch.position.shape[1])
    shapes = {
        "time": rows[1:2],
        "position": (*rows, 3),
        "orientation": (*rows, 4),
        "velocity": (*rows, 3),
        "angular_velocity": (*rows, 3),
    }
    for name, shape in shapes.items():
        given = getattr(trajectory, name, None)
        if not isinstance(given, np.ndarray) or given.dtype != float or given.shape != shape:
            got = f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else type(given)
            msg = f"the adapter gave {name} as {got}, not as float64 {shape}"
            raise ValueError(msg)
    told = trajectory.failures
    if len(told) != len(batch) or not all(one is None or isinstance(one, Failure) for one in told):
        msg = f"the adapter gave failures {told!r:.80}, not a Failure or None for each trajectory"
        raise ValueError(msg)
    whole = trajectory.cut_at_failures()
    turned = rotation.continuous(whole.orientation, batch.orientation)
    return dataclasses.replace(whole, orientation=turned)

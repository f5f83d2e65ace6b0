"""The one stopwatch around a rollout."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mbds_xsim.base import isolate, rotation
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Readback, Run, Settings
from mbds_xsim.simulate.registry import load_adapter

Made = TypeVar("Made")
Seconds = tuple[float, ...]

WARM_UP = 2
"""Frames before those that are timed."""
_ENOUGH = 0.2  # of timing [s]
_MOST_REPEATS = 7


_TURNS_AND_RATES = (("orientation", 4), ("velocity", 3), ("angular_velocity", 3))
"""Of states of bodies: names, and numbers of each body."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """What an engine made of a batch, and how long it took."""

    engine: str
    version: str
    settings: Settings
    trajectory: Trajectory
    readback: Readback
    size: ModelSize
    contact_time: float
    """Over which the engine spreads an impact [s]."""
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
        readback = _read_back(run, batch)
        trajectory, (wall,), (cpu,) = stopwatch(
            lambda: checked(run.rollout(batch), batch), often=False
        )
        return Simulation(
            engine=engine,
            version=adapter.version(),
            settings=settings,
            trajectory=trajectory,
            readback=readback,
            size=_size(run),
            contact_time=adapter.contact_scales(settings).time,
            setup_s=loaded - begin,
            rollout_s=wall,
            cpu_s=cpu,
        )


def stopwatch(work: Callable[[], Made], *, often: bool) -> tuple[Made, Seconds, Seconds]:
    """Give what work made last, and its wall and processor times [s], one entry a repeat.

    Args:
        work: What is timed.
        often: Whether short work is repeated, as one look at a clock says little of it.
    """
    walls: list[float] = []
    cpus: list[float] = []
    while not walls or (often and sum(walls) < _ENOUGH and len(walls) < _MOST_REPEATS):
        wall, cpu = time.perf_counter(), time.process_time()
        made = work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return made, tuple(walls), tuple(cpus)


def checked(trajectory: Trajectory, batch: Batch) -> Trajectory:
    """Hold what a rollout gave against what a `Run` promises.

    Frames from a failure on are NaN, whatever an adapter left in them; signs of quaternions go on
    from the start's, whichever an engine gives.

    Raises:
        ValueError: An array has another shape or type than it must, or failures are none.
    """
    rows = (len(batch), batch.steps + 1, batch.position.shape[1])
    _check_array("gave", trajectory, "time", rows[1:2])
    for name, size in (("position", 3), *_TURNS_AND_RATES):
        _check_array("gave", trajectory, name, (*rows, size))
    ends: object = trajectory.failures
    sound = isinstance(ends, tuple) and all(isinstance(end, Failure | None) for end in ends)
    if not sound or len(trajectory.failures) != len(batch):
        msg = f"the adapter gave failures {ends!r:.80}, not a Failure or None for each trajectory"
        raise ValueError(msg)
    whole = trajectory.cut_at_failures()
    turned = rotation.continuous(whole.orientation, batch.orientation)
    return dataclasses.replace(whole, orientation=turned)


def _read_back(run: Run, batch: Batch) -> Readback:
    """Read the native model back, and hold it against what a `Readback` is."""
    found: object = run.readback(batch)
    if not isinstance(found, Readback) or not isinstance(found.step, float | None):
        raise TypeError(f"the adapter read back {found!r:.60}, not a Readback with a step or None")
    bodies = batch.position.shape[1]
    shapes = {"mass": (bodies,), "inertia": (bodies, 3, 3), "com": (bodies, 3)}
    shapes |= {name: (bodies, size) for name, size in _TURNS_AND_RATES}
    for name in {field.name for field in dataclasses.fields(found)} - {"step"}:
        if name in shapes or getattr(found, name) is not None:
            _check_array("read back", found, name, shapes.get(name))
    return found


def _check_array(did: str, source: object, name: str, shape: tuple[int, ...] | None) -> None:
    """Raise ValueError unless it has an array of that name, type and shape; None: any shape."""
    given = getattr(source, name, None)
    array = given if isinstance(given, np.ndarray) else None
    if array is None or array.dtype != float or shape not in (None, array.shape):
        got = type(given) if array is None else f"{array.dtype} {array.shape}"
        msg = f"the adapter {did} {name} as {got}, not as float64 {shape or ''}"
        raise ValueError(msg)


def _size(run: Run) -> ModelSize:
    size: object = run.size
    if not isinstance(size, ModelSize):
        msg = f"the adapter gave its size as {size!r:.60}, not as a ModelSize"
        raise TypeError(msg)
    return size

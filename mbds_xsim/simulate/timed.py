"""The one stopwatch around a rollout, and forewarnings of work that will take long."""

from __future__ import annotations

import dataclasses
import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import msgspec
import numpy as np

from mbds_xsim.base import isolate, rotation
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.text import in_utf8
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Readback, Run, Settings
from mbds_xsim.simulate.registry import load_adapter

Made = TypeVar("Made")
Seconds = tuple[float, ...]

WARM_UP = 2
"""Number of frames before those that are timed."""
_ENOUGH = 0.2  # total time after which no repeat is needed [s]
_MOST_REPEATS = 7

_TURNS_AND_RATES = (("orientation", 4), ("velocity", 3), ("angular_velocity", 3))
"""Fields of body states other than the position, with their numbers per body."""
_LONG = 120.0
"""Longest run that is not announced [s]."""
_EACH = 2e-4
"""Upper bound on the time of a step per body in any engine [s]; the slowest measured is Exudyn in
`particlecar` with 1.4e-4. Work that is short by this bound is not measured beforehand."""
_STEPS = 50
_SAME_TIME = 1e-9  # largest difference of a frame's time from its own, relative to it
_PATIENCE = 20.0  # time limit for those steps [s]


@dataclass(frozen=True, eq=False)
class Simulation:
    """Motion that an engine made from a batch, and its times."""

    trajectory: Trajectory
    readback: Readback
    size: ModelSize
    contact_time: float
    """Duration of an impact in the engine [s]."""
    setup_s: float
    """Time to load the model [s]."""
    rollout_s: float
    """Wall time to simulate the whole batch [s]."""
    cpu_s: float
    """Processor time to simulate the whole batch [s]."""

    @property
    def busy_s(self) -> float:
        """Total time of the engine [s]."""
        return self.setup_s + self.rollout_s


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
            lambda: checked(run.rollout(batch), batch, scene.clock.frame), often=False
        )
        return Simulation(
            trajectory=trajectory,
            readback=readback,
            size=size_of(run),
            contact_time=adapter.contact_scales(settings).time,
            setup_s=loaded - begin,
            rollout_s=wall,
            cpu_s=cpu,
        )


def stopwatch(work: Callable[[], Made], *, often: bool) -> tuple[Made, Seconds, Seconds]:
    """Return the last result of `work`, and its wall and processor times [s] per repeat.

    Args:
        work: Function to time.
        often: Whether short work is repeated, since a single timing of it is unreliable.
    """
    walls: list[float] = []
    cpus: list[float] = []
    while not walls or (often and sum(walls) < _ENOUGH and len(walls) < _MOST_REPEATS):
        wall, cpu = time.perf_counter(), time.process_time()
        result = work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return result, tuple(walls), tuple(cpus)


def checked(trajectory: Trajectory, batch: Batch, frame: float) -> Trajectory:
    """Check a rollout's trajectory against the contract of `Run`, and return it in standard form.

    Frames from a failure on become NaN, whatever an adapter left in them; its reason is one line.
    Signs of quaternions are continuous from the start, whichever an engine gives.

    Args:
        trajectory: The trajectory.
        batch: The batch that was simulated.
        frame: Frame interval of the scene [s].

    Raises:
        ValueError: An array has the wrong shape or type, a frame has another time than its own, or
            the failures are invalid.
    """
    rows = (len(batch), batch.steps + 1, batch.position.shape[1])
    _check_array("gave", trajectory, "time", rows[1:2])
    for name, size in (("position", 3), *_TURNS_AND_RATES):
        _check_array("gave", trajectory, name, (*rows, size))
    due = frame * np.arange(batch.steps + 1.0)
    late = ~np.isclose(trajectory.time, due, rtol=_SAME_TIME, atol=_SAME_TIME * frame)
    if late.any():
        k = int(late.argmax())
        got = trajectory.time[k]
        msg = f"the adapter gave frame {k} the time {got:.12g} s, not {due[k]:.12g} s"
        raise ValueError(msg)
    ends: object = trajectory.failures
    sound = isinstance(ends, tuple) and all(end is None or _says_when(end) for end in ends)
    if not sound or len(trajectory.failures) != len(batch):
        msg = f"the adapter gave failures {ends!r:.80}, not a Failure or None for each trajectory"
        raise ValueError(msg)
    whole = trajectory.cut_at_failures()
    orientation = rotation.continuous(whole.orientation, batch.orientation)
    failures = tuple(
        end and dataclasses.replace(end, reason=in_utf8(" ".join(end.reason.split())))
        for end in whole.failures
    )
    return dataclasses.replace(whole, orientation=orientation, failures=failures)


def _says_when(end: object) -> bool:
    if not (isinstance(end, Failure) and isinstance(end.reason, str)):
        return False
    return isinstance(end.frame, int | np.integer) and end.frame >= 0


def _read_back(run: Run, batch: Batch) -> Readback:
    """Read the native model back, and check types and shapes of the `Readback`."""
    model: object = run.readback(batch)
    if not isinstance(model, Readback) or not isinstance(model.step, float | None):
        raise TypeError(f"the adapter read back {model!r:.60}, not a Readback with a step or None")
    bodies = batch.position.shape[1]
    shapes = {"mass": (bodies,), "inertia": (bodies, 3, 3), "com": (bodies, 3)}
    shapes |= {name: (bodies, size) for name, size in _TURNS_AND_RATES}
    for name in {field.name for field in dataclasses.fields(model)} - {"step"}:
        if name in shapes or getattr(model, name) is not None:
            _check_array("read back", model, name, shapes.get(name))
    return model


def _check_array(verb: str, source: object, name: str, shape: tuple[int, ...] | None) -> None:
    """Raise ValueError unless `source` has a float array of that name and shape (None: any)."""
    value = getattr(source, name, None)
    array = value if isinstance(value, np.ndarray) else None
    if array is None or array.dtype != float or shape not in (None, array.shape):
        got = type(value) if array is None else f"{array.dtype} {array.shape}"
        raise ValueError(f"the adapter {verb} {name} as {got}, not as float64 {shape or ''}")


def size_of(run: Run) -> ModelSize:
    """Return the size of a run's native model in Python's own whole numbers.

    Raises:
        TypeError: It is no `ModelSize` of whole numbers.
    """
    size: object = run.size
    if not isinstance(size, ModelSize):
        raise TypeError(f"the adapter gave its size as {size!r:.60}, not as a ModelSize")
    return ModelSize(*map(operator.index, dataclasses.astuple(size)))


@dataclass(frozen=True)
class Work:
    """All runs of an engine at some settings."""

    name: str
    engine: str
    settings: Settings
    steps: float
    """Total steps of all trajectories and runs, in steps of the settings' length."""


def forewarnings(
    scene: Scene, start: Batch, work: Sequence[Work], *, workers: int | None
) -> list[str]:
    """Measure work that may be long, and return a line for each piece that takes minutes.

    Args:
        scene: Scene to simulate.
        start: A batch of one.
        work: Work to be done.
        workers: Number of parallel processes; all cores if None.
    """
    doubtful = [item for item in work if item.steps * len(scene.bodies) * _EACH > _LONG]
    tasks = [
        Task(_seconds_a_step, (scene, start, item.engine, item.settings), _PATIENCE)
        for item in doubtful
    ]
    answers = zip(doubtful, run_tasks(tasks, workers=workers), strict=True)
    return [line for item, answer in answers if (line := _line(scene, item, answer))]


def _seconds_a_step(scene: Scene, start: Batch, engine: str, settings: Settings) -> float:
    """Measure the time of a step [s] over a few steps, independent of the scene's frame."""
    clock = Clock(frame=_STEPS * settings.step, steps=1)
    adapter = load_adapter(engine)
    isolate.begin()
    with adapter.open(msgspec.structs.replace(scene, clock=clock), settings) as run:
        run.rollout(start.truncated(1))
        begin = time.process_time()
        run.rollout(start.truncated(1))
        return (time.process_time() - begin) / _STEPS


def _line(scene: Scene, work: Work, seconds: float | Crash) -> str:
    """Announce long work; the run itself reports crashes and refusals."""
    if isinstance(seconds, Crash):
        if not seconds.timed_out:
            return ""
        duration = f"at least {_duration(work.steps * _PATIENCE / (2 * _STEPS))}"
    elif work.steps * seconds > _LONG:
        duration = f"about {_duration(work.steps * seconds)}"
    else:
        return ""
    return (
        f"{work.name} on {scene.name}: {work.steps:.2g} steps of {work.settings.step:.3g} s, "
        f"{duration} of processor time"
    )


def _duration(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"

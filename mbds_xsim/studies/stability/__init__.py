"""What a stability study is, and what it records: a cell a setting, the map made of the cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec

from mbds_xsim.base.errors import InputError, check_name
from mbds_xsim.measure.runner import Keyed
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.simulator import LEARNED, Options

Value = float | str

FRAME = 0.1
"""Between recorded frames [s]."""
COUNTS = (2, 5, 10, 20, 50, 100)
"""Steps a frame that are tried: 50 ms to 1 ms."""
MOST = 1000
"""Bodies, links or rungs that a scene is made of: more would take its memory."""


@dataclass(frozen=True)
class Study:
    """One way of making a scene harder."""

    name: str
    sentence: str
    """What it is about, in one line."""
    quantity: str
    """What is swept."""
    unit: str
    """Of the values; empty where they have none, or are names."""
    values: tuple[Value, ...]
    """From harmless to harsh; numbers, or names."""
    make: Callable[[Any], Scene]
    """The scene at a value; its clock is set by `scene`."""
    frames: int = 10
    """Of `FRAME` seconds."""
    start: int = 1
    """Index of the trajectory, which decides its interval."""
    known: bool = True
    """Whether the reference solution is cheap, so that wrong motion can be told."""
    least: int = 0
    """The fewest, where values are counts of something; 0: they are no counts."""

    @property
    def clock(self) -> Clock:
        """Frames at which engines are recorded."""
        return Clock(FRAME, self.frames)

    def scene(self, value: Value, clock: Clock | None = None) -> Scene:
        """Make the scene of a value, with a clock of its own or another one."""
        return msgspec.structs.replace(self.make(value), clock=clock or self.clock, noise=0.0)

    def batch(self, scene: Scene) -> Batch:
        """Draw the one start that is simulated."""
        return draw_batch(scene, [self.start], seed=0)

    def parse(self, text: str) -> Value:
        """Read a value from a user's words.

        Raises:
            InputError: It is neither a number of allowed size nor one of the names.
        """
        names = [value for value in self.values if isinstance(value, str)]
        if names:
            check_name(f"value of {self.name}", text, names)
            return text
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        allowed = f"a whole number from {self.least} to {MOST}" if self.least else "a number from 0"
        counts = value.is_integer() and self.least <= value <= MOST
        if not (counts if self.least else 0.0 <= value < float("inf")):
            msg = f"--value: got {text!r}, allowed is {allowed} as {self.quantity}"
            raise InputError(msg)
        return value


def text_of(value: Value, unit: str = "") -> str:
    """Write a value as people read it."""
    if isinstance(value, str):
        return value
    return f"{value:g} {unit}".rstrip()


SCHEMA = "mbds-xsim/stability/1"

Outcome = Literal[
    "stable", "off course", "gains energy", "loses energy", "comes apart", "sinks in", "stuck",
    "clamped", "blows up", "gives up", "ends early", "crashed", "timed out", "refused",
]  # fmt: skip
"""What became of a run, or what broke first in it; `verdict` defines them."""
FAILED = frozenset(get_args(Outcome)) - {"stable", "off course", "timed out", "refused"}
"""Outcomes that are not stable. A motion that is off course is stable, and wrong; what ran out of
its time is neither stable nor not: it is not measured."""
Told = Literal["engine", "adapter", "process", "nobody"]
"""Who said that something was wrong: the engine by a warning or an error; only this project's
adapter, which watches the states; the process, which died or did not end; or nobody, so that only
the checks saw it."""


class MapCell(Keyed, frozen=True, kw_only=True):
    """One run: an engine's method at one value and one step."""

    study: str
    value: float | str
    engine: str
    """Of a trained model its name, as `gns`."""
    version: str
    """Of a trained model that of torch."""
    method: str
    """Of a trained model what it was trained on, and its seed."""
    family: str
    profile: str
    """matched or native; of a trained model that of its data, which may be a file's name."""
    options: Options
    step_s: float
    """Of a trained model its frame."""
    duration_s: float
    """That was to be simulated."""
    limit_s: float
    """Time that the run was given: the processor's, and the clock's while it slept."""
    machine: str
    outcome: Outcome
    told: Told
    reason: str = ""
    """In whose words: the engine's, the adapter's or the process's; empty where nobody said
    anything."""
    broke_s: float | None = None
    """Simulated time of the first frame at which something was wrong."""
    ended_s: float | None = None
    """Simulated time of the last frame with numbers."""
    energy: float | None = None
    """Largest deviation of the energy balance over the scale, with its sign; with contact the
    largest unexplained rise."""
    gap: float | None = None
    """Largest gap of a joint over the scene's length, or angle between its axes [rad]."""
    sunk: float | None = None
    """Deepest overlap of a contact sphere with what it touches, over the scene's length."""
    way: float | None = None
    """Way of the particles over that of the reference."""
    error: float | None = None
    """Largest RMS particle error over the scene's length."""
    wall_s: float | None = None
    """Of the rollout, in that process."""
    source: str = ""
    """File of a trained model."""

    @property
    def failed(self) -> bool:
        """Whether the run is not stable."""
        return self.outcome in FAILED

    @property
    def unmeasured(self) -> bool:
        """Whether the run was not waited for, so that nothing is known of it."""
        return self.outcome == "timed out"

    @property
    def silent(self) -> bool:
        """Whether it went wrong and the engine did not say so."""
        wrong = self.failed or self.outcome == "off course"
        return wrong and self.told in ("adapter", "nobody")


class Panel(msgspec.Struct, frozen=True, kw_only=True):
    """The map of one engine's method: rows by value, columns by step, the longest first."""

    engine: str
    version: str
    method: str
    family: str
    profile: str
    cells: tuple[tuple[MapCell, ...], ...]

    @property
    def steps_s(self) -> tuple[float, ...]:
        """Steps of the columns [s]."""
        return tuple(cell.step_s for cell in self.cells[0])

    @property
    def learned(self) -> bool:
        """Whether it is a trained model's: it has one step, its frame."""
        return self.family == LEARNED

    @property
    def name(self) -> str:
        """Engine, method and profile."""
        words = (self.engine, self.method, "" if self.profile == "matched" else self.profile)
        return " ".join(filter(None, words))

    def largest_stable(self, row: int) -> float | None:
        """Longest step at which this and all shorter ones are stable, of those measured [s]."""
        return _longest(self.cells[row], frozenset({"stable", "off course"}))

    def largest_on_course(self, row: int) -> float | None:
        """Longest step at which this and all shorter ones measured are stable and on course [s]."""
        return _longest(self.cells[row], frozenset({"stable"}))


def _longest(cells: tuple[MapCell, ...], good: frozenset[str]) -> float | None:
    longest = None
    for cell in reversed(cells):
        if cell.unmeasured:
            continue
        if cell.outcome not in good:
            break
        longest = cell.step_s
    return longest


class Survey(msgspec.Struct, frozen=True, kw_only=True):
    """A study carried out."""

    schema: str
    study: str
    sentence: str
    quantity: str
    unit: str
    values: tuple[float | str, ...]
    steps_s: tuple[float, ...]
    duration_s: float
    criteria: str
    panels: tuple[Panel, ...]
    left_out: dict[str, str]
    """Methods that cannot do the scene, each with the reason."""
    unknown: dict[str, str]
    """Values without a reference solution, each with the reason: being off course or stuck cannot
    be told there."""
    command: str
    versions: dict[str, str]
    machine: str
    workers: int
    measured: int
    kept: int
    wall_s: float

    @property
    def cells(self) -> list[MapCell]:
        """All cells, panel by panel."""
        return [cell for panel in self.panels for row in panel.cells for cell in row]

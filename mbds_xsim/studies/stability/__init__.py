"""Stability studies: their definition, and their results as maps of one cell per setting."""

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
"""Time between recorded frames [s]."""
COUNTS = (2, 5, 10, 20, 50, 100)
"""Numbers of steps per frame that are tried: steps of 50 ms to 1 ms."""
_MEDIUM = 1
"""Index of the only trajectory, which is of the medium interval."""
MOST = 1000
"""Largest number of bodies, links or rungs in a scene: more would exhaust the memory."""


@dataclass(frozen=True)
class Study:
    """One way of making a scene harder."""

    name: str
    sentence: str
    """Subject of the study, in one line."""
    quantity: str
    """Quantity that is swept."""
    unit: str
    """Unit of the values; empty if they have none or are names."""
    values: tuple[Value, ...]
    """Numbers or names, from harmless to harsh."""
    make: Callable[[Any], Scene]
    """Function that makes the scene at a value; `scene` sets its clock."""
    frames: int = 10
    """Number of recorded frames, `FRAME` seconds apart."""
    known: bool = True
    """Whether the reference solution is cheap, so that wrong motion can be detected."""
    least: int = 0
    """Smallest allowed value if values are counts; 0 if they are not counts."""

    @property
    def clock(self) -> Clock:
        """Frames at which engines are recorded."""
        return Clock(FRAME, self.frames)

    def scene(self, value: Value, clock: Clock | None = None) -> Scene:
        """Make the scene at a value, with the study's clock unless another one is given."""
        return msgspec.structs.replace(self.make(value), clock=clock or self.clock, noise=0.0)

    def batch(self, scene: Scene) -> Batch:
        """Draw the only start that is simulated."""
        return draw_batch(scene, [_MEDIUM], seed=0)

    def parse(self, text: str) -> Value:
        """Parse a value that a user typed.

        Raises:
            InputError: The text is neither a number of allowed size nor one of the names.
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
            raise InputError(f"--value: got {text!r}, allowed is {allowed} as {self.quantity}")
        return value


def text_of(value: Value, unit: str = "") -> str:
    """Write a value for people to read."""
    if isinstance(value, str):
        return value
    return f"{value:g} {unit}".rstrip()


SCHEMA = "mbds-xsim/stability/1"

Outcome = Literal[
    "stable", "off course", "gains energy", "loses energy", "comes apart", "sinks in", "stuck",
    "clamped", "blows up", "gives up", "ends early", "crashed", "timed out", "refused",
]  # fmt: skip
"""Outcome of a run, or the first thing that broke in it; `verdict` defines each."""
FAILED = frozenset(get_args(Outcome)) - {"stable", "off course", "timed out", "refused"}
"""Outcomes that are not stable. A motion that is off course is stable but wrong; a run that timed
out is not measured, so neither stable nor unstable."""
Reporter = Literal["engine", "adapter", "process", "nobody"]
"""Who reported the failure: the engine, by a warning or an error; only this project's adapter,
which watches the states; the process, which died or did not end; or nobody, so that only the checks
detected it."""


class MapCell(Keyed, frozen=True, kw_only=True):
    """One run: an engine's method at one value and one step."""

    study: str
    value: float | str
    engine: str
    """Name of the engine, or of the trained model, such as `gns`."""
    version: str
    """Version of the engine; of torch for a trained model."""
    method: str
    """Method of the engine; training data and seed for a trained model."""
    family: str
    profile: str
    """Matched or native; for a trained model the variant of its data, maybe a file's name."""
    options: Options
    step_s: float
    """Integration step [s]; the time between frames for a trained model."""
    duration_s: float
    """Time to simulate [s]."""
    limit_s: float
    """Time limit of the run [s]: processor time, and wall-clock time while it sleeps."""
    machine: str
    outcome: Outcome
    told: Reporter
    reason: str = ""
    """Message of the engine, the adapter or the process; empty if nobody reported anything."""
    broke_s: float | None = None
    """Simulated time of the first frame at which something was wrong [s]."""
    ended_s: float | None = None
    """Simulated time of the last frame with finite numbers [s]."""
    energy: float | None = None
    """Largest deviation of the energy balance over the energy scale, with its sign; with contact,
    the largest unexplained rise."""
    gap: float | None = None
    """Largest gap of a joint over the scene's length, or angle between its axes [rad]."""
    sunk: float | None = None
    """Deepest overlap of a contact sphere with what it touches, over the scene's length."""
    way: float | None = None
    """Path length of the particles over the reference's, at the end."""
    error: float | None = None
    """Largest RMS particle error over the scene's length."""
    wall_s: float | None = None
    """Wall time of the rollout, in its own process [s]."""
    source: str = ""
    """File of a trained model; empty for engines."""

    @property
    def failed(self) -> bool:
        """Whether the run is not stable."""
        return self.outcome in FAILED

    @property
    def unmeasured(self) -> bool:
        """Whether the run ran out of time, so that nothing is known about it."""
        return self.outcome == "timed out"

    @property
    def silent(self) -> bool:
        """Whether the run went wrong, and neither the engine nor its process reported it."""
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
        """Whether the panel is a trained model's, whose only step is its frame."""
        return self.family == LEARNED

    @property
    def name(self) -> str:
        """Engine, method, and profile unless it is matched."""
        words = (self.engine, self.method, "" if self.profile == "matched" else self.profile)
        return " ".join(filter(None, words))

    def largest_stable(self, row: int) -> float | None:
        """Return the longest step such that it and all shorter ones measured are stable [s]."""
        return _longest(self.cells[row], frozenset({"stable", "off course"}))

    def largest_on_course(self, row: int) -> float | None:
        """Return the longest step such that it and all shorter ones measured stay on course [s]."""
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
    """Results of a study."""

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
    """Engines and methods that were left out, each with the reason."""
    unknown: dict[str, str]
    """Values without a reference solution, each with the reason; off course and stuck cannot be
    detected there."""
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

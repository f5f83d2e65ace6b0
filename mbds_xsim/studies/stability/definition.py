"""What a study is, a scene as a function of one value, and the runs that it comes to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Scene
from mbds_xsim.scene.state import Batch

Value = float | str

FRAME = 0.1
"""Between recorded frames [s]."""
COUNTS = (2, 5, 10, 20, 50, 100)
"""Steps a frame that are tried: 50 ms to 1 ms."""


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
            if text not in names:
                raise UnknownName.of(f"value of {self.name}", text, names)
            return text
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not 0.0 <= value < float("inf"):
            msg = f"--value: got {text!r}, allowed is a number from 0 as {self.quantity}"
            raise InputError(msg)
        return value


def text_of(value: Value, unit: str = "") -> str:
    """Write a value as people read it."""
    if isinstance(value, str):
        return value
    return f"{value:g} {unit}".rstrip()

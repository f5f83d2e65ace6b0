"""Outcome of a command line, waiting for a condition, and a small scene."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str

    @property
    def refusal(self) -> str:
        """The one line that says what is wrong with the command line."""
        assert self.code == 2
        assert self.err.strip().count("\n") == 0
        return self.err


CommandLine = Callable[..., Ended]


def wait(happened: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


def bob(*facts: str) -> str:
    """Write the scene of a particle on a string, with more facts of it."""
    return "\n".join(
        [
            'name = "bob"',
            *facts,
            "[[bodies]]",
            'name = "bob"',
            "particles = [{ position = [0.3, 0.0, -0.4] }]",
            "[[joints]]",
            'name = "pivot"',
            'kind = "ball"',
            'parent = "world"',
            'child = "bob"',
            "anchor = [0, 0, 0]\n",
        ]
    )

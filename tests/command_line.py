"""What a call of the command line came to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str

    @property
    def refusal(self) -> str:
        """The one line that says what was wrong with the words."""
        assert self.code == 2
        assert self.err.strip().count("\n") == 0
        return self.err


CommandLine = Callable[..., Ended]


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

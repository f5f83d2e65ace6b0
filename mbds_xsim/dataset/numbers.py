"""Numbers of trajectories, as people write them: `0-9,15`."""

from __future__ import annotations

import re

from mbds_xsim.errors import InputError

__all__ = ["parse_numbers"]

_LONGEST = 10_000_000


def parse_numbers(text: str, option: str) -> list[int]:
    """Read numbers and ranges, ascending, each once.

    Raises:
        InputError: It is something else, or a range that would fill the memory.
    """
    found: set[int] = set()
    for word in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,15})(?:-(\d{1,15}))?\s*", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not 0 <= last - first < _LONGEST:
            msg = (
                f"{option}: got {text!r}, allowed are numbers and ranges of up to {_LONGEST}, as "
                "0-9,15"
            )
            raise InputError(msg)
        found |= set(range(first, last + 1))
    return sorted(found)

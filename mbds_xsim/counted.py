"""Numbers of things, in words."""

from __future__ import annotations

__all__ = ["counted"]


def counted(number: int | None, one: str, several: str = "") -> str:
    """Write a number of things: `1 core`, `2 cores`, `15 000 trajectories`."""
    usual = (
        f"{one[:-1]}ies" if one.endswith("y") else f"{one}es" if one.endswith("s") else f"{one}s"
    )
    noun = one if number == 1 else several or usual
    return f"{number:,} {noun}".replace(",", " ") if number is not None else f"? {noun}"

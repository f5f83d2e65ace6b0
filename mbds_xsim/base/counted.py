"""Numbers in texts."""

from __future__ import annotations

from collections.abc import Callable

_EXACT = 18
"""More digits than any number has that differs from another."""


def counted(number: int | None, one: str, several: str = "") -> str:
    """Write a number of things: `1 core`, `2 cores`, `15 000 trajectories`."""
    usual = (
        f"{one[:-1]}ies" if one.endswith("y") else f"{one}es" if one.endswith("s") else f"{one}s"
    )
    noun = one if number == 1 else several or usual
    return f"{number:,} {noun}".replace(",", " ") if number is not None else f"? {noun}"


def apart(
    figure: float, budget: float, write: Callable[[float, int], str], least: int
) -> tuple[str, str]:
    """Write a figure and its budget; one beyond it never reads as kept: `3.004` beside `3`.

    Args:
        figure: What was measured.
        budget: What is allowed.
        write: Writes a number with a number of digits.
        least: How many digits suffice elsewhere.
    """
    texts = ((write(figure, count), write(budget, count)) for count in range(least, _EXACT))
    pair = next(texts)
    while figure > budget and pair[0] == pair[1]:
        pair = next(texts)
    return pair

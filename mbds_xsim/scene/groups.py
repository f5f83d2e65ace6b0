"""Groups of bodies that something connects."""

from __future__ import annotations

from collections.abc import Iterable

from mbds_xsim.scene.mechanism import WORLD_INDEX


def connected(body_count: int, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Group the bodies that pairs connect, directly or by way of others but not of the world."""
    label = list(range(body_count))
    for a, b in pairs:
        if WORLD_INDEX not in (a, b):
            old, new = label[b], label[a]
            label = [new if one == old else one for one in label]
    return [
        tuple(k for k, one in enumerate(label) if one == group) for group in dict.fromkeys(label)
    ]

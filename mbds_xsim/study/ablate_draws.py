"""Scenes whose draws are weaker: ranges scaled, so that the same random numbers give the same
start and the same inputs but for one factor.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import msgspec

from mbds_xsim.sampling_terms import INTERVALS, Levels
from mbds_xsim.scene import Scene

__all__ = ["scaled_draws"]


def scaled_draws(
    scene: Scene, factor: float, *, fields: Collection[tuple[str, str]]
) -> Scene | None:
    """Scale fields of the scene's draws.

    Args:
        scene: What is sampled.
        factor: What the fields are multiplied by.
        fields: Kind of draw and name of a field of it.

    Returns:
        The scene, or None where no such draw has anything but 0 in these fields.
    """
    draws = []
    for draw in scene.sampling:
        names = [name for kind, name in fields if kind == draw.__struct_config__.tag]
        values = {name: _scaled(getattr(draw, name), factor) for name in names}
        draws.append(msgspec.structs.replace(draw, **values))
    # Doubled, they differ exactly where there is something to scale.
    if factor != 2.0 and scaled_draws(scene, 2.0, fields=fields) == scene:
        return None
    return msgspec.structs.replace(scene, sampling=tuple(draws))


def _scaled(value: Any, factor: float) -> Any:
    """Scale a number, a range, ranges by interval, or a tuple of these."""
    if isinstance(value, Levels):
        return Levels(**{name: _scaled(getattr(value, name), factor) for name in INTERVALS})
    if isinstance(value, tuple):
        return tuple(_scaled(part, factor) for part in value)
    return factor * value

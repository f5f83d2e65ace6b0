"""Whether two scenes are the same physics, started alike, whatever they are called."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec

from mbds_xsim.base.bounds import Neutral
from mbds_xsim.scene.scene import Scene

_SAID = ("name", "description", "source", "budget", "anchors", "edges")
"""What does not decide the motion."""


def fingerprint(scene: Scene) -> str:
    """Give 16 hexadecimal digits that stand for bodies, joints, loads, clock and starts.

    Numbers count to nine digits, so that a scene that is made by a formula has the same
    fingerprint on every machine.
    """
    plain = {key: _plain(value) for key, value in scene.decisive().items() if key not in _SAID}
    return hashlib.sha256(msgspec.json.encode(plain, order="sorted")).hexdigest()[:16]


def _plain(value: Any) -> Any:
    """Spell out tables, defaults too, as these decide the motion as well."""
    if isinstance(value, Neutral):
        parts = {key: _plain(part) for key, part in value.decisive().items()}
        return [type(value).__name__, parts]
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool):
        return value
    return f"{round(float(value), 15) + 0.0:.9g}"

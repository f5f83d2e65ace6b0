"""Scene files: TOML to Scene and back, without loss."""

from __future__ import annotations

from pathlib import Path

from mbds_xsim.scene import Scene

__all__ = ["read_scene"]


def read_scene(path: Path) -> Scene:
    """Read a scene file."""
    import tomllib

    import msgspec

    return msgspec.convert(tomllib.loads(path.read_text()), Scene)

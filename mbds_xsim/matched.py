"""Settings for a scene: the stored matched ones, or an adapter's own presets."""

from __future__ import annotations

import functools
import tomllib
from importlib.resources import files
from typing import Any

from mbds_xsim.engine import Adapter, Profile, Settings
from mbds_xsim.scene import Scene

__all__ = ["settings_for"]


def settings_for(scene: Scene, adapter: Adapter, profile: Profile) -> Settings:
    """Give the settings that `validate` and data generation use.

    `matched` settings that have been found and checked for a built-in scene are stored in
    `scenes/matched/`, one file a scene; for other scenes the adapter makes a careful choice.
    """
    stored = _stored(scene.name).get(adapter.name) if profile == "matched" else None
    if stored is None:
        return adapter.settings(scene, profile)
    return Settings(
        method=stored["method"],
        step=scene.clock.frame / stored["steps_per_frame"],
        options=stored.get("options", {}),
    )


@functools.cache
def _stored(scene_name: str) -> dict[str, Any]:
    entry = files("mbds_xsim_scenes") / "matched" / f"{scene_name}.toml"
    return tomllib.loads(entry.read_text("utf-8")) if entry.is_file() else {}

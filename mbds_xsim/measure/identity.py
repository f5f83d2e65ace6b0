"""What decides a measured row, as a key: the motion, the settings, versions and the machine."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from pathlib import Path

import msgspec

from mbds_xsim.base.counted import counted
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.reference.cache import key_of
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings


def row_key(scene: Scene, start: Batch, engine: str, settings: Settings) -> str:
    """Name a row by its content.

    It covers the physics, the start and its inputs, the budgets, the settings, the versions of
    engine, adapter, checks and numpy, and the machine.
    """
    adapter = registry.load_adapter(engine)
    steps = settings.substeps(scene.clock.frame)
    what = [
        key_of("tradeoff", scene, start, 0, 0.0),
        scene.budget,
        engine,
        settings.method,
        steps,
        sorted(settings.options.items()),
        adapter.version(),
        adapter.revision,
        CHECKS,
        registry.package_version("numpy"),
        machine(),
    ]
    return hashlib.sha256(msgspec.json.encode(what, enc_hook=float)).hexdigest()


@functools.cache
def machine() -> str:
    """Processor, cores and system."""
    cores = counted(os.cpu_count(), "core")
    return f"{_processor()}, {cores}, {platform.system()} {platform.machine()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown processor"

"""What decides a measured row, as a key: the motion, the settings, versions and the machine."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path

import msgspec

from mbds_xsim.base.counted import counted
from mbds_xsim.base.versions import CHECKS
from mbds_xsim.reference.cache import key_of
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.simulator import Simulator


def row_key(scene: Scene, start: Batch, simulator: Simulator, count: int) -> str:
    """Name a row by its content.

    It covers the physics, the start and its inputs, the budgets, the simulator at a number of
    steps a frame, the versions of all that runs and judges it, and the machine.
    """
    what = [
        key_of("tradeoff", scene, start, 0, 0.0),
        scene.budget,
        *simulator.decisive(scene, count),
        CHECKS,
        registry.package_version("numpy"),
        machine(),
    ]
    return hashlib.sha256(msgspec.json.encode(what, enc_hook=float)).hexdigest()


def versions_of(packages: Mapping[str, str]) -> dict[str, str]:
    """List the versions behind a result: of this toolkit, and of the packages that ran."""
    own = {name: registry.package_version(name) for name in ("mbds-xsim", "numpy", "scipy")}
    return own | {"python": platform.python_version()} | dict(packages)


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

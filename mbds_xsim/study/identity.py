"""What decides a measured row, as a key: the motion, the settings, the code and the machine."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from pathlib import Path

import msgspec

import mbds_xsim
from mbds_xsim import registry
from mbds_xsim.counted import counted
from mbds_xsim.engine import Settings
from mbds_xsim.plugin import source_of
from mbds_xsim.reference.cache import key_of
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch

__all__ = ["adapter_files", "machine", "row_key"]

_MEASURING = ("point.py", "truths.py")
_CORE = ("engine.py", "state.py", "joint_space.py", "assembly.py", "markers.py", "simulate.py")


def row_key(scene: Scene, start: Batch, engine: str, settings: Settings) -> str:
    """Name a row by its content.

    It covers the physics, the start and its inputs, the budgets, the settings, the versions of
    engine and numpy, the source of adapter and checks, and the machine.
    """
    digest = hashlib.sha256(_code(engine))
    steps = settings.substeps(scene.clock.frame)
    what = [
        key_of("tradeoff", scene, start, 0, 0.0),
        scene.budget,
        engine,
        settings.method,
        steps,
        sorted(settings.options.items()),
        registry.load_adapter(engine).version(),
        registry.package_version("numpy"),
        machine(),
    ]
    digest.update(msgspec.json.encode(what, enc_hook=float))
    return digest.hexdigest()


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


def adapter_files(engine: str) -> list[Path]:
    """Name the source of an engine's adapter.

    Raises:
        UnknownName: There is no such engine.
        MissingPackage: It is not installed.
    """
    adapter = source_of(registry.load_adapter(engine))
    return [adapter, *sorted(adapter.parent.glob(f"_{adapter.stem}_*.py"))]


@functools.cache
def _code(engine: str) -> bytes:
    """Hash of the source of an adapter, of what it builds on, and of what judges it."""
    assert mbds_xsim.__file__ is not None
    core = Path(mbds_xsim.__file__).parent
    sources = adapter_files(engine)
    sources += [core / name for name in _CORE]
    sources += sorted((core / "checks").glob("*.py"))
    sources += [core / "study" / name for name in _MEASURING]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).digest()

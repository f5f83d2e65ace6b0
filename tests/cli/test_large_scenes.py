"""A scene of ten times as many bodies takes ten times the work to show, not a hundred times.

Times are measured by `benchmarks/large_scenes.py`. Here work is counted, which is the same on every
machine: calls of functions, and the memory that arrays take. Work on all pairs of bodies
increases both.
"""

from __future__ import annotations

import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.four_bars import four_bars
from benchmarks.large_scenes import chain
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Scene
from tests.command_line import CommandLine

_MAKERS = {"chain": chain, "loops": lambda bodies: four_bars((bodies - 1) // 2, 4.0)}


@pytest.mark.parametrize("make", _MAKERS.values(), ids=_MAKERS.keys())
def test_a_scene_is_shown_with_work_in_proportion_to_its_bodies(
    make: Callable[[int], Scene], run: CommandLine, here: Path
) -> None:
    for bodies in (251, 501, 1001):
        save_scene(make(bodies), here / f"{bodies}.toml")
        run("show", f"{bodies}.toml")  # one-time imports do not count

    few, many = (_calls(run, f"{bodies}.toml") for bodies in (251, 1001))
    memory = [_memory(run, f"{bodies}.toml") for bodies in (501, 1001)]

    assert many < 5 * few
    # Rows of all joints over rates of all bodies alone would take 0.2 MB for each body.
    assert memory[1] / 1001 < 60e3
    assert memory[1] < 2.2 * memory[0]


def _calls(run: CommandLine, file: str) -> int:
    """Count the function calls that showing a scene takes."""
    count = 0

    def called(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(called)
    try:
        assert run("show", file).code == 0
    finally:
        sys.setprofile(None)
    return count


def _memory(run: CommandLine, file: str) -> int:
    """Return the peak memory of showing a scene [B]."""
    tracemalloc.start()
    try:
        assert run("show", file).code == 0
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

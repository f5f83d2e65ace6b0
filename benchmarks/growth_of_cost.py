"""Cost over links and rungs: python -m benchmarks.growth_of_cost [--png FILE].

The reference and MuJoCo's RK4 (10 ms, the options of its matched settings) run chains of 2 to 128
links and ladders of 1 to 20 rungs, each size in a process of its own. Costs are processor time per
simulated second and trajectory on one thread, the least of three. The reference has a tolerance of
1e-9, and runs both 64 trajectories at once, as data are made, and one alone. Errors are RMS
distances of the particles from the reference at 1e-13 after 0.5 s. Memory is the process's peak.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from benchmarks.harness import print_made, print_table, processor_s
from mbds_xsim.base.files import write_whole
from mbds_xsim.checks.agreement import particle_error
from mbds_xsim.report import quantity, themed
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import settings_for

_FAMILIES = {"pendulum": (2, 4, 8, 16, 32, 64, 128), "ladder": (1, 2, 3, 5, 10, 20)}
_CLOCK = Clock(0.02, 25)
_TOGETHER, _REPEATS = 64, 3
_RTOL, _TRUTH = 1e-9, 1e-13
_METHODS = {"reference": "adaptive", "mujoco": "RK4"}
_SIZE = (11.0, 4.4)


class GrowthPoint(NamedTuple):
    """Cost of one engine at one size, per simulated second and trajectory."""

    alone_s: float
    share_s: float
    """Processor time in a batch [s]."""
    error_m: float
    memory_bytes: int


def measure(name: str, engine: str) -> GrowthPoint:
    """Measure one scene in this process."""
    scene = msgspec.structs.replace(registry.load_scene(name), clock=_CLOCK)
    adapter, batch = registry.load_adapter(engine), draw_batch(scene, range(_TOGETHER))
    settings = _settings(name, engine)
    with adapter.open(scene, settings) as run:
        motion = run.rollout(batch[:1])
        alone = min(processor_s(lambda: run.rollout(batch[:1])) for _ in range(_REPEATS))
        count = _TOGETHER if engine == registry.REFERENCE else 1
        many = min(processor_s(lambda: run.rollout(batch[:count])) for _ in range(_REPEATS))
    memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tight = _settings(name, registry.REFERENCE, _TRUTH)
    with registry.load_adapter(registry.REFERENCE).open(scene, tight) as run:
        error = particle_error(Mechanism.of(scene), motion, run.rollout(batch[:1]))
    second = scene.clock.duration
    return GrowthPoint(alone / second, many / second / count, float(error[0, -1]), memory)


def _settings(name: str, engine: str, rtol: float = _RTOL) -> Settings:
    adapter = registry.load_adapter(engine)
    if engine == registry.REFERENCE:
        return Settings(_METHODS[engine], _CLOCK.frame, {"rtol": rtol})
    options = settings_for(registry.load_scene(name), adapter, "matched").options
    return Settings(_METHODS[engine], _CLOCK.frame / 2, options)


Costs = dict[tuple[str, str], list[GrowthPoint]]
"""Measured points of each family and engine, in the order of the sizes."""


def costs() -> Costs:
    """Measure every size of every family, one after the other."""
    return {
        (family, engine): [_apart(f"{size}{family}", engine) for size in sizes]
        for family, sizes in _FAMILIES.items()
        for engine in _METHODS
    }


def _apart(name: str, engine: str) -> GrowthPoint:
    """Measure in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.growth_of_cost", "--one", name, engine]
    process = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return GrowthPoint(*json.loads(process.stdout))


def rows(points: Costs) -> Iterator[list[str]]:
    for family, sizes in _FAMILIES.items():
        for place, size in enumerate(sizes):
            own, other = (points[family, engine][place] for engine in _METHODS)
            yield [
                f"{size}{family}",
                quantity.span(own.share_s),
                quantity.span(own.alone_s),
                quantity.length(own.error_m),
                f"{own.memory_bytes / 2**20:.0f}",
                quantity.span(other.alone_s),
                quantity.length(other.error_m),
            ]


def picture(points: Costs) -> bytes:
    """Draw cost over size, with a dotted line for cost in proportion to size."""

    def draw(figure: Any) -> None:
        for axes, (family, sizes) in zip(figure.subplots(1, 2), _FAMILIES.items(), strict=True):
            _draw(axes, family, sizes, points)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)

    return themed.png(draw, _SIZE)


def _draw(axes: Any, family: str, sizes: tuple[int, ...], points: Costs) -> None:
    own, other = (points[family, engine] for engine in _METHODS)
    colours = [themed.LIGHT[themed.engine_style(engine).colour] for engine in _METHODS]
    share = [cost.share_s for cost in own]
    axes.loglog(sizes, share, "d-", color=colours[0], label=f"reference, {_TOGETHER} at a time")
    axes.loglog(sizes, [c.alone_s for c in own], "d--", color=colours[0], label="reference, alone")
    axes.loglog(
        sizes, [c.alone_s for c in other], "D-", color=colours[1], label="mujoco RK4, 10 ms"
    )
    middle = len(sizes) // 2
    line = share[middle] / sizes[middle] * np.array(sizes)
    axes.loglog(sizes, line, color=themed.GREY, ls=":", label="in proportion")
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.set_xlabel("links of a chain" if family == "pendulum" else "rungs of a rope ladder")
    axes.set_ylabel("processor time per simulated second [s]")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--png", type=Path)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(*arguments.one)))
        return
    points = costs()
    print_table(
        f"scene|>reference, {_TOGETHER} at a time|>alone|>error|>memory [MiB]|>mujoco RK4|>error",
        rows(points),
    )
    print_made(f"MuJoCo {registry.load_adapter('mujoco').version()}")
    if arguments.png is not None:
        write_whole(arguments.png, picture(points))


if __name__ == "__main__":
    main()

"""How long large scenes take to be shown: python -m benchmarks.large_scenes [SIZE …].

Each cell is the processor time of `mbds-xsim show`, which runs in one thread, in a fresh process,
the least of three. The aim is 2 s for 1 000 bodies and 30 s for 10 000.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

from benchmarks.four_bars import four_bars
from benchmarks.startup import PROGRAM, seconds
from mbds_xsim.scene import Body, Inertia, Joint, Scene
from mbds_xsim.scene_file import save_scene

_ROD = Inertia(1.0, (1 / 12, 1 / 12, 1e-3))


def chain(count: int) -> Scene:
    """Make a chain of hinged rods; each is turned, and turns, against the one above."""
    bodies = tuple(Body(f"b{k}", inertia=_ROD, position=(0, 0, -k - 0.5)) for k in range(count))
    names = ["world", *(body.name for body in bodies)]
    joints = tuple(
        Joint(f"j{k}", "hinge", names[k], names[k + 1], (0, 0, -k), (0, 1, 0), 0.1, 1.0)
        for k in range(count)
    )
    return Scene("chain", bodies, float(count), joints=joints)


def _processor_seconds(command: list[str]) -> float:
    begin = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds(command)
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    return end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime


def main() -> None:
    """Print a table."""
    print("| bodies | chain, all starts and rates given [s] | four-bars, one rate given [s] |")
    print("| ---: " * 3 + "|")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "large.toml"
        for count in map(int, sys.argv[1:] or ("1000", "10000")):
            times = []
            for scene in (chain(count), four_bars((count - 1) // 2, 4.0)):
                save_scene(scene, file)
                show = [str(PROGRAM), "show", str(file)]
                times.append(min(_processor_seconds(show) for _ in range(3)))
            print(f"| {count} | {times[0]:.1f} | {times[1]:.1f} |", flush=True)


if __name__ == "__main__":
    main()

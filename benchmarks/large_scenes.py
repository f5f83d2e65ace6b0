"""Time to show large scenes: python -m benchmarks.large_scenes [SIZE …].

Each cell is the processor time of `mbds-xsim show`, which runs in one thread, in a fresh process:
the least of three. The target is 2 s for 1 000 bodies and 30 s for 10 000.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.four_bars import four_bars
from benchmarks.harness import print_table
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene

_PROGRAM = Path(sys.executable).with_name("mbds-xsim")
_ROD = Inertia(1.0, (1 / 12, 1 / 12, 1e-3))


def chain(count: int) -> Scene:
    """Make a chain of hinged rods; each starts turned, and turning, relative to the one above."""
    bodies = tuple(Body(f"b{k}", inertia=_ROD, position=(0, 0, -k - 0.5)) for k in range(count))
    names = ["world", *(body.name for body in bodies)]
    joints = tuple(
        Joint(f"j{k}", "hinge", names[k], names[k + 1], (0, 0, -k), (0, 1, 0), 0.1, 1.0)
        for k in range(count)
    )
    return Scene("chain", bodies, float(count), joints=joints)


def _processor_seconds(command: list[str]) -> float:
    begin = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    return end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime


def rows(counts: list[int]) -> Iterator[list[str]]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "large.toml"
        for count in counts:
            times = []
            for scene in (chain(count), four_bars((count - 1) // 2, 4.0)):
                save_scene(scene, file)
                show = [str(_PROGRAM), "show", str(file)]
                times.append(min(_processor_seconds(show) for _ in range(3)))
            yield [str(count), *(f"{seconds:.1f}" for seconds in times)]


if __name__ == "__main__":
    print_table(
        ">bodies|>chain, all starts and rates given [s]|>four-bars, one rate given [s]",
        rows([int(word) for word in sys.argv[1:] or ("1000", "10000")]),
    )

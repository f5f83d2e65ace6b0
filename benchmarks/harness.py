"""What the benchmarks share: work timed in turns, and pages with their command and machine."""

from __future__ import annotations

import argparse
import platform
import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.errors import InputError
from mbds_xsim.measure.identity import machine
from mbds_xsim.report.markdown import table_lines

Array = NDArray[Any]
Work = Callable[[], object]


def print_head(title: str, command: str, text: str) -> None:
    """Print how a page begins: its title, the command that writes it, and what it shows."""
    paragraphs = (textwrap.fill(" ".join(part.split()), 100) for part in text.split("\n\n"))
    print(f"# {title}\n\n<!-- Written by: {command} -->\n")
    print("\n\n".join(paragraphs), end="\n\n")


def print_table(headings: str, rows: Iterable[Iterable[str]]) -> None:
    """Print rows of Markdown as they come, under headings parted by `|`; `>` before figures."""
    for line in table_lines(map(str.strip, headings.split("|")), rows):
        print(line, flush=True)


def print_made(*versions: str, on: str = "") -> None:
    """Print on what, and with which versions, a page was made."""
    told = ", ".join([on or machine(), f"Python {platform.python_version()}", *versions])
    print(f"\nMade on {told}.")


def processor_s(work: Work) -> float:
    """Time that this process spends on the processor [s]."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def wall_s(work: Work) -> float:
    """Time on the clock on the wall [s]."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def both_s(work: Work) -> tuple[float, float]:
    """Time of the processor, and on the wall [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall


def take_turns(
    works: Sequence[Work],
    rounds: tuple[int, int],
    patience: float = 0.0,
    spent: Callable[[Work], Any] = processor_s,
) -> Array:
    """Time pieces of work in turns, every other round backwards, after one that warms up.

    Args:
        works: Each is done once a round.
        rounds: The least and the most.
        patience: Time [s] that all rounds may take if there are enough of them.
        spent: What is counted.

    Returns:
        Times [s], shape (round, work, …).
    """
    least, most = rounds
    first = wall_s(lambda: [spent(work) for work in works])
    times = []
    for k in range(min(most, max(least, int(patience / first)))):
        order = range(len(works))[:: -1 if k % 2 else 1]
        found = {place: spent(works[place]) for place in order}
        times.append([found[place] for place in range(len(works))])
    return np.array(times)


def device_asked(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, str]:
    """Read the arguments, a device among them; end with one line where there is none."""
    from mbds_xsim.learn.device import check_device

    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    try:
        check_device(arguments.device)
    except InputError as error:
        parser.error(str(error))
    return arguments, arguments.device


def machine_of(device: str) -> str:
    """Name what work was timed on."""
    import torch

    return machine() if device == "cpu" else f"{torch.cuda.get_device_name()}, {machine()}"


def spent_on(device: str) -> Callable[[Work], float]:
    """Count the time of one thread of the processor, or on a GPU until all is done."""
    import torch

    def on_gpu(work: Work) -> float:
        torch.cuda.synchronize()
        begin = time.perf_counter()
        work()
        torch.cuda.synchronize()
        return time.perf_counter() - begin

    return processor_s if device == "cpu" else on_gpu

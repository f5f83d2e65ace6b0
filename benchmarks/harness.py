"""Shared code of the benchmarks: work timed in turns, and pages with their command and machine."""

from __future__ import annotations

import argparse
import platform
import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base.files import read_file
from mbds_xsim.measure.runner import machine
from mbds_xsim.report.files import table_lines

Array = NDArray[Any]
Work = Callable[[], object]
Stored = TypeVar("Stored")


def stored(file: Path, kind: type[Stored]) -> Stored:
    """Read a result that was stored as JSON."""
    return msgspec.json.decode(read_file(file), type=kind)


def folder_and_file(text: str | None, option: str) -> tuple[Path, Path | None]:
    """Read a folder of results, and the file that an option names, from the command line."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("folder", type=Path)
    parser.add_argument(option, type=Path)
    given = parser.parse_args()
    return given.folder, getattr(given, option.removeprefix("--"))


def placed(page: str, name: str, text: str) -> str:
    """Put a text into a page, between the marks of its name."""
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
    before, _, rest = page.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"no place for the table: give it the lines {begin.strip()} and {end}")
    return f"{before}{begin}{text}\n{end}{after}"


def print_head(title: str, command: str, text: str) -> None:
    """Print the head of a page: its title, the command that writes it, and its introduction."""
    whole = textwrap.TextWrapper(100, break_on_hyphens=False)  # links stay in one piece
    paragraphs = (whole.fill(" ".join(part.split())) for part in text.split("\n\n"))
    print(f"# {title}\n\n<!-- Written by: {command} -->\n")
    print("\n\n".join(paragraphs), end="\n\n")


def print_table(headings: str, rows: Iterable[Iterable[str]]) -> None:
    """Print rows of Markdown as they come; `|` separates headings, `>` marks columns of figures."""
    for line in table_lines(map(str.strip, headings.split("|")), rows):
        print(line, flush=True)


def print_made(*versions: str, on: str = "") -> None:
    """Print the machine and the versions that a page was made with."""
    setup = ", ".join([on or machine(), f"Python {platform.python_version()}", *versions])
    print(f"\nMade on {setup}.")


def processor_s(work: Work) -> float:
    """Measure the time that this process spends on the processor [s]."""
    return both_s(work)[0]


def both_s(work: Work) -> tuple[float, float]:
    """Measure processor time and wall-clock time [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall


def take_turns(
    works: Sequence[Work],
    rounds: tuple[int, int],
    patience: float = 0.0,
    spent: Callable[[Work], Any] = processor_s,
) -> Array:
    """Time pieces of work in turns, every other round in reverse order, after one round of warm-up.

    Args:
        works: Pieces of work, each done once a round.
        rounds: Least and greatest number of rounds.
        patience: Time to fill with rounds within these limits [s].
        spent: Function that measures one piece of work.

    Returns:
        Times [s], shape (round, work, …).
    """
    least, most = rounds
    _, first = both_s(lambda: [spent(work) for work in works])
    times = []
    for k in range(min(most, max(least, int(patience / first)))):
        order = range(len(works))[:: -1 if k % 2 else 1]
        seconds = {place: spent(works[place]) for place in order}
        times.append([seconds[place] for place in range(len(works))])
    return np.array(times)

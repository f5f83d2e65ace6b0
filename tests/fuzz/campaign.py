"""Fuzz campaigns: random bad input, with one number of cases and one set of limits for all.

`MBDS_XSIM_FUZZ` is the number of cases of all campaigns together; `make fuzz` asks for 3000. At
the default the cases are the same in every run; a larger number draws new ones each time.
"""

from __future__ import annotations

import functools
import os
import resource
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase
from hypothesis.strategies import SearchStrategy

from mbds_xsim import __main__ as cli
from mbds_xsim.base.errors import InputError

__all__ = ["CASES", "Ended", "cases_of", "fuzz", "refused", "run_command"]

CASES = {
    "hdf5": 150,
    "npz": 60,
    "csv": 60,
    "model": 30,
    "scene": 40,
    "robot": 40,
    "plugin": 20,
    "dask": 5,
}
"""Default number of cases of each campaign; those with quick cases have more."""

_SECONDS = 60
_BYTES = 4 * 2**30
_ALL = int(os.environ.get("MBDS_XSIM_FUZZ", sum(CASES.values())))


class TooLong(BaseException):
    """A case has not ended in time. No handler of the program catches it."""


@dataclass(frozen=True)
class Ended:
    """How a command line ended."""

    code: int
    out: str
    err: str


def cases_of(name: str) -> int:
    """Return the number of cases of a campaign in this run."""
    return -(-_ALL * CASES[name] // sum(CASES.values()))


def fuzz(
    name: str, **drawn: SearchStrategy[Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a test a campaign: each case within limits, as many as `cases_of` says.

    Args:
        name: Name of the campaign in `CASES`.
        drawn: Strategies of the test's arguments; the others are fixtures of a module or session.
    """
    settings = hypothesis.settings(
        max_examples=cases_of(name),
        deadline=None,  # the limit below also ends what hangs
        derandomize=sum(CASES.values()) == _ALL,
        phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )

    def campaign(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def limited(*args: Any, **others: Any) -> None:
            with _limits():
                test(*args, **others)

        return settings(hypothesis.given(**drawn)(limited))

    return campaign


def refused(work: Callable[[], object]) -> str:
    """Work on bad input; return the one line that refuses it, or "" if it is accepted."""
    try:
        work()
    except InputError as error:
        text = str(error)
        assert text, "a refusal without a word"
        return text
    return ""


def run_command(*words: str | Path) -> Ended:
    """Run a command line in this process; an exception that escapes fails the test."""
    with (
        tempfile.TemporaryFile("w+") as out,
        tempfile.TemporaryFile("w+") as err,
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        code = cli._run([str(word) for word in words])
        out.seek(0)
        err.seek(0)
        ended = Ended(code, out.read(), err.read())
    assert code in (0, 1, 2), ended
    assert "Traceback" not in ended.out + ended.err, ended
    assert "out of memory" not in ended.err, ended
    assert code != 2 or ended.err.count("\n") == 1, f"not one line: {ended}"
    return ended


@contextmanager
def _limits() -> Iterator[None]:
    """Limit the time and the memory of a case."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + _BYTES, before[1]))
    handler = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _too_long(_number: int, _frame: FrameType | None) -> None:
    msg = f"a case takes more than {_SECONDS} s"
    raise TooLong(msg)

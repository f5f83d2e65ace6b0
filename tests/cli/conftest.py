"""The command line, called in this process or as a program of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import pytest

from mbds_xsim import __main__ as cli
from mbds_xsim.base import isolate
from mbds_xsim.measure import campaign

PROGRAM = os.path.join(os.path.dirname(sys.executable), "mbds-xsim")


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str


CommandLine = Callable[..., Ended]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Stand in an empty folder, with stored references and temporary files of its own."""
    kept = signal.getsignal(signal.SIGTERM)
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MBDS_XSIM_CACHE", str(tmp_path / "cache"))
    yield folder
    signal.signal(signal.SIGTERM, kept)


@pytest.fixture
def run(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> CommandLine:
    """Call the entry point of the program in this process."""
    del here

    def call(*words: str) -> Ended:
        monkeypatch.setattr(sys, "argv", ["mbds-xsim", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return Ended(int(ended.value.code or 0), out, err)

    return call


@pytest.fixture
def program(here: Path) -> CommandLine:
    """Call the installed program."""
    del here

    def call(*words: str | bytes, stdout: IO[str] | int = subprocess.PIPE) -> Ended:
        done = subprocess.run(
            [PROGRAM, *words], stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=600
        )
        return Ended(done.returncode, done.stdout, done.stderr)

    return call


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Carry out the tasks of a validation in this process, which spares their start."""

    def run_here(tasks: list[isolate.Task], **options: object) -> list[object]:
        return isolate.run_tasks(tasks, **(options | {"workers": 0}))  # type: ignore[arg-type]

    monkeypatch.setattr(campaign, "run_tasks", run_here)

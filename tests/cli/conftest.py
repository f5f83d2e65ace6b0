"""The command line as a program of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

from tests.command_line import CommandLine, Ended

PROGRAM = os.path.join(os.path.dirname(sys.executable), "mbds-xsim")


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

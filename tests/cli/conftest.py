"""The command line as a program of its own, and the comparison of two results."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

from tests.cli.stored import Compare, Edit, Json
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


@pytest.fixture
def compare(run: CommandLine, here: Path) -> Compare:
    """Return a function that compares a result with an edited copy: its outcome and the JSON."""

    def call(result: Json, edit: Edit, *words: str) -> tuple[Ended, Json]:
        other = copy.deepcopy(result)
        edit(other)
        (here / "old.json").write_text(json.dumps(result))
        (here / "new.json").write_text(json.dumps(other))
        ended = run("diff", "old.json", "new.json", "--json", "diff.json", *words)
        output = here / "diff.json"
        return ended, json.loads(output.read_text()) if output.exists() else {}

    return call

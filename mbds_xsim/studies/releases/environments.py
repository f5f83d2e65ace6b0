"""The releases of a package that are on the index, each in a folder of its own.

A folder has the release and what it requires at one very version; all else it shares with this
environment: who uses it puts it before the places in which Python looks anyway. Folders stand in
the user's cache directory: what is there whole is not installed again.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.metadata import distributions
from pathlib import Path

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import write_whole
from mbds_xsim.reference.cache import directory

_LONGEST = 1800.0  # that the installation of a release may take; some are compiled [s]
_REFUSED = "not-installed"
"""Name of the file that says why there is no folder."""


def releases_of(package: str, since: str = "", last: int | None = None) -> list[str]:
    """List the releases of a package that suit this Python, the oldest first.

    Of those since one of them, `last` gives so many of the newest.

    Raises:
        InputError: The index cannot be asked, or has none since then.
    """
    answer = _pip("index", "versions", package, "--json")
    if isinstance(answer, str):
        msg = f"the index has no releases of {package}: {answer}"
        raise InputError(msg)
    known = sorted(json.loads(answer.stdout)["versions"], key=_numbers)
    least = _numbers(since)
    found = [version for version in known if _numbers(version) >= least]
    if not found or (since and not least):
        msg = f"--since: got {since}, the index has {package} {known[0]} to {known[-1]}"
        raise InputError(msg)
    return found[-last:] if last else found


def installed(package: str, version: str, *, fresh: bool = False) -> Path | str:
    """Give the folder of a release, installing it if need be; or why it cannot be installed.

    What could not be is tried again where that is asked for: the network may have been at fault.
    """
    folder = directory() / "releases" / f"{package}-{version}"
    reason = folder / _REFUSED
    if fresh and reason.is_file():
        shutil.rmtree(folder)
    if folder.is_dir():
        return reason.read_text("utf-8") if reason.is_file() else folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".part-"))
    trouble = _install(part, [f"{package}=={version}"])
    if trouble:
        shutil.rmtree(part)
        write_whole(part / _REFUSED, trouble.encode())
    part.rename(folder)
    return trouble or folder


def add(folder: Path, package: str) -> None:
    """Install one more package into the folder of a release, if it can be."""
    _install(folder, [package])


def _install(folder: Path, wanted: Sequence[str]) -> str:
    """Install packages and what they pin; gives what went wrong."""
    while wanted:
        how = ("--quiet", "--no-deps", "--no-compile", "--upgrade", "--target", str(folder))
        answer = _pip("install", *how, *wanted)
        if isinstance(answer, str):
            return answer
        wanted = list(_missing(folder))
    return ""


def _missing(folder: Path) -> Iterator[str]:
    """Name what the packages of a folder require at one very version and is not in it.

    Parts of an engine are such packages; another release's would fill in for them.
    """
    there = list(distributions(path=[str(folder)]))
    names = {_normal(distribution.name) for distribution in there}
    for requirement in (each for distribution in there for each in distribution.requires or ()):
        pinned = re.fullmatch(r"([\w.-]+) ?\(?==([\w.]+)\)?", requirement)
        if pinned and _normal(pinned[1]) not in names:
            yield f"{pinned[1]}=={pinned[2]}"


def _normal(name: str) -> str:
    """Write a package's name as all of its spellings are compared (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _pip(*words: str) -> subprocess.CompletedProcess[str] | str:
    """Run pip; where that fails, give the last line of what it says."""
    quiet = {"PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    command = [sys.executable, "-m", "pip", *words]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=_LONGEST, env=os.environ | quiet
        )
    except subprocess.TimeoutExpired:
        return f"pip was not done after {_LONGEST:g} s"
    lines = [line for line in answer.stderr.splitlines() if "error" in line.lower()]
    reason = (lines or answer.stderr.splitlines() or [f"exit code {answer.returncode}"])[-1]
    return " ".join(reason.split()) if answer.returncode else answer


def _numbers(version: str) -> list[int]:
    """Give what versions are compared by: 3.7 is 3.7.0."""
    return [int(number) for number in re.findall(r"\d+", re.sub(r"(\.0+)+$", "", version))]

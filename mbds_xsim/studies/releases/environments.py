"""Releases of a package from the package index, each installed in its own folder.

A folder holds the release and the packages that it pins to one exact version. To use it, put it
first on Python's search path; all other packages are shared with this environment. Folders are
kept in the user's cache directory; a complete one is not installed again.
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

_LONGEST = 1800.0  # time limit of an installation, as some releases are compiled [s]
_REASON_FILE = "not-installed"
"""Name of the file that states why a release could not be installed."""


def releases_of(package: str, since: str = "", last: int | None = None) -> list[str]:
    """List the releases of a package that suit this Python, the oldest first.

    The list begins at `since` if given, and has the newest `last` of these.

    Raises:
        InputError: The index cannot be read, or has no release since then.
    """
    answer = _pip("index", "versions", package, "--json")
    if isinstance(answer, str):
        raise InputError(f"the index has no releases of {package}: {answer}")
    available = sorted(json.loads(answer.stdout)["versions"], key=_numbers)
    least = _numbers(since)
    versions = [version for version in available if _numbers(version) >= least]
    if not versions or (since and not least):
        msg = f"--since: got {since}, the index has {package} {available[0]} to {available[-1]}"
        raise InputError(msg)
    return versions[-last:] if last else versions


def install(package: str, version: str, *, fresh: bool = False) -> Path | str:
    """Return the folder of a release, installing it if need be, or why it cannot be installed.

    A failed installation is tried again only if `fresh`: the network may have been at fault.
    """
    folder = directory() / "releases" / f"{package}-{version}"
    reason_file = folder / _REASON_FILE
    if fresh and reason_file.is_file():
        shutil.rmtree(folder)
    if folder.is_dir():
        return reason_file.read_text("utf-8") if reason_file.is_file() else folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".part-"))
    try:
        error = _install(part, [f"{package}=={version}"])
    except BaseException:  # an interruption, too
        shutil.rmtree(part, ignore_errors=True)
        raise
    if error:
        shutil.rmtree(part)
        write_whole(part / _REASON_FILE, error.encode())
    try:
        part.rename(folder)
    except OSError:  # another process has been here since; what it installed is as good
        if not folder.is_dir():
            raise
        shutil.rmtree(part)
        return install(package, version, fresh=not error)
    return error or folder


def add(folder: Path, package: str) -> None:
    """Install one more package into the folder of a release, if possible."""
    _install(folder, [package])


def _install(folder: Path, packages: Sequence[str]) -> str:
    """Install packages and their pinned requirements; return the error, or "" if there is none."""
    while packages:
        options = ("--quiet", "--no-deps", "--no-compile", "--upgrade", "--target", str(folder))
        answer = _pip("install", *options, *packages)
        if isinstance(answer, str):
            return answer
        packages = list(_missing(folder))
    return ""


def _missing(folder: Path) -> Iterator[str]:
    """Yield the exactly pinned requirements of a folder's packages that are not in it.

    Parts of an engine are such packages; without them, those of another release would be used.
    """
    packages = list(distributions(path=[str(folder)]))
    names = {_normal(distribution.name) for distribution in packages}
    for requirement in (each for distribution in packages for each in distribution.requires or ()):
        pinned = re.fullmatch(r"([\w.-]+) ?\(?==([\w.]+)\)?", requirement)
        if pinned and _normal(pinned[1]) not in names:
            yield f"{pinned[1]}=={pinned[2]}"


def _normal(name: str) -> str:
    """Normalise a package's name, so that all its spellings are equal (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _pip(*arguments: str) -> subprocess.CompletedProcess[str] | str:
    """Run pip; if it fails, return the last error line of its output."""
    quiet = {"PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    command = [sys.executable, "-m", "pip", *arguments]
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
    """Return the numbers by which versions are compared; 3.7 equals 3.7.0."""
    return [int(number) for number in re.findall(r"\d+", re.sub(r"(\.0+)+$", "", version))]

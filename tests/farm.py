"""A Dask cluster of processes on this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

# Start-up code of a worker's Python that cannot find the package.
_BARE = """
import sys
from importlib import metadata

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "mbds_xsim":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

known = metadata.version
def version(name):
    if name == "mbds-xsim":
        raise metadata.PackageNotFoundError(name)
    return known(name)

sys.meta_path.insert(0, Missing())
metadata.version = version
"""


class Farm:
    """A scheduler and its workers, each a program of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._running = folder, list[subprocess.Popen[bytes]]()
        file = folder / "scheduler.json"
        options = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard")
        self.scheduler = self._start("scheduler", *options, "--port", "0")
        self.address = str(json.loads(_when_written(file))["address"])

    def worker(self, *, bare: bool = False) -> subprocess.Popen[bytes]:
        """Start a worker; a bare one does not have the package."""
        if bare:
            (self._folder / "bare").mkdir(exist_ok=True)
            (self._folder / "bare/sitecustomize.py").write_text(_BARE)
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
            path=str(self._folder / "bare") if bare else "",
        )  # fmt: skip

    def _start(self, role: str, *words: str, path: str = "") -> subprocess.Popen[bytes]:
        with (self._folder / f"{role}.log").open("ab") as log:
            program = subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_" + role, *words],
                stdout=log,
                stderr=log,
                cwd=self._folder,
                env=os.environ | {"PYTHONPATH": path},
            )
        self._running.append(program)
        return program

    def wait_for(self, workers: int) -> None:
        """Wait until so many workers have arrived."""
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(workers, timeout=60)

    def close(self) -> None:
        for program in self._running[::-1]:
            program.kill()
            program.wait()


def _when_written(file: Path) -> str:
    for _ in range(600):
        if file.is_file() and (text := file.read_text()).endswith("}"):
            return text
        time.sleep(0.05)
    msg = f"no scheduler wrote {file}"
    raise TimeoutError(msg)

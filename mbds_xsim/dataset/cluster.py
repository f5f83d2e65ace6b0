"""Have tasks carried out by a Dask cluster, whose workers see the same folder.

A task goes to a Dask worker and there into a process of its own, as it does on one machine: an
engine that crashes takes no worker with it. A worker that is lost is the scheduler's to replace;
what it was at is tried again.
"""

from __future__ import annotations

import importlib
import sys
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mbds_xsim.errors import InputError
from mbds_xsim.isolate import Crash, Task, run_tasks

__all__ = ["Cluster"]

_PATIENCE = 10.0  # for the scheduler's first answer [s]
_PACKAGES = ("mbds-xsim", "mujoco", "pybullet", "dartpy", "exudyn", "numpy", "h5py")


class Cluster:
    """A `Carrier`; use it in a `with` block.

    Args:
        address: Of the scheduler, as `tcp://host:8786`.
        out: Folder of the data; every worker must see it under this path.

    Raises:
        InputError: Dask is not installed, nobody answers, there is no worker, or one differs.
    """

    def __init__(self, address: str, out: Path) -> None:
        try:
            self._client = _dask().Client(address, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            msg = (
                f"--scheduler: got {address!r}, where no Dask scheduler answers within "
                f"{_PATIENCE:g} s; start one with `dask scheduler`, workers with "
                "`dask worker ADDRESS`"
            )
            raise InputError(msg) from error
        try:
            self._check(address, out.absolute())
        except InputError:
            self._client.close()
            raise

    @property
    def workers(self) -> int:
        """Tasks that the cluster carries out at a time."""
        return sum(self._client.nthreads().values())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._client.close()

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        workers: int | None = None,
        finished: Callable[[int, Any], None] | None = None,
    ) -> list[Any]:
        """Carry out all tasks; `workers` is the cluster's own affair."""
        del workers
        futures = [self._client.submit(_carry_out, task, pure=False) for task in tasks]
        places = {future: place for place, future in enumerate(futures)}
        answers: list[Any] = [None] * len(tasks)
        try:
            for future in _dask().as_completed(futures):
                place = places[future]
                answers[place] = _answer(future)
                if finished is not None:
                    finished(place, answers[place])
        finally:
            with suppress(Exception):  # the scheduler may be what is gone
                self._client.cancel(futures, force=True)
        return answers

    def _check(self, address: str, out: Path) -> None:
        """Find workers, and that they are like this process and see its folder."""
        out.mkdir(parents=True, exist_ok=True)
        mark = out / f".seen-{uuid.uuid4().hex}"
        mark.touch()
        try:
            seen: dict[str, bool] = self._client.run(mark.is_file)
            theirs: dict[str, dict[str, str]] = self._client.run(_versions)
        finally:
            mark.unlink()
        if not seen:
            msg = f"--scheduler: {address} has no workers; start some with `dask worker {address}`"
            raise InputError(msg)
        blind = [worker for worker, sees in seen.items() if not sees]
        if blind:
            msg = (
                f"--scheduler: the worker {blind[0]} does not see {out} ({len(blind)} of "
                f"{len(seen)}); --out must be a folder that all workers share under one path"
            )
            raise InputError(msg)
        ours = _versions()
        for worker, others in theirs.items():
            for package, here in ours.items():
                if others.get(package) != here:
                    msg = (
                        f"--scheduler: the worker {worker} has {package} "
                        f"{others.get(package)}, here it is {here}; data of two versions do not mix"
                    )
                    raise InputError(msg)


def _dask() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        msg = f"--scheduler needs Dask: pip install 'mbds-xsim[cluster]' ({error})"
        raise InputError(msg) from error


def _carry_out(task: Task) -> Any:
    """Run in a Dask worker."""
    (answer,) = run_tasks([task], workers=1)
    return answer


def _answer(future: Any) -> Any:
    if future.status == "finished":
        return future.result()
    return Crash(f"the cluster lost it: {type(future.exception()).__name__} {future.exception()}")


def _versions() -> dict[str, str]:
    """Versions that decide what data come out."""
    found = {"python": sys.version.split()[0]}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found

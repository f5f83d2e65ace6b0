"""Execution of tasks on a Dask cluster whose workers see the same folder.

A Dask worker runs each task in a process of its own, as on a single machine, so an engine that
crashes does not end the worker. If a worker is lost, the scheduler gives its tasks to another one.
"""

from __future__ import annotations

import platform
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.frame import optional
from mbds_xsim.base.isolate import Carrier, Task, run_tasks
from mbds_xsim.simulate.registry import package_version

_PATIENCE = 10.0  # longest wait for the scheduler's first answer [s]
_LOOK = 0.5  # interval between two checks for ended tasks [s]
_FETCH = 10.0  # longest time to fetch an answer that is ready [s]
_GRACE = 30.0  # longest wait for a new worker after the last one is gone [s]
_AWAITED = ("pending", "lost")
_PACKAGES = (
    "mbds-xsim", "mujoco", "pybullet", "dartpy", "exudyn", "pin", "drake", "mujoco-warp",
    "warp-lang", "numpy", "h5py",
)  # fmt: skip


def carrier_of(
    stack: ExitStack, address: str | None, workers: int | None, out: Path
) -> tuple[Carrier, int | None]:
    """Return the carrier of tasks, local processes or a cluster, and the number of tasks at a time.

    For local processes this number is `workers` as given. The stack closes the connection to a
    cluster, whose workers must see the folder `out`.

    Raises:
        InputError: Both `address` and `workers` are given, or the cluster cannot be used.
    """
    if address is None:
        return run_tasks, workers
    if workers is not None:
        msg = "--workers and --scheduler: got both, allowed is one; a cluster has its own workers"
        raise InputError(msg)
    cluster = stack.enter_context(Cluster(address, out))
    return cluster, cluster.workers


class Cluster(AbstractContextManager["Cluster"]):
    """Dask cluster as a `Carrier`; use it in a `with` block.

    Args:
        address: Address of the scheduler, such as `tcp://host:8786`.
        out: Folder of the data; every worker must see it under this path.

    Raises:
        InputError: Dask is missing, no scheduler answers, or workers are missing or unsuitable.
    """

    def __init__(self, address: str, out: Path) -> None:
        self._address = address
        try:
            self._client = optional("distributed", "--scheduler", "cluster").Client(
                address, timeout=_PATIENCE
            )
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler: got {address!r}, where no Dask scheduler answers within "
                f"{_PATIENCE:g} s; start one with `dask scheduler`, workers with "
                "`dask worker ADDRESS`"
            ) from error
        try:
            self._check(out.absolute())
        except InputError:
            self._client.close()
            raise

    @property
    def workers(self) -> int:
        """Number of tasks that the cluster carries out at a time."""
        try:
            return sum(self._client.nthreads().values())
        except Exception as error:
            raise self._disconnection(error) from error

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def __call__(
        self, tasks: Sequence[Task], *, finished: Callable[[int, Any], None] | None = None, **_: Any
    ) -> list[Any]:
        """Carry out all tasks; the cluster decides how many run at a time."""
        answers: list[Any] = [None] * len(tasks)
        futures: list[Any] = []
        try:
            futures += [self._client.submit(_carry_out, task, pure=False) for task in tasks]
            for place, answer in self._as_they_end(futures):
                answers[place] = answer
                if finished is not None:
                    finished(place, answers[place])
        finally:
            with suppress(Exception):  # the scheduler itself may be gone
                self._client.cancel(futures, force=True)
        return answers

    def _check(self, out: Path) -> None:
        """Check that there are workers, that they see the folder, and that their versions match."""
        out.mkdir(parents=True, exist_ok=True)
        mark = out / f".seen-{uuid.uuid4().hex}"
        mark.touch()
        try:
            sight = self._ask_workers(mark.is_file)
        finally:
            mark.unlink()
        if not sight:
            here = self._address
            msg = f"--scheduler: {here} has no workers; start some with `dask worker {here}`"
            raise InputError(msg)
        blind = [worker for worker, sees in sight.items() if sees is not True]
        if blind:
            raise InputError(
                f"--scheduler: the worker {blind[0]} does not see {out} ({len(blind)} of "
                f"{len(sight)}); --out must be a folder that all workers share under one path"
            )
        self._alike("python", self._ask_workers(platform.python_version), platform.python_version())
        for package in _PACKAGES:
            self._alike(package, self._ask_workers(version, package), package_version(package))

    def _alike(self, package: str, theirs: dict[str, Any], here: str) -> None:
        """Refuse workers with another version of a package, which could give different data."""
        for worker, answer in theirs.items():
            there = "not installed" if isinstance(answer, PackageNotFoundError) else answer
            if there != here:
                raise InputError(
                    f"--scheduler: on the worker {worker} {package} is {there}, here it is {here}; "
                    "data of two versions do not mix: install the same on all workers"
                )

    def _ask_workers(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """Call a function on every worker: one of the standard library, which all of them have."""
        try:
            answers: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        except Exception as error:
            raise self._disconnection(error) from error
        return answers

    def _as_they_end(self, futures: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Yield the index and answer of each future as it ends, as long as there are workers.

        An answer may be lost with the worker that holds it: the scheduler has it made again.

        Raises:
            InputError: No future can end any more: the scheduler or all workers are gone.
        """
        pending = dict(enumerate(futures))
        last = time.monotonic()
        while pending:
            ended = [place for place, future in pending.items() if future.status not in _AWAITED]
            before = len(pending)
            for place in ended:
                try:
                    answer = self._answer(pending[place])
                except OSError:  # the transfer broke off; the workers are checked below
                    continue
                del pending[place]
                yield place, answer
            if len(pending) == before:
                time.sleep(_LOOK)
                last = time.monotonic() if self.workers else last
                if time.monotonic() - last > _GRACE:
                    raise InputError(
                        f"--scheduler: no workers for {_GRACE:g} s; see their logs, "
                        f"start some with `dask worker {self._address}`, and run the same command "
                        "again to continue"
                    )

    def _answer(self, future: Any) -> Any:
        """Return the answer of a task.

        Raises:
            InputError: The task could not be carried out, and no other could.
            OSError: The answer does not arrive, or is no longer available.
        """
        status = future.status
        if status == "finished":
            return future.result(timeout=_FETCH)
        if status in _AWAITED:
            raise TimeoutError
        if status != "error":
            raise self._disconnection(status)
        error = future.exception()
        msg = (
            f"--scheduler: workers cannot carry out tasks: {type(error).__name__}: {error}; "
            "see their logs, install the same on all, and run the same command again to continue"
        )
        raise InputError(" ".join(msg.split()))

    def _disconnection(self, cause: object) -> InputError:
        reason = f"{type(cause).__name__}: {cause}" if isinstance(cause, Exception) else str(cause)
        return InputError(
            f"--scheduler: {self._address} is gone ({' '.join(reason.split())}); start it again "
            "with `dask scheduler`, and run the same command again to continue"
        )


def _carry_out(task: Task) -> Any:
    """Run a task on a Dask worker, in a process of its own."""
    (answer,) = run_tasks([task], workers=1)
    return answer

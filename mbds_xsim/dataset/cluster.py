"""Have tasks carried out by a Dask cluster, whose workers see the same folder.

A task goes to a Dask worker and there into a process of its own, as it does on one machine: an
engine that crashes takes no worker with it. A worker that is lost is the scheduler's to replace;
what it was at is tried again.
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

_PATIENCE = 10.0  # for the scheduler's first answer [s]
_LOOK = 0.5  # between two looks at what has ended [s]
_FETCH = 10.0  # for an answer that is there [s]
_GRACE = 30.0  # for another worker, where the last one is gone [s]
_AWAITED = ("pending", "lost")
_PACKAGES = ("mbds-xsim", "mujoco", "pybullet", "dartpy", "exudyn", "numpy", "h5py")


def carrier_of(
    stack: ExitStack, address: str | None, workers: int | None, out: Path
) -> tuple[Carrier, int | None]:
    """Give what carries tasks out, and how many at a time: processes here, or a cluster.

    The stack lets go of the cluster, whose workers must see the folder.

    Raises:
        InputError: Both are given, or the cluster is not one that could.
    """
    if address is None:
        return run_tasks, workers
    if workers is not None:
        msg = "--workers and --scheduler: got both, allowed is one; a cluster has its own workers"
        raise InputError(msg)
    cluster = stack.enter_context(Cluster(address, out))
    return cluster, cluster.workers


class Cluster(AbstractContextManager["Cluster"]):
    """A `Carrier`; use it in a `with` block.

    Args:
        address: Of the scheduler, as `tcp://host:8786`.
        out: Folder of the data; every worker must see it under this path.

    Raises:
        InputError: Dask is not installed, nobody answers, there is no worker, or one differs.
    """

    def __init__(self, address: str, out: Path) -> None:
        self._address = address
        try:
            self._client = optional("distributed", "--scheduler", "cluster").Client(
                address, timeout=_PATIENCE
            )
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
        try:
            return sum(self._client.nthreads().values())
        except Exception as error:
            raise self._lost(error) from error

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def __call__(
        self,
        tasks: Sequence[Task],
        *,
        finished: Callable[[int, Any], None] | None = None,
        **_: Any,
    ) -> list[Any]:
        """Carry out all tasks; how many at a time is the cluster's own affair."""
        answers: list[Any] = [None] * len(tasks)
        futures: list[Any] = []
        try:
            futures += [self._client.submit(_carry_out, task, pure=False) for task in tasks]
            for place, answer in self._as_they_end(futures):
                answers[place] = answer
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
            sight = self._asked(mark.is_file)
        finally:
            mark.unlink()
        if not sight:
            msg = f"--scheduler: {address} has no workers; start some with `dask worker {address}`"
            raise InputError(msg)
        blind = [worker for worker, sees in sight.items() if sees is not True]
        if blind:
            msg = (
                f"--scheduler: the worker {blind[0]} does not see {out} ({len(blind)} of "
                f"{len(sight)}); --out must be a folder that all workers share under one path"
            )
            raise InputError(msg)
        self._alike("python", self._asked(platform.python_version), platform.python_version())
        for package in _PACKAGES:
            self._alike(package, self._asked(version, package), package_version(package))

    def _alike(self, package: str, theirs: dict[str, Any], here: str) -> None:
        """Compare versions, which decide what data come out."""
        for worker, answer in theirs.items():
            there = "not installed" if isinstance(answer, PackageNotFoundError) else answer
            if there != here:
                msg = (
                    f"--scheduler: on the worker {worker} {package} is {there}, here it is {here}; "
                    "data of two versions do not mix: install the same on all workers"
                )
                raise InputError(msg)

    def _asked(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """Call a function of the standard library, which a worker has, in each of them."""
        try:
            answers: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        except Exception as error:
            raise self._lost(error) from error
        return answers

    def _as_they_end(self, futures: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Give the answer of each future with its place; while none ends, see whether one can.

        An answer may get lost with the worker that holds it: the scheduler has it made again.

        Raises:
            InputError: None can: the scheduler is gone, or all workers are.
        """
        pending = dict(enumerate(futures))
        last = time.monotonic()
        while pending:
            ended = [place for place, future in pending.items() if future.status not in _AWAITED]
            came = False
            for place in ended:
                try:
                    answer = self._answer(pending[place])
                except OSError:  # broken off as it came; whether anybody is there is asked below
                    continue
                came = True
                del pending[place]
                yield place, answer
            if not came:
                time.sleep(_LOOK)
                last = time.monotonic() if self.workers else last
                if time.monotonic() - last > _GRACE:
                    msg = (
                        f"--scheduler: no worker has been left for {_GRACE:g} s; see their logs, "
                        f"start some with `dask worker {self._address}`, and run the same command "
                        "again, it goes on"
                    )
                    raise InputError(msg)

    def _answer(self, future: Any) -> Any:
        """Give what came of a task.

        Raises:
            InputError: It was not carried out, and no other will be.
            OSError: The answer does not come, or is no longer there.
        """
        status = future.status
        if status == "finished":
            return future.result(timeout=_FETCH)
        if status in _AWAITED:
            raise TimeoutError
        if status != "error":
            raise self._lost(status)
        error = future.exception()
        msg = (
            f"--scheduler: workers cannot carry out tasks: {type(error).__name__}: {error}; "
            "see their logs, install the same on all, and run the same command again, it goes on"
        )
        raise InputError(" ".join(msg.split()))

    def _lost(self, why: object) -> InputError:
        reason = f"{type(why).__name__}: {why}" if isinstance(why, Exception) else str(why)
        return InputError(
            f"--scheduler: {self._address} is gone ({' '.join(reason.split())}); start it again "
            "with `dask scheduler`, and run the same command again, it goes on"
        )


def _carry_out(task: Task) -> Any:
    """Run in a Dask worker."""
    (answer,) = run_tasks([task], workers=1)
    return answer

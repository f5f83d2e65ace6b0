"""The same data from a Dask cluster, of one worker or two, one of which is killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from mbds_xsim.choice import Choice
from mbds_xsim.dataset.cluster import Cluster
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.errors import InputError
from mbds_xsim.scene import Scene

from .conftest import TRAJECTORIES, Silence, contents

pytest.importorskip("distributed")

Start = Callable[[], subprocess.Popen[bytes]]


class Farm:
    """A scheduler and its workers, each a program of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._running = folder, list[subprocess.Popen[bytes]]()
        file = folder / "scheduler.json"
        options = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard")
        self._start("scheduler", *options, "--port", "0")
        self.address = str(json.loads(_when_written(file))["address"])

    def worker(self) -> subprocess.Popen[bytes]:
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"
        )

    def _start(self, what: str, *words: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{what}.log").open("ab") as log:
            program = subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_" + what, *words],
                stdout=log,
                stderr=log,
                cwd=self._folder,
            )
        self._running.append(program)
        return program

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


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    farm = Farm(tmp_path)
    try:
        yield farm
    finally:
        farm.close()


def _wait_for_workers(farm: Farm, count: int) -> None:
    from distributed import Client

    with Client(farm.address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        client.wait_for_workers(count, timeout=60)


def _made(farm: Farm, scene: Scene, out: Path, progress: Silence | None = None) -> dict[str, str]:
    request = Request((scene,), Choice.parse(engines="mujoco"), TRAJECTORIES, out)
    with Cluster(farm.address, out) as cluster:
        generate(
            request,
            workers=cluster.workers,
            progress=progress or Silence(),
            carry_out=cluster,
        )
    return contents(out)


@pytest.mark.slow
def test_workers_of_a_cluster_make_the_same_data_and_one_may_die(
    farm: Farm, rod: Scene, whole: Path, tmp_path: Path
) -> None:
    first, second = farm.worker(), farm.worker()
    _wait_for_workers(farm, 2)
    assert _made(farm, rod, tmp_path / "two") == contents(whole)

    class Murder(Silence):
        """Kills a worker as soon as there is something to lose."""

        def advance(self, done: int, rejected: int) -> None:
            super().advance(done, rejected)
            if done and second.poll() is None:
                os.kill(second.pid, signal.SIGKILL)

    assert _made(farm, rod, tmp_path / "killed", Murder()) == contents(whole)
    assert second.wait(timeout=30) == -signal.SIGKILL
    assert first.poll() is None
    assert _made(farm, rod, tmp_path / "one") == contents(whole)


@pytest.mark.slow
def test_a_cluster_that_cannot_do_it_is_one_clear_line(
    farm: Farm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"has no workers; start some with `dask worker"):
        Cluster(farm.address, tmp_path / "out")
    farm.worker()
    _wait_for_workers(farm, 1)
    monkeypatch.setattr("mbds_xsim.dataset.cluster._PACKAGES", ("rich",))  # here, not there
    with pytest.raises(InputError, match=r"has rich None, here it is \S+; data of two versions"):
        Cluster(farm.address, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_no_scheduler_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbds_xsim.dataset.cluster._PATIENCE", 1.0)
    expected = re.escape("--scheduler: got 'tcp://127.0.0.1:9', where no Dask scheduler answers")
    with pytest.raises(InputError, match=expected):
        Cluster("tcp://127.0.0.1:9", tmp_path)

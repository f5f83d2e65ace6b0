"""Campaign: a Dask cluster that loses its scheduler or workers, or never could do the work."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from mbds_xsim.base.isolate import Task
from mbds_xsim.dataset import cluster
from mbds_xsim.dataset.cluster import Cluster
from tests.farm import Farm
from tests.fuzz.campaign import cases_of, fuzz, refused

pytest.importorskip("distributed")

_TASKS = [Task(time.sleep, (0.2,))] * 4
_SAME = "install the same on all workers"
_FAULTS = {
    "a worker of two is killed": "",
    "the scheduler is killed": "is gone .*; start it again with `dask scheduler`, and run the same",
    "the last worker is killed": "no workers for 1 s; see their logs, start some with",
    "a worker lacks the package": f"mbds-xsim is not installed, here it is .*: {_SAME}",
    # A worker that cannot even read a task gives up.
    "another lacks it later": "no workers for 1 s; see their logs|cannot carry out ta",
}
_LATEST = len(_TASKS) - 2 if cases_of("dask") > len(_FAULTS) else 0  # after the last is too late


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Give up soon on a cluster without workers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "_GRACE", 1.0)
        yield tmp_path_factory.mktemp("clusters")


@pytest.mark.slow
@fuzz("dask", fault=st.sampled_from([*_FAULTS]), done=st.integers(0, _LATEST))
def test_a_fault_of_the_cluster_is_one_line_and_no_silence(
    folder: Path, fault: str, done: int
) -> None:
    place = Path(tempfile.mkdtemp(dir=folder))
    answers: list[Any] = []
    with closing(Farm(place)) as farm:
        line = refused(lambda: answers.extend(_carried_out(farm, place, fault, done)))

    assert re.search(_FAULTS[fault] or "^$", line), line
    assert "\n" not in line
    assert line or answers == [None] * len(_TASKS)


def _carried_out(farm: Farm, place: Path, fault: str, done: int) -> list[Any]:
    bare = fault == "a worker lacks the package"
    workers = [farm.worker(bare=bare)]
    if fault == "a worker of two is killed":
        workers.append(farm.worker())
    farm.wait_for(len(workers))

    def strike(number: int, _answer: Any) -> None:
        if number != done:
            return
        if fault == "the scheduler is killed":
            farm.scheduler.kill()
            return
        if fault == "another lacks it later":
            farm.worker(bare=True)
            farm.wait_for(2)
        workers[-1].kill()

    with Cluster(farm.address, place) as carrier:
        return carrier(_TASKS, finished=strike)

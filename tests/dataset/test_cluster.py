"""The same data from a Dask cluster, of one worker or two, one of which is killed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.cluster import _PACKAGES, Cluster
from mbds_xsim.dataset.generate import Request, generate
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import installed_engines, is_foreign, load_adapter
from tests.farm import Farm

from .conftest import TRAJECTORIES, Silence, contents

pytest.importorskip("distributed")


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
    farm.wait_for(2)
    assert _made(farm, rod, tmp_path / "two") == contents(whole)

    class Murder(Silence):
        """Progress sink that kills a worker as soon as there are data to lose."""

        def made(self, done: int, rejected: int) -> None:
            super().made(done, rejected)
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
    farm.wait_for(1)
    monkeypatch.setattr("mbds_xsim.dataset.cluster.package_version", lambda _: "0.1")
    with pytest.raises(
        InputError, match=r"mbds-xsim is \S+, here it is 0\.1; data of two versions"
    ):
        Cluster(farm.address, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_the_versions_of_every_engine_are_compared() -> None:
    """Data of two versions of an engine do not mix, whichever engine it is."""
    engines = {load_adapter(name).package for name in installed_engines() if not is_foreign(name)}
    assert engines | {"drake", "mujoco-warp", "pin", "warp-lang"} <= {*_PACKAGES}


def test_no_scheduler_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbds_xsim.dataset.cluster._PATIENCE", 1.0)
    expected = re.escape("--scheduler: got 'tcp://127.0.0.1:9', where no Dask scheduler answers")
    with pytest.raises(InputError, match=expected):
        Cluster("tcp://127.0.0.1:9", tmp_path)


def test_an_answer_that_breaks_off_on_its_way_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = iter([ConnectionResetError(104, "reset by peer")])

    class Future:
        status = "finished"

        def result(self, timeout: float) -> str:
            for error in broken:
                raise error
            return f"within {timeout:g} s"

    monkeypatch.setattr(Cluster, "workers", 1)
    cluster = Cluster.__new__(Cluster)
    assert list(cluster._as_they_end([Future()])) == [(0, "within 10 s")]

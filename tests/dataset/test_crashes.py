"""An engine that ends its process: its fatal trajectories are found, the others are made."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import LIMIT, Crash, Task
from mbds_xsim.dataset import gate, shard
from mbds_xsim.dataset.generate import Generated, Request, generate
from mbds_xsim.dataset.shard import stage_times
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.timed import Simulation, simulate

from .conftest import Make, Silence, contents

FATAL = (7, 21, 22)
FILE = "1pendulum/mujoco-matched.h5"


def fork(
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    finished: Callable[[int, Any], None] | None = None,
) -> list[Any]:
    """Carry out each task in a copy of this process, as `run_tasks` does in fresh ones."""
    del workers
    answers = []
    for place, task in enumerate(tasks):
        pickle.dumps((task.function, task.arguments))  # tasks of other processes must be picklable
        child = os.fork()
        if child == 0:
            task.function(*task.arguments)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        answers.append(Crash(f"ended with {code}") if code else None)
        if finished is not None:
            finished(place, answers[-1])
    return answers


def _make(scene: Scene, out: Path) -> Generated:
    request = Request((scene,), Choice.parse(engines="mujoco"), 40, out)
    return generate(request, workers=2, progress=Silence(), carry_out=fork)


def _fatal_to(indices: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    def deadly(*arguments: Any) -> Simulation:
        if np.isin(arguments[1].index, indices).any():
            os._exit(66)
        return simulate(*arguments)

    monkeypatch.setattr(shard, "simulate", deadly)


def test_the_trajectories_that_crash_are_rejected(
    rod: Scene, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _fatal_to(FATAL, monkeypatch)
    (count,) = _make(rod, tmp_path).variants
    assert (count.published, count.rejected) == (37, 3)
    assert count.rejected_by == {"ended early": 3}
    with h5py.File(tmp_path / FILE) as file, h5py.File(whole / FILE) as clean:
        index = file["index"][()]
        assert sorted(set(range(40)) - set(index.tolist())) == list(FATAL)
        for name in ("body/position", "position", "input/force"):
            assert np.array_equal(file[name][()], clean[name][()][index])
    with h5py.File(tmp_path / "rejected/1pendulum/mujoco-matched/0000000016.h5") as file:
        assert file["index"][()].tolist() == [21, 22]
        assert file["reason"].asstr()[0].startswith("ended at frame 0: ended with 66; finite: inf")
        assert np.isnan(file["body/position"][()]).all()


def test_models_are_read_back_where_others_crash_too(
    rod: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _fatal_to(FATAL, monkeypatch)
    monkeypatch.setattr(shard, "compare", lambda *_: ["mass: other"])
    (count,) = _make(rod, tmp_path).variants
    assert (count.published, count.rejected_by) == (0, {"read-back": 40})


def test_a_search_for_crashes_waits_no_longer_than_for_a_shard(
    rod: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float] = []

    def noted(tasks: Sequence[Task], **options: Any) -> list[Any]:
        waited.extend(task.timeout for task in tasks if task.function is shard.try_out)
        return fork(tasks, **options)

    _fatal_to(FATAL, monkeypatch)
    request = Request((rod,), Choice.parse(engines="mujoco"), 40, tmp_path)
    generate(request, workers=2, progress=Silence(), carry_out=noted)
    assert (min(waited), max(waited)) == (600.0, LIMIT)


def test_nothing_crashes_here(rod: Scene, whole: Path, tmp_path: Path) -> None:
    _make(rod, tmp_path)
    assert contents(tmp_path) == contents(whole)


def test_what_never_can_be_made_is_told(
    rod: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shard, "judge_rows", lambda *_: os._exit(67))
    with pytest.raises(
        InputError, match=r"1pendulum mujoco-matched: .* 0 to 15 cannot be made: ended with 67"
    ):
        _make(rod, tmp_path)
    assert contents(tmp_path) == {}


def test_an_engine_that_runs_at_no_other_step_fails_no_shard(
    rod: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = draw_batch(rod, [1])
    (contender, *_), _ = Choice.parse(engines="mujoco").contenders(rod)
    made = simulate(rod, batch, contender.engine, contender.settings).trajectory

    def refuse(*_: object) -> None:
        raise RuntimeError("not at this step")

    monkeypatch.setattr(gate, "simulate", refuse)

    assert gate.limit_faults(rod, contender, batch, made, None) == []


@pytest.mark.parametrize("lost", [b'{"first": 16, "cou', b""])
def test_a_log_that_lacks_a_shard_gives_no_times(lost: bytes, make: Make, tmp_path: Path) -> None:
    """A full disk cuts a line off, or a kill comes before it; the shards are whole."""
    made = tmp_path / make(tmp_path, trajectories=20).variants[0].file
    assert stage_times(made)["write_s"] > 0
    log = made.with_suffix("") / "log.jsonl"
    first, _ = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(first + lost)
    assert stage_times(made) == {}

"""Killed at any instant, on a full disk, twice at once: files stay whole, and runs go on."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mbds_xsim.base import files
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import locked
from mbds_xsim.dataset import shard
from mbds_xsim.dataset.hdf5 import check_content
from mbds_xsim.dataset.read import joined_files, load_dataset
from mbds_xsim.scene.file import save_scene
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import load_adapter

from .conftest import FILE, STEPS, TRAJECTORIES, Make, contents

KILLED = 9


def _in_a_child(work: Callable[[], object]) -> int:
    """Run a function in a copy of this process and return its exit code."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _die_at(call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """End the process, without any cleaning up, before its n-th step of writing files.

    Half of the bytes are then in the file that was to be written.
    """
    steps = iter(range(10_000))

    def count(original: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **named: Any) -> Any:
            if next(steps) == call:
                if original is write:
                    write(arguments[0], arguments[1][: len(arguments[1]) // 2])
                os._exit(KILLED)
            return original(*arguments, **named)

        return counted

    write = files._write
    monkeypatch.setattr(files, "_write", count(write))
    monkeypatch.setattr(os, "replace", count(os.replace))
    monkeypatch.setattr(files, "_flush_folder", count(files._flush_folder))
    monkeypatch.setattr(shard, "_log", count(shard._log))


_STEPS = 3 * 4 + 4 * 3
"""Steps of three shards (write, rename, flush, log) and of two joined files, the card and the
metadata (write, rename, flush)."""
_QUICK = (0, 1, 3, 14, 19)


@pytest.mark.parametrize(
    "call",
    [pytest.param(k, marks=[] if k in _QUICK else pytest.mark.slow) for k in range(_STEPS)],
)
def test_killed_at_any_step_it_goes_on(
    call: int, make: Make, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        _die_at(call, patch)
        assert _in_a_child(lambda: make(tmp_path)) == KILLED
    finished = contents(tmp_path)
    assert finished.items() <= contents(whole).items()  # no half-made file has its final name
    made = make(tmp_path).made
    shards = sum("mujoco-matched/" in name for name in finished)
    assert made == TRAJECTORIES - min(16 * shards, TRAJECTORIES)  # no trajectory is made twice
    assert contents(tmp_path) == contents(whole)
    assert not list(tmp_path.rglob("*.part"))


def test_every_step_of_writing_is_covered(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _die_at(_STEPS, monkeypatch)
    assert _in_a_child(lambda: make(tmp_path)) == 0


class _Program:
    """`mbds-xsim generate`, as a program of its own."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._file, self._settings = folder / "1pendulum.toml", folder / "settings.toml"
        save_scene(scene, self._file)
        preset = load_adapter("mujoco").settings(scene, "matched")
        count = preset.substeps(scene.clock.frame)
        text = f'[mujoco]\nmethod = "{preset.method}"\nsteps_per_frame = {count}\n'
        self._settings.write_text(text)

    def start(self, out: Path, *more: str, **options: Any) -> subprocess.Popen[str]:
        words = [str(self._file), "--trajectories", str(TRAJECTORIES)]
        words += ["--settings", str(self._settings)]
        return subprocess.Popen(
            [sys.executable, "-m", "mbds_xsim", "generate", *words, "--out", str(out), *more],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env=os.environ | {"PYTHONFAULTHANDLER": "1"},
            **options,
        )


@pytest.fixture
def program(rod: Scene, tmp_path: Path) -> _Program:
    return _Program(rod, tmp_path)


def test_ctrl_c_leaves_no_process_and_no_partial_file(program: _Program, tmp_path: Path) -> None:
    out = tmp_path / "out"
    running = program.start(out)
    while running.poll() is None and not list(out.rglob("log.jsonl")):
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGINT)
    err = _last_words(running)
    assert (running.returncode, err) in ((130, "mbds-xsim: interrupted\n"), (0, ""))
    assert not list(out.rglob("*.part"))
    with locked(out):  # nobody holds it
        pass


def test_what_a_killed_writer_leaves_goes_with_the_run(tmp_path: Path) -> None:
    before, within = (tmp_path / f".{name}.h5.host-1.part" for name in ("before", "within"))
    before.touch()

    def interrupted() -> None:
        with files.tidied([tmp_path, tmp_path / "none"]):
            assert not before.exists()
            within.touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not within.exists()


def _last_words(running: subprocess.Popen[str]) -> str:
    """Return a program's error output, which shows the line at which it hangs, if it does."""
    try:
        return running.communicate(timeout=120)[1]
    except subprocess.TimeoutExpired:
        running.send_signal(signal.SIGABRT)
        return running.communicate()[1]


def _killed_at_random(program: _Program, out: Path, rng: random.Random, within: float) -> bool:
    """Kill a run, or its workers, at some instant; return whether it was still running."""
    running = program.start(out)
    while running.poll() is None and not out.exists():
        time.sleep(0.005)
    time.sleep(rng.uniform(0.0, within))
    hit = running.poll() is None
    starters = _children(running.pid)
    workers = starters + [task for starter in starters for task in _children(starter)]
    victims = [running.pid] if rng.random() < 0.5 else workers or [running.pid]
    for victim in victims:
        _kill(victim)
    if running.pid not in victims:  # it notices that its workers died, and recovers
        assert running.wait(timeout=600) == 0
    running.communicate()
    for path in out.rglob("0*.h5"):
        assert check_content(path) is None
    return hit


def _children(process: int) -> list[int]:
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True, check=False
    )
    return [int(word) for word in listed.stdout.split()]


def _kill(process: int) -> None:
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return


@pytest.mark.slow
def test_killed_at_12_random_instants(
    program: _Program, make: Make, whole: Path, tmp_path: Path
) -> None:
    rng, within, kills = random.Random(0), 2.0, 0
    for folder in itertools.count():
        out = tmp_path / str(folder)
        for _ in range(4):
            if _killed_at_random(program, out, rng, within):
                kills += 1
            else:  # it had finished: this machine is faster, so strike sooner
                within *= 0.8
        make(out)
        assert contents(out) == contents(whole)
        if kills >= 12:
            return


def test_a_worker_killed_is_made_good_for(program: _Program, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    running = program.start(out, "--workers", "1")
    while not (workers := _children(running.pid)) and running.poll() is None:
        time.sleep(0.005)
    for worker in workers:
        _kill(worker)
    assert running.wait(timeout=600) == 0
    running.communicate()
    assert contents(out) == contents(whole)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 128 KiB, which one shard fits on."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)],
        check=False,
        capture_output=True,
    )
    if not mounted or mounted.returncode:
        pytest.skip("no disk can be mounted here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_is_one_line_and_what_is_finished_stays(
    make: Make, whole: Path, small_disk: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"cannot write .*No space left.*run the same command"):
        make(small_disk / "out", workers=1)
    left = contents(small_disk / "out")
    assert 1 <= len(left) < 5
    assert left.items() <= contents(whole).items()
    assert not list(small_disk.rglob("*.part"))
    shutil.copytree(small_disk / "out", tmp_path / "moved")
    make(tmp_path / "moved")
    assert contents(tmp_path / "moved") == contents(whole)


def test_a_file_too_large_for_the_system_is_one_line(make: Make, tmp_path: Path) -> None:
    """A limit of the file size acts like a quota, without a disk of its own."""

    def work() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            make(tmp_path)
        except InputError as error:
            if "cannot write" in str(error) and not list(tmp_path.rglob("*.part")):
                os._exit(KILLED)

    assert _in_a_child(work) == KILLED
    assert contents(tmp_path) == {}


def test_two_runs_at_once(make: Make, tmp_path: Path) -> None:
    with (
        locked(tmp_path),
        pytest.raises(InputError, match=rf"is in use by process {os.getpid()}; wait"),
    ):
        make(tmp_path)
    assert make(tmp_path, trajectories=3).made == 3


def test_a_file_system_without_locks_is_not_called_another_run(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(InputError, match=r"cannot lock .*: Function not implemented; name a f"):
        make(tmp_path)


def test_a_shard_that_is_cut_off_is_named_and_left_alone(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=3)
    path = tmp_path / "1pendulum/mujoco-matched/0000000000.h5"
    path.write_bytes(path.read_bytes()[:-5000])
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"0000000000.h5 cannot be read as HDF5.*delete it"):
        make(tmp_path, trajectories=3)
    assert contents(tmp_path) == before


def _mark(path: Path, key: str, value: object) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs[key] = value


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("layout_version", 99, "layout version 99, this program reads up to 1; install a newer"),
        (
            "layout_version",
            np.zeros((2, 2)),
            r"layout_version: got array\(.*allowed is a whole number from 0; get the file again",
        ),
        (
            "step_s",
            np.zeros((2, 1)),
            r"got array\(\[\[0.\], \[0.\]\]\), allowed is a positive number",
        ),
        ("format", "other", "is HDF5, but no mbds-xsim data file"),
        ("engine_version", "0.1", "its engine_version is '0.1', now asked for is"),
        ("scene", "name = 'x'", "its scene differs from the one given"),
    ],
)
def test_another_s_shard_is_named_and_left_alone(
    key: str, value: object, says: str, make: Make, tmp_path: Path
) -> None:
    make(tmp_path, trajectories=3)
    _mark(tmp_path / "1pendulum/mujoco-matched/0000000000.h5", key, value)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=says):
        make(tmp_path, trajectories=3)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("other", ["mujoco", "exudyn"])
def test_a_folder_of_another_seed(other: str, make: Make, tmp_path: Path) -> None:
    """Another seed is refused for the same engine and for one to be paired with it."""
    make(tmp_path, trajectories=3)
    with pytest.raises(InputError, match=r"its seed is 0, now asked for is 1; name another --out"):
        make(tmp_path, trajectories=3, seed=1, engines=other)


def test_fewer_than_there_are(make: Make, tmp_path: Path) -> None:
    make(tmp_path, trajectories=6)
    with pytest.raises(InputError, match=r"needed: 3; .*; ask for 6 or more, or"):
        make(tmp_path, trajectories=3)


def test_an_extension_that_was_interrupted(make: Make, tmp_path: Path) -> None:
    """Until it is done the finished set cannot be read, and every line says how to go on."""
    make(tmp_path, trajectories=6)
    finished = (tmp_path / FILE).read_bytes()
    make(tmp_path, trajectories=20)
    (tmp_path / FILE).write_bytes(finished)
    data = load_dataset(tmp_path / FILE)
    for read in (lambda: data.position[0], lambda: data.windows(2).take([0]), data.check):
        with pytest.raises(InputError, match=r"is being extended; run the larger `generate`"):
            read()
    with pytest.raises(InputError, match=r"holds 0000000016\.h5, which .*; ask for 20 or more,"):
        make(tmp_path, trajectories=6)
    assert make(tmp_path, trajectories=20).made == 0
    assert len(load_dataset(tmp_path / FILE).position[0]) == STEPS + 1


def test_files_of_other_programs_beside_the_data(make: Make, tmp_path: Path) -> None:
    """They are no variants: only a damaged file of our own is not passed over."""
    make(tmp_path, trajectories=3)
    folder = (tmp_path / FILE).parent
    for name in ("notes.h5", "my-notes.h5"):
        with h5py.File(folder / name, "w") as file:
            file["numbers"] = np.arange(3)
    make(tmp_path, trajectories=6)
    assert joined_files(tmp_path) == [tmp_path / FILE]
    with pytest.raises(InputError, match=r"my-notes\.h5 is HDF5, but no mbds-xsim data file"):
        joined_files(folder / "my-notes.h5")
    with h5py.File(tmp_path / FILE, "r+") as file:
        del file.attrs["format"]
    with pytest.raises(InputError, match=r"mujoco-matched\.h5 is HDF5, but no mbds-xsim data"):
        joined_files(tmp_path)


def test_a_target_that_is_no_folder(make: Make, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"--out: cannot write to .*file"):
        make(tmp_path / "file" / "data")

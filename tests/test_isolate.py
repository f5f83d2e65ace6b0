"""A crash, hang or error of one task leaves the others' answers alone."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mbds_xsim.base import isolate
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.reference import cache
from mbds_xsim.simulate import registry, timed


def test_answers_come_in_the_order_of_the_tasks() -> None:
    places: list[int] = []

    answers = run_tasks(
        [Task(math.factorial, (5,)), Task(math.hypot, (3.0, 4.0))],
        finished=lambda place, _: places.append(place),
    )

    assert answers == [120, 5.0]
    assert sorted(places) == [0, 1]


def test_a_task_waits_for_the_one_that_it_comes_after_even_if_that_crashes(tmp_path: Path) -> None:
    starts: list[int] = []
    mark = tmp_path / "mark"
    code = f"import os, time; time.sleep(0.2); open({str(mark)!r}, 'w').close(); os.abort()"
    tasks = [Task(exec, (code,)), Task(mark.exists, (), after=0), Task(math.factorial, (3,))]

    _, *answers = run_tasks(tasks, workers=3, started=starts.append)

    assert answers == [True, 6]
    assert starts == [0, 2, 1]


def test_what_hears_of_an_end_works_in_place_of_a_task_and_can_be_interrupted() -> None:
    places: list[int] = []

    def interrupted(place: int, _answer: object) -> None:
        places.append(place)
        signal.raise_signal(signal.SIGINT)
        places.append(-1)

    with pytest.raises(KeyboardInterrupt):
        run_tasks(
            [Task(math.factorial, (3,))] * 2, workers=1, started=places.append, finished=interrupted
        )

    assert places == [0, 0]


def test_no_task_needs_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", None)

    assert run_tasks([]) == []


def test_a_crash_is_told_and_the_rest_goes_on() -> None:
    crash, answer = run_tasks([Task(os.abort, ()), Task(math.factorial, (3,))])

    assert isinstance(crash, Crash)
    assert "SIGABRT" in crash.reason
    assert answer == 6


def test_a_hang_ends_at_its_timeout() -> None:
    begin = time.monotonic()

    (crash,) = run_tasks([Task(time.sleep, (60.0,), timeout=0.5)])

    assert crash == Crash("no answer within 0.5 s")
    assert time.monotonic() - begin < 20


def test_an_error_keeps_its_text_and_a_refusal_says_so() -> None:
    error, refusal = run_tasks(
        [Task(math.factorial, (-1,)), Task(registry.load_scene, ("nosuch",))]
    )

    assert isinstance(error, Crash)
    assert "ValueError" in error.reason
    assert not error.refused
    assert isinstance(refusal, Crash)
    assert refusal.refused
    assert "'nosuch'" in refusal.reason


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)

    run_tasks([Task(os.getcwd, ()), Task(os.abort, ())])

    assert list(tmp_path.iterdir()) == []


def test_no_workers_run_the_tasks_here_and_raise_their_errors() -> None:
    places: list[int] = []

    answers = run_tasks(
        [Task(os.getpid, ()), Task(math.factorial, (4,))],
        workers=0,
        finished=lambda place, _: places.append(place),
    )

    assert answers == [os.getpid(), 24]
    assert places == [0, 1]
    with pytest.raises(ValueError, match="negative"):
        run_tasks([Task(math.factorial, (-1,))], workers=0)


def test_fewer_workers_than_none_are_refused() -> None:
    with pytest.raises(ValueError, match="workers: got -1, allowed is 0 or more"):
        run_tasks([Task(math.factorial, (4,))], workers=-1)


def test_relative_folders_of_the_environment_are_the_same_for_a_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task works in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "found_by_a_relative_path.py").touch()
    (tmp_path / "found_where_the_caller_is.py").touch()
    monkeypatch.setenv("PYTHONPATH", "modules", prepend=os.pathsep)
    monkeypatch.syspath_prepend("")
    monkeypatch.setenv("XDG_CACHE_HOME", "elsewhere")
    monkeypatch.setenv("MBDS_XSIM_CACHE", "kept")

    modules = "found_by_a_relative_path, found_where_the_caller_is"
    imported, chosen = run_tasks([Task(exec, (f"import {modules}",)), Task(cache.directory, ())])
    own = cache.directory()
    monkeypatch.delenv("MBDS_XSIM_CACHE")
    usual = run_tasks([Task(cache.directory, ())])

    assert imported is None
    assert own == chosen == tmp_path / "kept"
    assert usual == [tmp_path / "elsewhere" / "mbds-xsim"]


def test_an_error_of_many_lines_is_one_line() -> None:
    (crash,) = run_tasks([Task(exec, ("raise RuntimeError('first\\nsecond')",))])

    assert crash == Crash("RuntimeError: first second")


def test_an_error_that_names_a_file_of_no_utf_8_can_be_written_down() -> None:
    (crash,) = run_tasks([Task(exec, ("raise OSError('no \\udcff.xml')",))])

    assert crash == Crash("OSError: no \\udcff.xml")


_BURN = "import time\nwhile time.process_time() < {}: pass"


def test_a_task_that_never_ends_ends_at_its_time_of_the_processor() -> None:
    (crash,) = run_tasks([Task(exec, (_BURN.format(60.0),), timeout=0.5)])

    assert isinstance(crash, Crash)
    assert (crash.reason, crash.timed_out) == ("no answer within 0.5 s", True)


def test_time_that_others_take_of_the_machine_is_not_the_task_s() -> None:
    """Many at once on few cores: each needs less than its limit, and waits for far more."""
    crowd = 8 * isolate.core_count()

    answers = run_tasks([Task(exec, (_BURN.format(0.6),), timeout=0.9)] * crowd, workers=crowd)

    assert answers == [None] * crowd


def test_the_start_of_a_process_is_no_part_of_its_time(tmp_path: Path) -> None:
    module = "import time\ntime.sleep(1.0)\ndef answer(): return 7"
    (tmp_path / "slow_to_import.py").write_text(module)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from mbds_xsim.base.isolate import *; "
        "import slow_to_import; print(run_tasks([Task(slow_to_import.answer, (), timeout=0.4)]))"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}

    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )

    assert ended.stdout == "[7]\n"


def test_the_time_of_a_task_begins_anew_with_each_of_its_parts() -> None:
    code = (
        "import time; from mbds_xsim.base.isolate import begin\n" + 4 * "begin(); time.sleep(0.4)\n"
    )

    assert run_tasks([Task(exec, (code,), timeout=1.0)]) == [None]


def test_a_task_that_takes_all_memory_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolate, "memory_bytes", lambda: 5e8)
    code = "kept = []\nwhile True: kept.append(bytearray(10**7))"

    leaking, sound = run_tasks([Task(exec, (code,)), Task(math.factorial, (3,))], workers=2)

    assert isinstance(leaking, Crash)
    assert leaking.reason.startswith("it had taken 0.")
    assert leaking.reason.endswith("when the memory ran out; fewer --workers leave more to each")
    assert sound == 6


def test_what_tasks_have_in_common_is_imported_once_and_no_engine_is_there() -> None:
    code = (
        "import sys; assert 'mbds_xsim.simulate.timed' in sys.modules; "
        "assert not {'mujoco', 'pybullet', 'dartpy', 'exudyn', 'torch'} & set(sys.modules)"
    )
    nothing = Task(timed.simulate, ())

    refused, answer = run_tasks([nothing, Task(exec, (code,))])

    assert isinstance(refused, Crash)
    assert refused.reason.startswith("TypeError")
    assert answer is None


def test_where_the_starter_has_threads_a_task_starts_from_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads do not survive a fork, and locks that they held stay held."""
    thread = "import threading, time; threading.Thread(target=time.sleep, args=(60,), daemon=True)"
    (tmp_path / "sitecustomize.py").write_text(f"{thread}.start()")
    code = "import sys; assert '--task' in sys.argv, sys.argv"

    alone = run_tasks([Task(exec, (code,))])
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    among_others = run_tasks([Task(exec, (code,))])

    assert isinstance(alone[0], Crash)
    assert among_others == [None]


def test_a_killed_starter_takes_only_what_it_has_started() -> None:
    kill = "import os, signal, time; os.kill(os.getppid(), signal.SIGKILL); time.sleep(60)"

    crash, answer = run_tasks([Task(exec, (kill,)), Task(math.factorial, (3,))], workers=1)

    assert crash == Crash("the process that starts tasks ended: without a word")
    assert answer == 6

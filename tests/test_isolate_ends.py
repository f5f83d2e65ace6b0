"""Tasks, what they have started and their files end with the program, its starter or their time."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.base.process import Interruptions
from tests.command_line import wait


def test_no_task_outlives_a_parent_that_is_killed(tmp_path: Path) -> None:
    file = tmp_path / "number"
    parent = subprocess.Popen([sys.executable, "-c", _PARENT.format(told=str(file))])
    wait(lambda: file.exists() and bool(file.read_text()))

    parent.kill()
    parent.wait()

    wait(lambda: not _alive(int(file.read_text())))


_PARENT = """
from mbds_xsim.base.process import Interruptions
from mbds_xsim.base.isolate import Task, run_tasks
code = "import os, time; open({told!r}, 'w').write(str(os.getpid())); time.sleep(60)"
run_tasks([Task(exec, (code,))])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it ends when C code lets go")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_task_that_hangs_in_c_does_not_outlive_the_programs_group(
    number: signal.Signals, tmp_path: Path
) -> None:
    """As `timeout` and terminals end a program; C code that holds the lock lets no thread run."""
    file = tmp_path / "number"
    hang = "import ctypes; ctypes.PyDLL(None).sleep(60)"
    code = f"import os; open({str(file)!r}, 'w').write(str(os.getpid())); {hang}"
    program = f"run_tasks([Task(exec, ({code!r},))])"
    parent = subprocess.Popen([sys.executable, "-c", _IMPORTS + program], process_group=0)
    wait(lambda: file.exists() and bool(file.read_text()))

    os.killpg(parent.pid, number)
    parent.wait()

    wait(lambda: not _alive(int(file.read_text())))


@pytest.mark.parametrize(
    ("then", "how"), [("time.sleep(60)", "no answer"), ("os.abort()", "SIGABRT"), ("", "")]
)
def test_what_a_task_has_started_ends_with_it(then: str, how: str, tmp_path: Path) -> None:
    file = tmp_path / "number"
    (answer,) = run_tasks([Task(exec, (_STARTS.format(told=str(file)) + then,), timeout=0.5)])

    assert how in (answer.reason if isinstance(answer, Crash) else "")
    wait(lambda: not _alive(int(file.read_text())))


@pytest.mark.parametrize("culprit", ["parent", "starter"])
def test_what_a_task_has_started_outlives_no_one(culprit: str, tmp_path: Path) -> None:
    file, starter = tmp_path / "number", tmp_path / "starter"
    code = _STARTS.format(told=str(file)) + f"open({str(starter)!r}, 'w').write(str(os.getppid()))"
    program = f"run_tasks([Task(exec, ({code + _SLEEPS!r},))])"
    parent = subprocess.Popen([sys.executable, "-c", _IMPORTS + program])
    wait(lambda: starter.exists() and bool(starter.read_text()))

    os.kill(parent.pid if culprit == "parent" else int(starter.read_text()), signal.SIGKILL)
    parent.wait()

    wait(lambda: not _alive(int(file.read_text())))


def test_tasks_pause_with_the_program_and_go_on_with_it(tmp_path: Path) -> None:
    """Ctrl-Z and `fg` in a terminal."""
    file, starter = tmp_path / "number", tmp_path / "starter"
    code = _STARTS.format(told=str(file)) + f"open({str(starter)!r}, 'w').write(str(os.getppid()))"
    program = f"run_tasks([Task(exec, ({code + _SLEEPS!r},))])"
    parent = subprocess.Popen([sys.executable, "-c", _IMPORTS + program], process_group=0)
    wait(lambda: starter.exists() and bool(starter.read_text()))
    child, over = (Path(f"/proc/{number.read_text()}/status") for number in (file, starter))

    os.killpg(parent.pid, signal.SIGTSTP)
    wait(lambda: all("State:\tT" in each.read_text() for each in (child, over)))
    os.killpg(parent.pid, signal.SIGCONT)
    wait(lambda: "State:\tT" not in child.read_text())

    parent.kill()
    parent.wait()


_IMPORTS = "from mbds_xsim.base.isolate import Task, run_tasks\n"
_SLEEPS = "\ntime.sleep(60)"
_STARTS = """
import os, subprocess, time
open({told!r}, 'w').write(str(subprocess.Popen(["sleep", "60"]).pid))
"""


def test_files_of_a_task_that_is_ended_vanish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    code = "import tempfile, time; kept = tempfile.TemporaryDirectory(); time.sleep(60)"

    (crash,) = run_tasks([Task(exec, (code,), timeout=0.5)])

    assert crash == Crash("no answer within 0.5 s")
    assert list(tmp_path.iterdir()) == []


def test_an_engine_that_hangs_while_it_is_taken_down_is_not_waited_for() -> None:
    begin = time.monotonic()

    answers = run_tasks([Task(atexit.register, (time.sleep, 60.0))])

    assert answers == [time.sleep]
    assert time.monotonic() - begin < 30


@pytest.mark.parametrize("step", ["order", "listen"])
def test_interrupted_in_the_midst_of_a_step_it_ends_and_leaves_no_task(
    step: str, tmp_path: Path
) -> None:
    program = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED.format(step=step, folder=str(tmp_path))],
        timeout=60,
        check=False,
        capture_output=True,
        text=True,
    )

    assert program.stdout.split() == ["interrupted"], program.stderr
    started = [int(path.name) for path in tmp_path.iterdir()]
    assert started or step == "order"
    assert not any(_alive(number) for number in started)


_INTERRUPTED = """
import signal, time
from pathlib import Path
from mbds_xsim.base import isolate
from mbds_xsim.base.isolate import Task, run_tasks

code = "import os, time; open({folder!r} + f'/{{os.getpid()}}', 'w').close(); time.sleep(60)"


class Starter(isolate._Starter):
    def {step}(self, *words):
        super().{step}(*words)
        if {step!r} == "order" or list(Path({folder!r}).iterdir())[1:]:
            signal.raise_signal(signal.SIGINT)


isolate._Starter = Starter
try:
    run_tasks([Task(exec, (code,))] * 2, workers=2)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_tasks_of_a_program_that_ignores_interruptions_ignore_them() -> None:
    """An example is `for scene in …; do mbds-xsim … & done; wait`, which Ctrl-C leaves at work."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run_tasks([Task(signal.raise_signal, (signal.SIGINT,))], workers=1) == [None]
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupted(reached: list[str], number: int) -> None:
    with Interruptions() as interruptions:
        interruptions.let_through()
        signal.raise_signal(number)
        reached.append("the next step")
        if number == signal.SIGINT:
            interruptions.let_through()
        reached.append("the end")


@pytest.mark.parametrize(
    ("number", "reaches"),
    [(signal.SIGINT, ["the next step"]), (signal.SIGTERM, ["the next step", "the end"])],
)
def test_what_came_is_let_through_where_it_is_asked_for_or_at_the_end(
    number: int, reaches: list[str]
) -> None:
    before = signal.signal(number, signal.default_int_handler)
    reached: list[str] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            _interrupted(reached, number)
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)
    assert reached == reaches


def _alive(process: int) -> bool:
    status = Path(f"/proc/{process}/status")
    try:
        os.kill(process, 0)
        return "State:\tZ" not in status.read_text()  # a dead one may wait for its new parent
    except ProcessLookupError:
        return False
    except FileNotFoundError:  # it has just ended, or there is no such file for any process
        return not Path("/proc").exists()

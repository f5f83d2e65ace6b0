"""The processes that carry out the tasks of `mbds_xsim.base.isolate`: task in, answer out.

One process, the *starter*, imports what the tasks have in common (no engine) and forks for each of
them: a task has a process of its own, as fresh as a new interpreter, without the time that its
imports take. The starter takes orders from standard input, "start PLACE" or "kill PLACE", and
reports "began PLACE PROCESS" and "ended PLACE CODE" on standard output; PLACE is the index of the
task. When the starter or the process that gives the orders ends, all tasks end.

Each task has a process group of its own, so that what an engine starts ends with it. A terminal's
Ctrl-C does not reach it: the process that gives the orders decides how to act on it.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import importlib
import os
import pickle
import select
import signal
import sys
import threading
import traceback
from pathlib import Path

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import begin
from mbds_xsim.base.process import SEARCHED


class _ForkServer:
    def __init__(self) -> None:
        self._out = os.dup(1)
        os.dup2(2, 1)  # imports may print, but this pipe is for reports only
        self._woken, self._waking = os.pipe()
        self._lifeline, self._far_end = os.pipe()
        self._running: dict[str, int] = {}  # process ids, keyed by the index of the task
        # The process that gives the orders decides how to act on interruptions.
        self._interrupted = signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self._paused = signal.getsignal(signal.SIGTSTP)
        if self._paused is not signal.SIG_IGN:
            signal.signal(signal.SIGTSTP, self._pause)
        os.set_blocking(self._waking, False)
        signal.set_wakeup_fd(self._waking)

    def serve(self) -> None:
        """Follow orders until there are no more."""
        read = b""
        while True:
            ready, _, _ = select.select([0, self._woken], [], [])
            if self._woken in ready:
                os.read(self._woken, 4096)
                self._reap()
            if 0 in ready:
                if not (words := os.read(0, 4096)):
                    break
                *orders, read = (read + words).split(b"\n")
                for order in orders:
                    self._follow(*order.decode().split())
        for process in self._running.values():
            _tell(process, signal.SIGKILL)
            os.waitpid(process, 0)

    def _pause(self, *_: object) -> None:
        """Stop all tasks and then this process, as Ctrl-Z asks, until told to continue."""
        tasks = list(self._running.values())
        for process in tasks:
            _tell(process, signal.SIGSTOP)
        again = signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        signal.raise_signal(signal.SIGTSTP)  # the system ignores it if no shell can continue it
        signal.signal(signal.SIGTSTP, again)
        for process in tasks:
            _tell(process, signal.SIGCONT)

    def _follow(self, order: str, place: str) -> None:
        if order == "start":
            alone = _thread_count() == 1
            if not (process := os.fork()):
                self._be_the_task(place, alone)
            with contextlib.suppress(OSError):  # whichever of the two comes first does it
                os.setpgid(process, process)
            self._running[place] = process
            self._say(f"began {place} {process}")
        elif place in self._running:
            _tell(self._running[place], signal.SIGKILL)

    def _reap(self) -> None:
        for place, process in list(self._running.items()):
            ended, status = os.waitpid(process, os.WNOHANG)
            if ended:
                _tell(process, signal.SIGKILL)  # what it has started
                del self._running[place]
                self._say(f"ended {place} {os.waitstatus_to_exitcode(status)}")

    def _say(self, line: str) -> None:
        os.write(self._out, f"{line}\n".encode())

    def _be_the_task(self, place: str, alone: bool) -> None:
        os.setpgid(0, 0)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGTSTP, self._paused)
        signal.signal(signal.SIGINT, self._interrupted)
        log = os.open(f"{place}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number, target in ((0, self._lifeline), (1, log), (2, log)):
            os.dup2(target, number)
        for number in (self._out, self._woken, self._waking, self._lifeline, self._far_end, log):
            os.close(number)
        if not alone:
            command = [sys.executable, "-m", "mbds_xsim.base.worker", "--task", place]
            os.execv(sys.executable, command)
        _carry_out(Path(place).absolute())


def _tell(group: int, number: int) -> None:
    """Send a signal to a task and to all that it has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # they have ended
        os.killpg(group, number)


def _thread_count() -> int:
    """Count this process's threads. A fork copies only one, and perhaps locks of the others."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:  # unknown, as on systems other than Linux
        return 2


def _carry_out(place: Path) -> None:
    threading.Thread(target=_end_with_starter, daemon=True).start()
    _have_the_system_end_it()
    _be_first_to_go()
    try:
        function, arguments = pickle.loads(place.with_suffix(".task").read_bytes())
        begin(place.with_suffix(".begun"))
        answer: tuple[str, object] = ("done", function(*arguments))
    except InputError as error:
        answer = ("input error", str(error))
    except Exception as error:
        answer = ("raised", " ".join("".join(traceback.format_exception_only(error)).split()))
    partial = place.with_suffix(".part")
    partial.write_bytes(pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))
    os.replace(partial, place.with_suffix(".answer"))
    sys.stdout.flush()
    # The answer is stored: do not wait for an engine that may hang while it shuts down.
    os._exit(0)


def _be_first_to_go() -> None:
    """Make the system end this process, not the one that waits for it, if memory runs out."""
    with contextlib.suppress(OSError):  # only Linux has this file
        Path("/proc/self/oom_score_adj").write_text("1000")


def _have_the_system_end_it() -> None:
    """Make Linux end this task's group with the starter, even while C code lets no thread run."""
    with contextlib.suppress(OSError, AttributeError):
        lifeline = os.open("/proc/self/fd/0", os.O_RDONLY | os.O_NONBLOCK)
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC | os.O_NONBLOCK)


def _end_with_starter() -> None:
    """End this task when standard input ends: the starter has ended or was killed."""
    # Not sys.stdin, whose lock a waiting thread would hold when the interpreter shuts down.
    os.read(0, 1)
    os.killpg(0, signal.SIGKILL)


def _main(words: list[str]) -> None:
    # Behind its own folders, so that no module of this process is another than without them.
    sys.path += [each for each in os.environ[SEARCHED].split(os.pathsep) if each not in sys.path]
    if words[:1] == ["--task"]:
        _carry_out(Path(words[1]).absolute())
    starter = _ForkServer()
    for module in words:
        with contextlib.suppress(Exception):  # a task that needs it will report the error
            importlib.import_module(module)
    gc.freeze()
    starter.serve()
    os._exit(0)  # the process that gives the orders waits for this; a normal exit is slow


if __name__ == "__main__":
    _main(sys.argv[1:])

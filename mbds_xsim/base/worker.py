"""The process that carries out one task of `mbds_xsim.base.isolate`: task in, answer out."""

from __future__ import annotations

import os
import pickle
import sys
import threading
import traceback
from contextlib import suppress
from pathlib import Path

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.isolate import begin


def _main(task_path: Path, answer_path: Path, begun_path: Path) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _be_first_to_go()
    try:
        function, arguments = pickle.loads(task_path.read_bytes())
        begin(begun_path)
        answer: tuple[str, object] = ("done", function(*arguments))
    except InputError as error:
        answer = ("input error", str(error))
    except Exception as error:
        answer = ("raised", " ".join("".join(traceback.format_exception_only(error)).split()))
    partial = answer_path.with_suffix(".part")
    partial.write_bytes(pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))
    os.replace(partial, answer_path)


def _be_first_to_go() -> None:
    """Where memory runs out, the system is to end this process, and not the one that waits."""
    with suppress(OSError):  # there is no such file elsewhere than on Linux
        Path("/proc/self/oom_score_adj").write_text("1000")


def _end_with_parent() -> None:
    """Standard input ends when the parent does, be it killed: no engine goes on for nobody."""
    # Not sys.stdin, whose lock a waiting thread would hold when the interpreter shuts down.
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    _main(*map(Path, sys.argv[1:]))
    sys.stdout.flush()
    # The answer is there: an engine that hangs while it is taken down is not waited for.
    os._exit(0)

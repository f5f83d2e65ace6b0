"""Entry point of the command line: exit codes, and errors in one line.

`main` does the imports that take time, once it can already answer an interruption.
"""

from __future__ import annotations

import _thread
import io
import os
import signal
import sys
import threading
import warnings
from importlib import import_module
from types import FrameType
from typing import Any

from mbds_xsim.base.errors import InputError, Notice
from mbds_xsim.base.process import discard, tell, unwritten

_INTERRUPTED = 130
_FORMAT = warnings.formatwarning


def main() -> None:
    """Run the command line: 0 passed, 1 a check failed, 2 bad input, 130 interrupted."""
    # A request to end is treated like Ctrl-C: no process and no partial file may be left. The shell
    # has jobs in the background ignore Ctrl-C, and nohup the end of the terminal.
    asked = (number for number in (signal.SIGINT, signal.SIGHUP) if not _is_ignored(number))
    ends = (signal.SIGTERM, *asked)
    for number in ends:
        signal.signal(number, _end_at_once)
    os.environ.pop("MPLBACKEND", None)  # pictures go to files; an unknown backend breaks the import
    os.environ.setdefault("MUJOCO_GL", "disable")  # window toolkits take as long to load as MuJoCo
    import_module("mbds_xsim.commands")
    for number in ends:
        signal.signal(number, signal.default_int_handler)
    sys.unraisablehook = _interrupt_again
    warnings.formatwarning = _format
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(_run(sys.argv[1:] or ["--help"]))


def _is_ignored(number: signal.Signals) -> bool:
    return signal.getsignal(number) is signal.SIG_IGN


def _run(words: list[str]) -> int:
    """Run one command line and return its exit code; report errors in one line."""
    import typer

    from mbds_xsim.commands import app

    try:
        code = app(words, standalone_mode=False) or 0
        print(end="", flush=True)
    except typer.TyperException as error:
        return _complain(_usage(error), 2)
    except InputError as error:
        return _complain(str(error), 2)
    except MemoryError as error:
        return _complain(f"out of memory: {error}; ask for less at a time", 2)
    except OSError as error:
        discard(sys.stdout)  # or the interpreter would try again at its exit
        return _complain(str(error), 2)
    except KeyboardInterrupt:
        code = _INTERRUPTED
    if unwritten and code != _INTERRUPTED:
        return _complain(str(unwritten.pop()), 2)
    return _complain("interrupted", code) if code == _INTERRUPTED else int(code)


def _end_at_once(_number: int, _frame: FrameType | None) -> None:
    """End at once: nothing has begun, and an exception during an import would leave a traceback."""
    os.write(sys.stderr.fileno(), b"mbds-xsim: interrupted\n")
    os._exit(_INTERRUPTED)


def _format(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> str:
    """Write this toolkit's warnings as one line, and others with their place in the program."""
    if category is Notice:
        return f"mbds-xsim: {message}\n"
    return _FORMAT(message, category, *place, **more)


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Repeat an interruption that came while an object was being freed, which Python drops."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        threading.Timer(0.01, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(lost)


def _usage(error: Exception) -> str:
    """Describe an error in the words of a command line, and name the help to read."""
    text = str(getattr(error, "format_message", error.__str__)()).rstrip(".")
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "mbds-xsim"
    cause = error.__cause__
    if cause and hasattr(cause, "errors"):  # pydantic's, whose words do not have the value
        text += f"; got {cause.errors()[0]['input']!r:.60}"
    return f"{text}; see {command} --help"


def _complain(text: str, code: int) -> int:
    tell(text)
    return code


if __name__ == "__main__":
    main()

"""The command line: how a run of it ends, and what it says then."""

from __future__ import annotations

import io
import os
import signal
import sys
from importlib.metadata import version
from typing import Annotated

import typer

from mbds_xsim import commands
from mbds_xsim.commands.shared import app
from mbds_xsim.errors import InputError

__all__ = ["app", "commands", "main"]

_INTERRUPTED = 130


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"mbds-xsim {version('mbds-xsim')}")
        raise typer.Exit


_Version = Annotated[
    bool,
    typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version."),
]


@app.callback()
def _of_all_commands(_version: _Version = False) -> None: ...


def main() -> None:
    """Run the command line: 0 passed, 1 a check failed, 2 bad input, 130 interrupted."""
    # A request to end is as good as Ctrl-C: no process and no partial file may be left.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(_run(sys.argv[1:] or ["--help"]))


def _run(words: list[str]) -> int:
    """Carry out one command line; what goes wrong is told in one line."""
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
        _drop_output()
        return _complain(str(error), 2)
    except KeyboardInterrupt:
        code = _INTERRUPTED
    return _complain("interrupted", code) if code == _INTERRUPTED else int(code)


def _usage(error: typer.TyperException) -> str:
    """Say what is wrong with the words of a command line, and where to read on."""
    text = getattr(error, "format_message", error.__str__)()
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "mbds-xsim"
    return f"{text.rstrip('.')}; see {command} --help"


def _drop_output() -> None:
    """Standard output cannot be written to: keep the interpreter from trying again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(text: str, code: int) -> int:
    from mbds_xsim.safe_text import on_a_line

    print(f"mbds-xsim: {on_a_line(text)}", file=sys.stderr)
    return code

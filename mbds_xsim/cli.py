"""The command line. Every command imports what it needs when it runs: `--help` stays quick."""

from __future__ import annotations

import io
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mbds_xsim.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["app", "main"]

_INTERRUPTED = 130

app = typer.Typer(
    name="mbds-xsim",
    help="Multibody simulation data you can trust: one scene, four engines, cross-checked.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="A built-in name, a family with a size, or a file.")
]
JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write JSON; - is standard output.")
]


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
    print(f"mbds-xsim: {' '.join(text.split())}", file=sys.stderr)
    return code


@app.command(
    epilog="Examples:  mbds-xsim validate 3ladder  ·  mbds-xsim validate my.toml --engines mujoco"
)
def validate(
    scene: SceneName,
    engines: Annotated[
        str | None, typer.Option(help="Comma-separated; all installed when left out.")
    ] = None,
    settings: Annotated[
        str, typer.Option(help="matched, native, or both side by side (matched,native).")
    ] = "matched",
    trajectories: Annotated[
        int, typer.Option(help="Starts of each interval.", min=1, max=10_000)
    ] = 1,
    seed: Annotated[int, typer.Option(help="Seed of starts and inputs.", min=0)] = 0,
    method: Annotated[
        str | None, typer.Option(help="Step with this method, with --engines of one engine.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Step [s], a divisor of the frame interval.")
    ] = None,
    noise: Annotated[bool, typer.Option(help="Random forces.")] = True,
    inputs: Annotated[bool, typer.Option(help="Drawn inputs: wind, drives.")] = True,
    cache: Annotated[bool, typer.Option(help="Use stored reference solutions.")] = True,
    workers: Annotated[
        int | None, typer.Option(help="Processes at a time; all cores when left out.", min=1)
    ] = None,
    json: JsonFile = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a self-contained page.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as Markdown.")
    ] = None,
) -> None:
    """Run a scene in all engines, check every trajectory, and tell which to trust."""
    from mbds_xsim.report.terminal import print_table
    from mbds_xsim.result import to_json
    from mbds_xsim.validate import Choice, validate_with_evidence

    console = _console(json)
    choice = Choice.parse(engines=engines, profiles=settings, method=method, step=step)
    _writable(json=json, html=html, markdown=markdown)
    with _progress(console) as progress:
        validation, evidence = validate_with_evidence(
            _scene(scene),
            choice=choice,
            trajectories=trajectories,
            seed=seed,
            noise=noise,
            inputs=inputs,
            cache=cache,
            workers=workers,
            progress=progress,
            command=f"mbds-xsim {' '.join(sys.argv[1:])}",
        )
    print_table(validation, console)
    if html is not None:
        from mbds_xsim.report.page import write_page

        write_page(validation, evidence, html)
        console.print(f"page: {html}")
    if markdown is not None:
        from mbds_xsim.report.markdown import to_markdown
        from mbds_xsim.write import write_whole

        write_whole(markdown, to_markdown(validation).encode())
    _write_json(to_json(validation), json)
    raise typer.Exit(0 if validation.verdict != "fail" else 1)


@app.command()
def engines(
    json: JsonFile = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the page docs/engines.md instead.")
    ] = False,
) -> None:
    """List the engines, their methods, and what each cannot do."""
    from mbds_xsim.catalogue import engine_rows
    from mbds_xsim.report.engines_page import engines_page
    from mbds_xsim.report.lists import print_engines

    if markdown and json:
        msg = "engines gives one form at a time; choose one of --markdown and --json"
        raise InputError(msg)
    _writable(json=json)
    rows = engine_rows()
    if markdown:
        print(engines_page(rows), end="")
    else:
        print_engines(rows, _console(json))
    _write_json(_encoded(rows), json)


@app.command()
def scenes(json: JsonFile = None) -> None:
    """List the built-in scenes: size, degrees of freedom, what each needs of an engine."""
    from mbds_xsim.catalogue import scene_rows
    from mbds_xsim.report.lists import print_scenes

    _writable(json=json)
    rows = scene_rows()
    print_scenes(rows, _console(json))
    _write_json(_encoded(rows), json)


@app.command(
    epilog="Examples:  mbds-xsim show 3ladder --png ladder.png  ·  "
    "mbds-xsim show 5pendulum --native mujoco > pendulum.xml"
)
def show(
    scene: SceneName,
    toml: Annotated[bool, typer.Option("--toml", help="Print it as a scene file.")] = False,
    native: Annotated[
        str | None,
        typer.Option(metavar="ENGINE", help="Print exactly what this engine is given."),
    ] = None,
    settings: Annotated[str, typer.Option(help="With --native: matched or native.")] = "matched",
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it into a file.")] = None,
    start: Annotated[
        int | None,
        typer.Option(
            help="With --png: the start of this trajectory; else the reference pose.", min=0
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Say what a scene is and needs, draw it, or print what an engine is given."""
    from mbds_xsim.catalogue import native_text, scene_row
    from mbds_xsim.report.lists import print_scene
    from mbds_xsim.scene_file import write_scene

    if sum(map(bool, (toml, native, json))) > 1:
        msg = "show gives one form at a time; choose one of --toml, --native and --json"
        raise InputError(msg)
    if start is not None and png is None:
        msg = f"--start: got {start} without --png; it says which start is drawn, add --png FILE"
        raise InputError(msg)
    _writable(json=json, png=png)
    loaded = _scene(scene)
    if png is not None:
        from mbds_xsim.report.draw import draw_scene

        draw_scene(loaded, png, start=start)
    if native is not None:
        print(native_text(loaded, native, settings))
    elif toml:
        print(write_scene(loaded), end="")
    else:
        row = scene_row(loaded)
        print_scene(loaded, row, _console(json))
        _write_json(_encoded(row), json)


def _scene(name: str):  # type: ignore[no-untyped-def]
    from mbds_xsim.registry import load_scene

    return load_scene(name)


def _console(json: Path | None) -> Console:
    """Where people read: standard output, or standard error when JSON goes there."""
    from rich.console import Console

    return Console(stderr=json is not None and str(json) == "-")


def _progress(console: Console):  # type: ignore[no-untyped-def]
    from mbds_xsim.report.progress import ProgressBar

    return ProgressBar(console)


def _writable(**paths: Path | None) -> None:
    """Refuse, before long work, to write where nothing can be written."""
    from mbds_xsim.write import check_writable

    files = {option: path for option, path in paths.items() if path is not None}
    if str(files.get("json")) == "-":
        del files["json"]
    for option, path in files.items():
        check_writable(path, f"--{option}")
    if len({path.absolute() for path in files.values()}) < len(files):
        msg = f"{' and '.join(f'--{option}' for option in files)} both name {path}; give two files"
        raise InputError(msg)


def _write_json(text: bytes, path: Path | None) -> None:
    if path is None:
        return
    if str(path) == "-":
        print(text.decode())
        return
    from mbds_xsim.write import write_whole

    write_whole(path, text + b"\n")


def _encoded(value: object) -> bytes:
    import msgspec

    return msgspec.json.format(msgspec.json.encode(value), indent=2)

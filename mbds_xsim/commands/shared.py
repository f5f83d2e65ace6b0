"""Shared parts of the commands: help, common options, reading and writing.

Every command imports what it needs when it runs, so that `--help` stays quick.
"""

from __future__ import annotations

import inspect
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

from typer import Argument, BadParameter, Exit, Option, Typer
from typer.core import TyperCommand, TyperGroup

from mbds_xsim.base.errors import InputError
from mbds_xsim.base.text import each_once, encoded, in_json, in_utf8

if TYPE_CHECKING:
    from rich.console import Console

    from mbds_xsim.report.blocks import Block, Report
    from mbds_xsim.report.progress import ProgressBar
    from mbds_xsim.scene.scene import Scene

F = TypeVar("F", bound=Callable[..., Any])

_WRITES = ("--json", "--html", "--markdown", "--png", "--rollouts", "--csv", "--figures", "--out")

Chapter = Literal["check", "study", "data", "learn"]
"""Purpose of a command; the help lists chapters in this order."""

_TYPE = re.compile(r" <(?P<kind>[^>]*)>$")
_WORDS = {"str": "TEXT", "int": "NUMBER", "float": "NUMBER", "path": "PATH"}


class Command(TyperCommand):
    """Command whose help shows readable names instead of Python's types."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse empty words: an empty path would mean the current folder."""
        for word, before in zip(args, ["", *args], strict=False):
            if not word or re.fullmatch(r"--[a-z-]+=", word):
                option = word.rstrip("=") or (before if before.startswith("--") else "an argument")
                msg = "got an empty text; name something, or leave it out"
                raise BadParameter(msg, ctx, param_hint=option)
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Write `[STUDY…]` for `[[STUDY…]]...`, and `SCENE` for `{SCENE}`."""
        pieces = super().collect_usage_pieces(ctx)
        return [re.sub(r"^\{(.*)\}(\.\.\.)?$|^\[(\[.*\])\](\.\.\.)?$", r"\1\3", p) for p in pieces]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options."""
        for heading, kind in (("Arguments", "argument"), ("Options", "option")):
            params = (p for p in self.get_params(ctx) if p.param_type_name == kind)
            pairs = filter(None, (p.get_help_record(ctx) for p in params))
            word: str | Callable[[re.Match[str]], str] = "" if kind == "argument" else _readable
            rows = [(_TYPE.sub(word, name), text) for name, text in pairs]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


class Commands(TyperGroup):
    """List of commands by chapter, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section per chapter."""
        del ctx
        for chapter in get_args(Chapter):
            rows = [
                (name, " ".join((command.help or "").split("\n\n")[0].split()))
                for name, command in sorted(self.commands.items())
                if getattr(command, "rich_help_panel", "") == chapter
            ]
            with formatter.section(chapter.capitalize()):
                formatter.write_dl(rows)


def _readable(match: re.Match[str]) -> str:
    name = match["kind"].removesuffix(" range").removeprefix("list[").removesuffix("]")
    return f" {_WORDS.get(name, name)}"


app = Typer(
    name="mbds-xsim",
    help="Multibody simulation data you can trust: one scene, several engines, cross-checked.",
    cls=Commands,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"mbds-xsim {version('mbds-xsim')}")
        raise Exit


_Version = Annotated[
    bool, Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
]


@app.callback()
def _of_all_commands(_version: _Version = False) -> None: ...


def command(chapter: Chapter, *, name: str | None = None, writes: str = "") -> Callable[[F], F]:
    """Add a function to the command line, under its own name or another.

    The docstring is the help; its examples, at the end, have one line each.

    Args:
        chapter: Chapter of the help that lists it.
        name: Name of the command; the function's by default.
        writes: Options of `Outputs` that it has; the function takes these as one argument, `to`.
    """

    def add(function: F) -> F:
        text, heading, examples = inspect.cleandoc(function.__doc__ or "").partition("\n\nExample")
        first, *lines = examples.splitlines() or [""]
        epilog = heading.strip() + first + "  " + "  ·  ".join(map(str.strip, lines))
        register = app.command(
            name, cls=Command, rich_help_panel=chapter, help=text, epilog=epilog.strip() or None
        )
        register(_with_outputs(function, writes.split()) if writes else function)
        return function

    return add


def _with_outputs(function: F, names: list[str]) -> Callable[..., None]:
    """Return a function that has an option for each output instead of the argument `to`."""

    def run(**words: Any) -> None:
        to = Outputs(**{name: words.pop(name) for name in names})
        to.check(folder=words.get("out"))
        function(**words, to=to)

    outputs = inspect.signature(Outputs, eval_str=True).parameters
    own = inspect.signature(function, eval_str=True).parameters
    inputs = [each for each in own.values() if each.name != "to"]
    added = [outputs[name] for name in names]
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*inputs, *added)]
    vars(run)["__signature__"] = inspect.Signature(parameters)
    run.__name__ = function.__name__
    return run


def _complete_scene(incomplete: str) -> list[str]:
    from mbds_xsim.simulate.registry import scene_names

    return [name for name in scene_names() if name.startswith(incomplete)]


def _complete_engines(incomplete: str) -> list[str]:
    """Complete the last of several names separated by commas."""
    from mbds_xsim.simulate.registry import simulator_names

    before, comma, last = incomplete.rpartition(",")
    names = [name for name in simulator_names() if name not in before.split(",")]
    return [f"{before}{comma}{name}" for name in names if name.startswith(last)]


SceneName = Annotated[
    str,
    Argument(
        metavar="SCENE",
        help="A built-in name, a family with a size, or a file (.toml, .xml, .urdf, .sdf, .usda).",
        autocompletion=_complete_scene,
    ),
]
SceneNames = Annotated[
    list[str],
    Argument(
        metavar="SCENE…",
        help="Built-in names, families with a size, or files.",
        autocompletion=_complete_scene,
        callback=each_once,
    ),
]
EngineNames = Annotated[
    str | None,
    Option(
        metavar="NAMES",
        help="Comma-separated; all installed when left out.",
        autocompletion=_complete_engines,
    ),
]
Seed = Annotated[int, Option(help="Seed of starts and inputs.", min=0)]
CacheUse = Annotated[bool, Option(help="Use stored reference solutions.")]
WorkerCount = Annotated[
    int | None, Option(help="Processes at a time; all cores when left out.", min=1)
]
ModelPlaces = Annotated[
    list[Path] | None,
    Option(
        metavar="PATH",
        help="Trained models beside the engines: a file, a folder of models, or a pattern such as "
        "'models/*/*/*/all-s0.pt'; may be repeated.",
    ),
]
Device = Annotated[str, Option(help="cpu or cuda.")]
DeviceWorkers = Annotated[
    int | None, Option(help="Processes at a time; all cores when left out, 1 on cuda.", min=1)
]
LONGEST = 1e7
"""Upper bound of time limits [s]: JSON has no infinity, and a stored one could not be read."""


def seconds(told: str, least: float = 1.0) -> Any:
    """Declare a time limit [s] with a line of help."""
    return Option(help=told, min=least, max=LONGEST)


TimeLimit = Annotated[float, seconds("Time limit of each process that runs an engine [s].")]


def file(told: str) -> Any:
    """Declare an option that names a file, with a line of help."""
    return Option(metavar="FILE", help=told)


JsonFile = Annotated[Path | None, file("Write JSON; - is standard output.")]


@dataclass(frozen=True)
class Outputs:
    """Destinations of a command's result besides the terminal: options that many commands have."""

    json: JsonFile = None
    csv: Annotated[Path | None, file("Write all that was measured as CSV.")] = None
    html: Annotated[Path | None, file("Write a self-contained page.")] = None
    opened: Annotated[
        bool, Option("--open", help="Open the page in a browser; a temporary file without --html.")
    ] = False
    png: Annotated[Path | None, file("Write the pictures.")] = None
    markdown: Annotated[Path | None, file("Write the tables as Markdown.")] = None

    @property
    def console(self) -> Console:
        """Console for people: standard error if JSON goes to standard output."""
        return console_for(self.json)

    @property
    def paged(self) -> bool:
        """Whether a page is asked for."""
        return self.html is not None or self.opened

    def check(self, folder: Path | None = None, **others: Path | None) -> None:
        """Refuse files that cannot be written, or that the command reads, before long work."""
        from mbds_xsim.base.files import check_ending, check_writable, named_in

        read = named_in(shlex.split(command_line()))
        named = {**vars(self), "opened": None, **others}
        files = {k: v for k, v in named.items() if v and (k, str(v)) != ("json", "-")}
        targets = {os.path.realpath(folder): "out"} if folder else {}
        for option, path in files.items():
            check_writable(path, f"--{option}")
            real = os.path.realpath(path)
            inside = real.endswith((".h5", ".pt")) and any(real.startswith(f"{p}/") for p in read)
            if path.is_file() and (real in read or inside):
                raise InputError(f"--{option}: the command reads {path}; name another file")
            check_ending(path, f"--{option}")
            stream = path.exists() and not path.is_file()  # two of them may lead to one terminal
            place = os.path.abspath(path) if stream else real
            if (other := targets.setdefault(place, option)) != option:
                raise InputError(f"--{other} and --{option} both name {path}; name two places")

    def say(self, line: str) -> None:
        """Print a line whole, however narrow the terminal, so that a path in it can be copied."""
        self.console.print(line, highlight=False, soft_wrap=True)

    def print(self, blocks: Iterable[Block]) -> None:
        """Print what a terminal can show."""
        from mbds_xsim.report.terminal import print_blocks

        print_blocks(blocks, self.console)

    def show(self, report: Report) -> None:
        """Print a report."""
        from mbds_xsim.report.terminal import print_report

        print_report(report, self.console)

    def answer(self, blocks: Iterable[Block], result: object, name: str = "") -> None:
        """Print a command's answer, and write its result to the file of `--json`."""
        self.print(blocks)
        self.write_json(encoded(result, name))

    def pictured(self, reports: Iterable[Report]) -> list[Report]:
        """Link the picture, which is of all reports, in the first one's Markdown."""
        from mbds_xsim.report.files import link

        first, *rest = reports
        return [replace(first, picture=link(self.png, self.markdown)), *rest]

    def give(
        self, reports: Sequence[Report], title: str, result: bytes = b"", *, quiet: bool = False
    ) -> None:
        """Write the files asked for, and print where the page is.

        Args:
            reports: Reports, a chapter each.
            title: Title of a page of several reports; appended to that of one without a verdict.
            result: Result as JSON for the file of `--json`; nothing is written if it is empty.
            quiet: Whether to print nothing about the page.
        """
        from mbds_xsim.report.files import write_reports

        html = self.html
        if html is None and self.opened:
            import tempfile

            html = Path(tempfile.mkdtemp(prefix="mbds-xsim-")) / "page.html"
        if len(reports) == 1:
            (one,) = reports
            title = one.title if one.verdict else f"{one.title}: {title[:1].lower()}{title[1:]}"
        write_reports(reports, title, html=html, markdown=self.markdown)
        if html is not None and not quiet:
            self.say(f"page: {html}")
        if html is not None and self.opened:
            import webbrowser

            if not webbrowser.open(html.absolute().as_uri()):
                self.say("there is no browser to open it in; set BROWSER, or open it by hand")
        if result:
            self.write_json(result)

    def write_json(self, text: bytes) -> None:
        """Write JSON to the place that `--json` names, whole or not at all."""
        from mbds_xsim.base.files import write_whole

        if str(self.json) == "-":
            print(in_json(text.decode()))
        elif self.json is not None:
            write_whole(self.json, text + b"\n")


def command_line(*outputs: str) -> str:
    """Return the command as typed, without output options other than those in `outputs`."""
    words = iter(sys.argv[1:])
    arguments = []
    for word in words:
        name, joined, _ = word.partition("=")
        if name in outputs or name not in (*_WRITES, "--open"):
            arguments.append(word)
        elif name != "--open" and not joined:
            next(words, None)
    return in_utf8(shlex.join(["mbds-xsim", *arguments]))


def check_torch(command: str) -> None:
    """Refuse a command that needs learned models if torch is not installed."""
    if find_spec("torch") is None:
        msg = f"{command} needs torch, which is not installed: pip install 'mbds-xsim[learn]'"
        raise InputError(msg)


def scene_named(name: str) -> Scene:
    """Load a built-in scene, a family at a size, or a file, and show the progress.

    The losses of a model in another format are summarised in a line.
    """
    from mbds_xsim.report.losses import conclusion
    from mbds_xsim.simulate.registry import is_model, load_scene, read_model

    with progress_on(console_for(None)) as progress:
        progress.begin(1, f"reading {name}")
        if not is_model(name):
            return load_scene(name)
        imported = read_model(Path(name))
    text = f"{imported.file}: {conclusion(imported)}; see mbds-xsim import {shlex.quote(name)}"
    console_for(Path("-")).print(text, highlight=False, soft_wrap=True)
    return imported.scene


def console_for(json: Path | None) -> Console:
    """Return the console for people: standard error if JSON goes to standard output."""
    from mbds_xsim.report.terminal import Outlet

    return Outlet(stderr=str(json) == "-")


def progress_on(console: Console) -> ProgressBar:
    """Return the progress bar of long work."""
    from mbds_xsim.report.progress import ProgressBar

    return ProgressBar(console)

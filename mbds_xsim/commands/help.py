"""How the command line explains itself: commands by what they are for, sentences whole."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Literal, get_args

from typer import BadParameter
from typer.core import TyperCommand, TyperGroup

Chapter = Literal["check", "study", "data", "learn"]
"""What a command is for, in the order of the list."""

_TYPE = re.compile(r" <(?P<kind>[^>]*)>$")
_WORDS = {"str": "TEXT", "int": "NUMBER", "float": "NUMBER", "path": "PATH"}


class Command(TyperCommand):
    """A command whose help has readable names in the place of Python's types."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse words of no letters: an empty path would be the folder one stands in."""
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
            told = (p.get_help_record(ctx) for p in self.params_of(ctx, kind))
            rows = [(_TYPE.sub(_readable(kind), name), text) for name, text in filter(None, told)]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def params_of(self, ctx: Any, kind: str) -> list[Any]:
        """List the parameters of a kind."""
        return [p for p in self.get_params(ctx) if p.param_type_name == kind]


class Commands(TyperGroup):
    """The list of commands, by chapter, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section a chapter."""
        del ctx
        for chapter in get_args(Chapter):
            rows = [
                (name, " ".join((command.help or "").split("\n\n")[0].split()))
                for name, command in self.commands.items()
                if getattr(command, "rich_help_panel", "") == chapter
            ]
            with formatter.section(chapter.capitalize()):
                formatter.write_dl(rows)


def _readable(kind: str) -> Callable[[re.Match[str]], str]:
    def word(match: re.Match[str]) -> str:
        if kind == "argument":
            return ""
        name = match["kind"].removesuffix(" range").removeprefix("list[").removesuffix("]")
        return f" {_WORDS.get(name, name)}"

    return word

"""Errors that a user can cause, each with a clear message of one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class InputError(Exception):
    """Input that cannot be used. The command line prints its one-line message and exits with 2."""


class SceneError(InputError, ValueError):
    """A scene that contradicts itself or physics; the text names the table."""


@contextmanager
def located(part: str) -> Iterator[None]:
    """Prefix a `SceneError` with the part of the scene that it concerns, such as a joint."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{part}: {error}") from error


class UnknownName(InputError):
    """A name that is not registered."""

    @classmethod
    def of(cls, kind: str, got: str, allowed: list[str]) -> UnknownName:
        """Create the error with the name asked for, the nearest match and the allowed names."""
        plain = {name.casefold(): name for name in reversed(allowed)}
        near = difflib.get_close_matches(str(got).casefold(), plain, n=1)
        hint = f"; did you mean {plain[near[0]]!r}? There are: " if near else "; there are: "
        return cls(f"no {kind} is called {got!r}{hint}{', '.join(allowed) or 'none'}")


def check_name(kind: str, got: str, allowed: Iterable[str]) -> None:
    """Raise `UnknownName` unless a name is one of those allowed."""
    if got not in (names := list(allowed)):
        raise UnknownName.of(kind, got, names)


class EngineMissing(InputError):
    """An adapter is known but its engine is not installed."""


class EngineFaulty(EngineMissing):
    """An adapter of another package that cannot be used; the text says why."""


class Unsupported(InputError):
    """An engine cannot represent what the scene or the settings ask for; the text says why."""


class Notice(UserWarning):
    """A warning of this toolkit for users, which the command line writes as one line of its own."""

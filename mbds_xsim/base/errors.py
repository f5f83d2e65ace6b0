"""Errors that a user can cause, each one clear line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class InputError(Exception):
    """What was given cannot be used. The command line prints the one line and exits with 2."""


class SceneError(InputError, ValueError):
    """A scene that contradicts itself or physics; the text names the table."""


@contextmanager
def located(what: str) -> Iterator[None]:
    """Say of what in a scene an error is: of which joint, of which shape."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{what}: {error}") from error


class UnknownName(InputError):
    """A name that is not registered."""

    @classmethod
    def of(cls, what: str, got: str, allowed: list[str]) -> UnknownName:
        """Say what was asked for and what there is."""
        plain = {name.casefold(): name for name in reversed(allowed)}
        near = difflib.get_close_matches(str(got).casefold(), plain, n=1)
        hint = f"; did you mean {plain[near[0]]!r}? There are: " if near else "; there are: "
        return cls(f"no {what} is called {got!r}{hint}{', '.join(allowed) or 'none'}")


def check_name(what: str, got: str, allowed: Iterable[str]) -> None:
    """Raise UnknownName where a name is none of those that there are."""
    if got not in (names := list(allowed)):
        raise UnknownName.of(what, got, names)


class EngineMissing(InputError):
    """An adapter is known but its engine is not installed."""


class EngineFaulty(EngineMissing):
    """An adapter of another package that cannot be used; the text says why."""


class Unsupported(InputError):
    """An engine cannot represent what the scene or the settings ask for; the text says why."""

"""A private connection to Bullet that records the calls that build and start a model."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mbds_xsim.base.process import redirected


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Discard what Bullet prints."""
    with open(os.devnull, "wb") as nowhere, redirected((1, 2), nowhere.fileno()):
        yield


with _silent():  # importing it prints its build time
    import pybullet


class Constant(int):
    """A number of Bullet's that a listing shows by its name."""

    def __new__(cls, name: str) -> Constant:
        """Look up the name in `pybullet`."""
        constant = super().__new__(cls, getattr(pybullet, name))
        constant.name = name
        return constant

    name: str

    def __repr__(self) -> str:
        return f"p.{self.name}"


BARE_LINK: Mapping[str, Any] = {
    "linkMasses": 0.0,
    "linkCollisionShapeIndices": -1,
    "linkVisualShapeIndices": -1,
    "linkPositions": [0.0, 0.0, 0.0],
    "linkOrientations": [0.0, 0.0, 0.0, 1.0],
    "linkInertialFramePositions": [0.0, 0.0, 0.0],
    "linkInertialFrameOrientations": [0.0, 0.0, 0.0, 1.0],
    "linkParentIndices": 0,
    "linkJointTypes": Constant("JOINT_FIXED"),
    "linkJointAxis": [0.0, 0.0, 1.0],
}
"""What `createMultiBody` takes for a link without mass and shape, fixed to the base."""


class Client:
    """One DIRECT connection, with a world of its own."""

    def __init__(self) -> None:
        with _silent():
            self._number: int | None = pybullet.connect(pybullet.DIRECT)
        self._model: list[str] = []
        self._start: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    def build(self, name: str, *args: Any, **options: Any) -> Any:
        """Make a call that belongs to the model, and record it with its answer."""
        answer = self.function(name)(*args, **options)
        remark = "" if answer is None else f"  # gives {answer}"
        self._model.append(_line(name, args, options) + remark)
        return answer

    def note(self, text: str) -> None:
        """Record a comment on the calls that follow."""
        self._model.append(f"# {text}")

    def begin(self) -> None:
        """Forget the recorded start: a new one follows."""
        self._start.clear()

    def put(self, name: str, *args: Any, **options: Any) -> None:
        """Make a call that belongs to the start of a trajectory, and record it."""
        self.call(name, *args, **options)
        self._start.append((name, args, options))

    def call(self, name: str, *args: Any, **options: Any) -> None:
        """Make a call without recording it."""
        self.function(name)(*args, **options)

    def function(self, name: str) -> Callable[..., Any]:
        """Return one of the engine's functions for this connection."""
        return functools.partial(getattr(pybullet, name), physicsClientId=self._number)

    def listing(self) -> str:
        """Return all recorded calls as a script that runs without the toolkit."""
        start = [_line(name, args, options) for name, args, options in self._start]
        return "\n".join(["import pybullet as p", "", "p.connect(p.DIRECT)", *self._model, *start])

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._number is not None:
            with _silent():
                pybullet.disconnect(self._number)
            self._number = None


def _line(name: str, args: tuple[Any, ...], options: dict[str, Any]) -> str:
    texts = [repr(value) for value in args] + [f"{key}={value!r}" for key, value in options.items()]
    return f"p.{name}({', '.join(texts)})"

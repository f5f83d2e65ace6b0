"""Models of other formats, read by what is registered for the suffix of their file.

The core knows no format: a reader is a function of another package, found by entry point, and its
name there is the suffix. It is called in a process of its own, since what it uses may crash.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path

from mbds_xsim.base.errors import InputError, SceneError, UnknownName
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.scene.file import check_starts
from mbds_xsim.scene.imported import Imported, ModelFacts, Written
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.registry import registered

Reader = Callable[[Path, Path, bool], Imported]
"""Takes the file, the folder that its paths must not leave, and whether its base floats.

Raises `InputError` with a line that does not name the file.
"""

Loader = Callable[[Path, bool], ModelFacts]
"""Takes the file and whether its base floats; raises `InputError` where the engine refuses it."""

Writer = Callable[[Scene], Written]
"""Raises `InputError` with the reason where the format has no place for a scene."""

_TIMEOUT = 300.0  # [s]


def is_model(name: str) -> bool:
    """Whether something is registered to read files of such a name."""
    return Path(name).suffix[1:].lower() in registered("mbds_xsim.models")


def read_model(path: Path, *, folder: Path | None = None, floating: bool = False) -> Imported:
    """Read a model and check that its mechanism assembles and its starts can be drawn.

    Args:
        path: Of the file.
        folder: That files named in the model must lie in; left out, the model's own.
        floating: Whether a base that the file ties to nothing is free, not fixed in the world.

    Raises:
        InputError: One line: the file, what is wrong with it and where.
    """
    readers = registered("mbds_xsim.models")
    if (suffix := path.suffix[1:].lower()) not in readers:
        raise UnknownName.of("format of models", suffix, sorted(readers))
    if not path.is_file():
        msg = f"{path}: cannot be read (no such file); give the path of a model"
        raise InputError(msg)
    inside = (folder or path.parent).absolute()
    question = (readers[suffix], path.absolute(), inside, floating)
    (answer,) = run_tasks([Task(_read, question, _TIMEOUT)], workers=1)
    if isinstance(answer, Crash):
        raise SceneError(f"{path}: {answer.reason}")
    imported: Imported = answer
    return imported


def _read(point: EntryPoint, path: Path, folder: Path, floating: bool) -> Imported:
    reader: Reader = point.load()
    imported = reader(path, folder, floating)
    check_starts(imported.scene)
    return imported


def write_model(scene: Scene, kind: str) -> Written:
    """Write a scene in another format.

    Args:
        scene: The scene.
        kind: Of the format.

    Raises:
        InputError: The format has no place for the scene; the text says why.
    """
    writers = registered("mbds_xsim.model_writers")
    if kind not in writers:
        raise UnknownName.of("format of models", kind, sorted(writers))
    writer: Writer = writers[kind].load()
    return writer(scene)


def engine_facts(
    path: Path, engines: Sequence[str], *, floating: bool = False
) -> dict[str, ModelFacts | str]:
    """Let engines read a file with readers of their own.

    Args:
        path: Of the file.
        engines: Names.
        floating: Whether a base that the file ties to nothing is free.

    Returns:
        For each engine what it has read, or why it did not.
    """
    loaders = registered("mbds_xsim.model_loaders")
    for engine in engines:
        if engine not in loaders:
            raise UnknownName.of("engine with a reader of its own", engine, sorted(loaders))
    tasks = [Task(_load, (loaders[name], path.absolute(), floating), _TIMEOUT) for name in engines]
    answers = run_tasks(tasks)
    return {
        engine: answer.reason if isinstance(answer, Crash) else answer
        for engine, answer in zip(engines, answers, strict=True)
    }


def _load(point: EntryPoint, path: Path, floating: bool) -> ModelFacts:
    loader: Loader = point.load()
    return loader(path, floating)

"""A trained model as one file: scene, hyper-parameters, statistics and parameters."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch.nn.modules.module import register_module_parameter_registration_hook

from mbds_xsim.errors import InputError, UnknownName
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model, load_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.learn.stored import arrays, read_stored
from mbds_xsim.scene import Scene
from mbds_xsim.scene_file import write_scene
from mbds_xsim.write import write_whole

__all__ = ["read_facts", "read_model", "save_model"]

_FORMAT = "mbds-xsim model 1"
_LARGEST = 10_000
"""Of all whole numbers in settings: layers, widths, passes, steps in a frame."""


def save_model(
    path: Path, model: Model, name: str, settings: Any, statistics: Statistics, /, **facts: str
) -> None:
    """Write a model, and how it was made.

    Args:
        path: File to write.
        model: Trained or not.
        name: By which it is registered.
        settings: Its hyper-parameters, as it was made with.
        statistics: Those of the training part that it was made with.
        facts: What else is to be known of it: data, seed, profile.
    """
    content = io.BytesIO()
    whole = {
        "format": _FORMAT,
        "name": name,
        "scene": write_scene(model.graph.scene, defaults=True),
        "settings": msgspec.json.encode(settings).decode(),
        "statistics": statistics.to_state(),
        "parameters": model.state_dict(),
        "facts": facts,
    }
    torch.save(whole, content)
    write_whole(path, content.getvalue())


def read_model(path: Path, scene: Scene | None = None) -> tuple[Model, dict[str, str]]:
    """Read a model, on the CPU, and the facts that were written with it.

    Args:
        path: File to read.
        scene: To be predicted, in place of the one that it was trained on.

    Raises:
        InputError: It is no file of a model, was made by other code, or its parameters do not fit
            the scene.
        Unsupported: The model cannot represent the scene.
        UnknownName: The model is not registered here.
    """
    whole = _read(path)
    try:
        kind = load_model(whole.name)
        settings = _settings(kind, whole)
        own = msgspec.convert(tomllib.loads(whole.scene), Scene)
        statistics = Statistics.from_state(arrays(whole.statistics))
        parameters = arrays(whole.parameters)
    except UnknownName as error:
        raise UnknownName(f"{path}: {error}") from error
    except Exception as error:  # as many as there are ways of making a file
        raise _other_code(path, error) from error
    try:
        with _no_larger_than(parameters):
            model = kind(Graph.of(scene or own), statistics, settings).to(kind.dtype)
        model.load_state_dict(parameters)
    except InputError:
        raise
    except Exception as error:
        if scene is None:
            raise _other_code(path, error) from error
        msg = f"{path}: trained on {own.name}, its parameters do not fit {scene.name}"
        raise InputError(msg) from error
    return model, whole.facts


def _settings(kind: type[Model], whole: _Whole) -> Any:
    """Read the hyper-parameters of a kind of model; None where there is nothing to set."""
    if not kind.tracks:
        return None
    settings = msgspec.json.decode(whole.settings, type=type(next(iter(kind.tracks.values()))))
    _check_sizes(msgspec.to_builtins(settings))
    return settings


def _check_sizes(settings: Any) -> None:
    for key, value in settings.items():
        if isinstance(value, dict):
            _check_sizes(value)
        elif isinstance(value, int) and not 0 <= value <= _LARGEST:
            msg = f"{key}: got {value}, allowed is at most {_LARGEST}"
            raise ValueError(msg)


@contextmanager
def _no_larger_than(parameters: Mapping[str, torch.Tensor]) -> Iterator[None]:
    """Let no model be built that has more parameters than the file has for it.

    It is refused before memory is used: that of a parameter is not touched until its values are
    drawn, which follows its registration.
    """
    left = sum(value.numel() for value in parameters.values())

    def count(_module: torch.nn.Module, _name: str, parameter: torch.nn.Parameter) -> None:
        nonlocal left
        left -= 0 if parameter is None else parameter.numel()
        if left < 0:
            msg = "its settings ask for more parameters than it has"
            raise ValueError(msg)

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def _other_code(path: Path, error: Exception) -> InputError:
    told = str(error).partition("\n")[0]
    return InputError(f"{path}: a model of other code than this ({told}); train it again")


def read_facts(path: Path) -> dict[str, str]:
    """Read only the facts of a model's file.

    Raises:
        InputError: It is no file of a model.
    """
    return _read(path).facts


class _Whole(msgspec.Struct, frozen=True):
    """What a file holds."""

    name: str
    scene: str
    """As a scene file's text."""
    settings: str
    """JSON."""
    statistics: dict[str, Any]
    parameters: dict[str, Any]
    facts: dict[str, str]


def _read(path: Path) -> _Whole:
    whole = read_stored(path, "trained model", "give another, or remove it")
    if whole.get("format") != _FORMAT:
        msg = f"{path}: no trained model of this version; train it again"
        raise InputError(msg)
    try:
        return msgspec.convert(whole, _Whole)
    except Exception as error:  # an array in the place of a dictionary is an `AttributeError`
        raise _other_code(path, error) from error

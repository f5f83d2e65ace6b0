"""A trained model as one file: scene, hyper-parameters, statistics and parameters.

Files of `torch.save` are not trusted. `torch.load(weights_only=True)` runs no code, but allocates
whatever a file asks for (`bytearray(10**11)` in 20 bytes), believes the stated sizes of arrays, and
decompresses entries. So the archive is checked first: entries must be uncompressed and match their
checksums, and the pickle may name only arrays and dictionaries. Arrays are then memory-mapped, and
copied once their shapes are known to fit in the file.
"""

from __future__ import annotations

import io
import pickletools
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch
from torch import Tensor
from torch.nn.modules.module import register_module_parameter_registration_hook

from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.base.files import check_regular, path_of, write_whole
from mbds_xsim.learn.graph import Graph, check_edges
from mbds_xsim.learn.model import LearnedModel, load_model
from mbds_xsim.learn.plugins import of_another_package
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.scene.file import write_scene
from mbds_xsim.scene.scene import Scene

_FORMAT = "mbds-xsim model 1"
_LARGEST = 10_000
"""Largest allowed integer in settings: layers, widths, passes, steps per frame. The recipe's are
exempt, because they affect a training and not a model."""


def save_model(
    path: Path,
    model: LearnedModel,
    name: str,
    settings: Any,
    statistics: Statistics,
    /,
    **facts: object,
) -> None:
    """Write a model with its registered name, settings, statistics, and facts, kept as text."""
    whole = {
        "format": _FORMAT,
        "name": name,
        "revision": model.revision,
        "scene": write_scene(model.graph.scene, defaults=True),
        "settings": msgspec.json.encode(settings).decode(),
        "statistics": statistics.to_state(),
        "parameters": model.state_dict(),
        "facts": {key: str(value) for key, value in facts.items()},
    }
    write_stored(path, whole)


def read_model(path: str | Path, scene: Scene | None = None) -> tuple[LearnedModel, dict[str, str]]:
    """Read a model, on the CPU, and the facts that were written with it.

    It predicts the given scene, or by default the one that it was trained on; dropout is off.

    Raises:
        InputError: The file is not a model's, was made by other code, or does not fit the scene.
        Unsupported: The model cannot represent the scene.
        UnknownName: The model is not registered here.
    """
    path = path_of("path", path)
    whole = _read(path)
    try:
        kind = load_model(whole.name)
        if whole.revision != kind.revision:
            raise ValueError(f"revision {whole.revision} of {whole.name}, now {kind.revision}")
        settings = _settings(kind, whole.settings)
        own = msgspec.toml.decode(whole.scene, type=Scene)
        statistics = Statistics.from_state(arrays(whole.statistics))
        parameters = arrays(whole.parameters)
    except UnknownName as error:
        raise UnknownName(f"{path}: {error}") from error
    except Exception as error:  # a file can be wrong in any way
        raise _other_code(path, error) from error
    if scene is not None and scene != own and kind.needs_edges:
        check_edges(scene)
    try:
        with _no_larger_than(parameters), of_another_package():
            model = kind(Graph.of(scene or own), statistics, settings).in_precision()
        model.load_state_dict(parameters)
    except InputError:
        raise
    except Exception as error:
        if scene is None:
            raise _other_code(path, error) from error
        msg = f"{path}: trained on {own.name}, its parameters do not fit {scene.name}"
        raise InputError(msg) from error
    return model.eval(), whole.facts


def check_settings(name: str, track: str) -> None:
    """Raise InputError if a model's file could not be read with the hyper-parameters of a track."""
    kind = load_model(name)
    try:
        _settings(kind, msgspec.json.encode(kind.tracks[track]))
    except Exception as error:  # another package's settings may be anything
        msg = f"the model {name} could not be read from its file: change its track {track}: {error}"
        raise InputError(" ".join(msg.split())) from error


def _settings(kind: type[LearnedModel], text: str | bytes) -> Any:
    """Read the hyper-parameters of a kind of model; None if nothing can be set."""
    if not kind.tracks:
        return None
    settings = msgspec.json.decode(text, type=type(next(iter(kind.tracks.values()))))
    _check_sizes(msgspec.to_builtins(settings))
    return settings


def _check_sizes(settings: Any) -> None:
    for key, value in settings.items():
        if isinstance(value, dict) and key != "recipe":
            _check_sizes(value)
        elif isinstance(value, int) and not 0 <= value <= _LARGEST:
            raise ValueError(f"{key}: got {value}, allowed is 0 to {_LARGEST}")


@contextmanager
def _no_larger_than(parameters: Mapping[str, torch.Tensor]) -> Iterator[None]:
    """Refuse to build a model with more parameters than the file has for it.

    It is refused before memory is used: a parameter's memory is first touched when its values are
    drawn, after its registration.
    """
    left = sum(value.numel() for value in parameters.values())

    def count(_module: torch.nn.Module, _name: str, parameter: torch.nn.Parameter) -> None:
        nonlocal left
        left -= 0 if parameter is None else parameter.numel()
        if left < 0:
            raise ValueError("its settings ask for more parameters than it has")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def _other_code(path: Path, error: Exception) -> InputError:
    reason = str(error).partition("\n")[0]
    return InputError(f"{path}: made by another version of the code ({reason}); train it again")


def read_facts(path: str | Path) -> dict[str, str]:
    """Read only the facts of a model's file, or raise InputError."""
    return _read(path_of("path", path)).facts


def read_name(path: Path) -> str:
    """Read only the registered name of a file's model, or raise InputError."""
    return _read(path).name


class _Whole(msgspec.Struct, frozen=True):
    """Content of a model's file."""

    name: str
    scene: str
    """Text of the scene file."""
    settings: str
    """Settings as JSON."""
    statistics: dict[str, Any]
    parameters: dict[str, Any]
    facts: dict[str, str]
    revision: int = 0


def _read(path: Path) -> _Whole:
    whole = read_stored(path, "trained model", "give another, or remove it", dict[str, Any])
    if whole.get("format") != _FORMAT:
        raise InputError(f"{path}: no trained model of this version; train it again")
    try:
        return msgspec.convert(whole, _Whole)
    except Exception as error:  # an array in place of a dictionary raises `AttributeError`
        raise _other_code(path, error) from error


Stored = TypeVar("Stored")
_LONGEST = 1 << 24  # largest pickle, which holds names and shapes [bytes]
_PROTOCOL = 2
_NAMED = {
    "torch._utils _rebuild_tensor_v2",
    "collections OrderedDict",
    *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16")),
    *(f"torch {kind}Storage" for kind in ("Long", "Int", "Short", "Char", "Byte", "Bool")),
}
"""All names that a file of this project contains: functions, and the types of arrays."""


def write_stored(path: Path, whole: dict[str, Any]) -> None:
    """Write a file of `torch.save`, whole or not at all."""
    content = io.BytesIO()
    torch.save(whole, content)
    write_whole(path, content.getvalue())


def read_stored(path: Path, label: str, remedy: str, kind: type[Stored]) -> Stored:
    """Read a file of `torch.save` as a type for `msgspec.convert`.

    Arrays are still mapped from the file: copy them by `array`. InputErrors say by `label` what
    the file should be ("trained model"), and state the `remedy`.
    """
    try:
        _check_archive(path)
        whole = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
        return msgspec.convert(whole, kind)
    except OSError as error:
        raise InputError(f"{path}: no {label} can be read ({error.strerror or error})") from error
    except Exception as error:  # torch's own messages do not help a user
        raise InputError(f"{path}: no {label}, or a damaged one; {remedy}") from error


def array(value: object) -> Tensor:
    """Copy an array out of a file; raise ValueError unless all its numbers are in the file."""
    if type(value) is not Tensor or value.layout is not torch.strided or value.device.type != "cpu":
        raise ValueError(f"got {type(value).__name__}, allowed is an array")
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        msg = f"got an array of shape {tuple(value.shape)} whose numbers are not all in the file"
        raise ValueError(msg)
    return value.clone()


def arrays(value: object) -> dict[str, Tensor]:
    """Copy arrays by name out of a file; raise ValueError if they are not arrays."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"got {type(value).__name__}, allowed are arrays by name")
    return {key: array(item) for key, item in value.items()}


def _check_archive(path: Path) -> None:
    """Raise an error unless the archive is uncompressed and intact and has only known names."""
    check_regular(path)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        pickles = [name for name in names if name.endswith("/data.pkl")]
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("packed")
        if len(set(names)) < len(names) or len(pickles) != 1:
            raise ValueError("ambiguous")
        if archive.getinfo(pickles[0]).file_size > _LONGEST:
            raise ValueError("too long")
        if archive.testzip() is not None:
            raise ValueError("checksum")
        _check_names(archive.read(pickles[0]))


def _check_names(content: bytes) -> None:
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name == "PROTO" and argument != _PROTOCOL:  # torch warns of others
            raise ValueError(f"protocol {argument}")
        imports = opcode.name in ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")
        if imports and argument not in _NAMED:
            raise ValueError(f"names {argument}")

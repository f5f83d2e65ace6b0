"""A trained model as one file: scene, hyper-parameters, statistics and parameters."""

from __future__ import annotations

import io
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import torch

from mbds_xsim.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model, load_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.scene import Scene
from mbds_xsim.scene_file import write_scene
from mbds_xsim.write import write_whole

__all__ = ["read_facts", "read_model", "save_model"]

_FORMAT = "mbds-xsim model 1"


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
    kind = load_model(whole["name"])
    settings = None
    if kind.tracks:
        form = type(next(iter(kind.tracks.values())))
        try:
            settings = msgspec.json.decode(whole["settings"], type=form)
        except msgspec.ValidationError as error:
            raise _other_code(path, error) from error
    own = msgspec.convert(tomllib.loads(whole["scene"]), Scene)
    statistics = Statistics.from_state(whole["statistics"])
    model = kind(Graph.of(scene or own), statistics, settings).to(kind.dtype)
    try:
        model.load_state_dict(whole["parameters"])
    except RuntimeError as error:
        if scene is None:
            raise _other_code(path, error) from error
        msg = f"{path}: trained on {own.name}, its parameters do not fit {scene.name}"
        raise InputError(msg) from error
    return model, whole["facts"]


def _other_code(path: Path, error: Exception) -> InputError:
    told = str(error).partition("\n")[0]
    return InputError(f"{path}: a model of other code than this ({told}); train it again")


def read_facts(path: Path) -> dict[str, str]:
    """Read only the facts of a model's file.

    Raises:
        InputError: It is no file of a model.
    """
    facts: dict[str, str] = _read(path)["facts"]
    return facts


def _read(path: Path) -> dict[str, Any]:
    try:
        whole: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
    except OSError as error:
        msg = f"{path}: no trained model can be read ({error.strerror or error})"
        raise InputError(msg) from error
    except Exception as error:  # whatever a file makes torch say, it tells a user nothing
        msg = f"{path}: no trained model, or a damaged one; give another, or remove it"
        raise InputError(msg) from error
    if not isinstance(whole, dict) or whole.get("format") != _FORMAT:
        msg = f"{path}: no trained model of this version; train it again"
        raise InputError(msg)
    return whole

"""Files of `torch.save` that are wrong on purpose."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import build
from mbds_xsim.learn.model_file import save_model
from mbds_xsim.learn.statistics import Statistics
from mbds_xsim.simulate.registry import load_scene

FACTS = {
    "training": "mujoco",
    "train_engines": "mujoco",
    "variant": "native",
    "seed": "0",
    "steps": "5",
    "ended": "steps",
    "data": "{}",
    "drawn": "null",
}
REDUCE = b"R"


def model_file(path: Path, name: str = "gns") -> dict[str, Any]:
    """Write a sound file of an untrained model; return its content."""
    statistics = Statistics.of_nothing()
    model = build(name, Graph.of(load_scene("2pendulum")), statistics, track="lite")
    save_model(path, model, name, model.tracks["lite"], statistics, **FACTS)
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def with_pickle(path: Path, change: Callable[[bytes], bytes]) -> None:
    """Change the pickle of a file; its checksums are right again."""
    rewrite(path, lambda name, content: change(content) if name.endswith("/data.pkl") else content)


def rewrite(
    path: Path, change: Callable[[str, bytes], bytes], packed: int = zipfile.ZIP_STORED
) -> None:
    """Change entries of a file, or how they are packed."""
    written = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(written, "w", packed) as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    path.write_bytes(written.getvalue())


def called(module: str, function: str, argument: bytes) -> bytes:
    """Pickle a call: a module's function and the opcodes of its only argument."""
    return b"\x80\x02c" + f"{module}\n{function}\n".encode() + argument + b"\x85" + REDUCE + b"."

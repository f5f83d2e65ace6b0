"""Which models are compared: trained ones from files, and the trivial ones."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbds_xsim.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model, load_model
from mbds_xsim.learn.saved import read_model
from mbds_xsim.scene import Scene

__all__ = ["TRIVIAL", "Entry", "find_entries", "trivial_entries"]

TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")
"""What every model must beat."""

_TRIVIAL_MODULE = "mbds_xsim.learn.trivial"
_FACTS = ("train_engines", "variant", "training", "seed")


@dataclass(frozen=True)
class Entry:
    """A model to test."""

    model: str
    """By which it is told from others: the name of its folder."""
    training: str
    """What it was trained on and the variant of that: "mujoco-native", "all-matched"."""
    engines: tuple[str, ...]
    """Whose data it was trained on; none for trivial models."""
    variant: str
    seed: int
    path: Path | None
    """None: a trivial one."""
    content: str
    """Checksum of the file."""
    module: str
    """That the model is made in."""
    profile: str = ""
    ended: str = ""

    @property
    def single(self) -> bool:
        """Whether one engine's data made it."""
        return len(self.engines) == 1

    def load(self, scene: Scene) -> Model:
        """Read it, for data of a scene.

        Raises:
            InputError: It is of another scene.
        """
        if self.path is None:
            # Trivial models look at no statistics.
            nothing: Any = None
            return load_model(self.model)(Graph.of(scene), nothing, None)
        model, _ = read_model(self.path)
        if model.graph.scene != scene:
            msg = f"{self.path}: a model of another scene than the data's; train it on such data"
            raise InputError(msg)
        return model


def find_entries(folder: Path, scene: str) -> list[Entry]:
    """Find the files `<scene>/<variant>/<model>/<training>-s<seed>.pt` below a folder.

    Raises:
        InputError: There is none, or one does not say what it was trained on, or two say the same.
    """
    paths = sorted((folder / scene).glob("*/*/*-s*.pt"))
    if not paths:
        msg = (
            f"{folder / scene}: no trained models (<variant>/<model>/<training>-s<seed>.pt); make "
            "some with mbds-xsim train"
        )
        raise InputError(msg)
    entries = sorted(map(_entry, paths), key=_order)
    seen: dict[tuple[str, str, int], Path | None] = {}
    for entry in entries:
        key = (entry.model, entry.training, entry.seed)
        if key in seen:
            msg = f"{entry.path} and {seen[key]} are both {' '.join(map(str, key))}; remove one"
            raise InputError(msg)
        seen[key] = entry.path
    return entries


def trivial_entries() -> list[Entry]:
    """Give the models that learn nothing."""
    return [Entry(name, "nothing", (), "", 0, None, name, _TRIVIAL_MODULE) for name in TRIVIAL]


def _order(entry: Entry) -> tuple[str, str, int, str, int]:
    """Single engines, leave-one-out, all; variant by variant."""
    return entry.model, entry.variant, len(entry.engines), entry.training, entry.seed


def _entry(path: Path) -> Entry:
    model, facts = read_model(path)
    missing = [key for key in _FACTS if not facts.get(key)]
    if missing:
        msg = f"{path}: does not say its {', '.join(missing)}; train it with mbds-xsim train"
        raise InputError(msg)
    return Entry(
        model=path.parent.name,
        training=f"{facts['training']}-{facts['variant']}",
        engines=tuple(facts["train_engines"].split(",")),
        variant=facts["variant"],
        seed=int(facts["seed"]),
        path=path.resolve(),
        content=hashlib.sha256(path.read_bytes()).hexdigest(),
        module=type(model).__module__,
        profile=facts.get("profile", ""),
        ended=facts.get("ended", ""),
    )

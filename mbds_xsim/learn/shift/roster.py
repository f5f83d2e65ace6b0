"""Which models are compared: trained ones from files, and the trivial ones."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from mbds_xsim.dataset.split import NAMES, split_of
from mbds_xsim.errors import InputError
from mbds_xsim.learn.graph import Graph
from mbds_xsim.learn.model import Model, load_model
from mbds_xsim.learn.saved import read_model
from mbds_xsim.learn.shift.domains import Paired
from mbds_xsim.learn.shift.result import INTERVALS
from mbds_xsim.scene import Scene

__all__ = [
    "TRIVIAL",
    "WHOLE",
    "Entry",
    "Part",
    "check_budget",
    "check_data",
    "entry_of",
    "find_entries",
    "trivial_entries",
]

TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")
"""What every model must beat."""

VARIANTS = ("native", "matched")
WAYS = ("each", "leave-one-out", "all", "by-interval")

_TRIVIAL_MODULE = "mbds_xsim.learn.trivial"
_FACTS = ("train_engines", "variant", "training", "seed")
_ALIKE = ("profile", "track", "settings", "drawn", "starts", "device")
"""Facts that trainings must share to differ in their engines alone."""


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
    profile: str = ""
    steps: int = 0
    """Of the optimiser; 0 where not stated."""
    ended: str = ""
    data: tuple[tuple[str, str], ...] = ()
    """Engines and checksums of the files that it was trained on, as far as stated."""
    drawn: tuple[int, int] | None = None
    """Seed and number of the trajectories that its training part is of, as far as stated."""
    interval: str = ""
    """Of the starts that it was trained on; all when left out."""
    bodies: bool = False
    """Whether it starts from the bodies' states, not from the particles' positions alone."""
    budget: tuple[tuple[str, str], ...] = ()
    """What else it was made with, as far as stated: a profile, starts."""

    @property
    def single(self) -> bool:
        """Whether one engine's data made it."""
        return len(self.engines) == 1

    @property
    def way(self) -> str:
        """The word of `mbds-xsim train --on` that makes it."""
        if self.interval:
            return "by-interval"
        if self.single:
            return "each"
        return "leave-one-out" if self.training.startswith("not-") else "all"

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


@dataclass(frozen=True)
class Part:
    """Which of the models and domains that there are take part; left out, all."""

    variants: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    seeds: int | None = None
    """How many, from 0 on."""

    @staticmethod
    def parse(settings: str | None, on: str | None, seeds: int | None) -> Part:
        """Read it from a user's words.

        Raises:
            InputError: A word is none of those known.
        """
        return Part(_words("--settings", settings, VARIANTS), _words("--on", on, WAYS), seeds)

    def has(self, entry: Entry) -> bool:
        """Whether a trained model takes part."""
        return (
            (not self.variants or entry.variant in self.variants)
            and (not self.ways or entry.way in self.ways)
            and (self.seeds is None or entry.seed < self.seeds)
        )


WHOLE = Part()


def find_entries(folder: Path, scene: str, part: Part = WHOLE) -> list[Entry]:
    """Find the files `<scene>/<variant>/<model>/<training>-s<seed>.pt` below a folder.

    Args:
        folder: Of models.
        scene: Name of the scene's folder in it.
        part: Which of them.

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
    entries = sorted(map(entry_of, paths), key=_order)
    seen: dict[tuple[str, str, int], Path | None] = {}
    for entry in entries:
        key = (entry.model, entry.training, entry.seed)
        if key in seen:
            msg = f"{entry.path} and {seen[key]} are both {' '.join(map(str, key))}; remove one"
            raise InputError(msg)
        seen[key] = entry.path
    found = [entry for entry in entries if part.has(entry)]
    if not found:
        msg = f"{folder / scene}: none of the {len(entries)} models there was asked for"
        raise InputError(msg)
    return found


def entry_of(path: Path) -> Entry:
    """Read what a file holds.

    Raises:
        InputError: It is no file of a model, or does not say what it was trained on.
    """
    model, facts = read_model(path)
    missing = [key for key in _FACTS if not facts.get(key)]
    if missing:
        msg = f"{path}: does not say its {', '.join(missing)}; train it with mbds-xsim train"
        raise InputError(msg)
    try:
        seed, steps = int(facts["seed"]), int(facts.get("steps", 0))
        data, drawn = _data(facts), _drawn(facts)
        INTERVALS.index(facts.get("interval") or INTERVALS[0])
    except (ValueError, KeyError) as error:
        msg = (
            f"{path}: its seed, steps, data, interval or drawn are not what mbds-xsim train "
            "writes; train it again"
        )
        raise InputError(msg) from error
    return Entry(
        model=path.parent.name,
        training=f"{facts['training']}-{facts['variant']}",
        engines=tuple(facts["train_engines"].split(",")),
        variant=facts["variant"],
        seed=seed,
        path=path.resolve(),
        content=hashlib.sha256(path.read_bytes()).hexdigest(),
        profile=facts.get("profile_name") or facts.get("profile", ""),
        steps=steps,
        ended=facts.get("ended", ""),
        data=data,
        interval=facts.get("interval", ""),
        bodies=model.needs_bodies,
        drawn=drawn,
        budget=tuple((key, facts[key]) for key in _ALIKE if key in facts),
    )


def check_budget(entries: Sequence[Entry]) -> None:
    """Refuse models of one kind that do not differ in their engines and variant alone.

    Raises:
        InputError: They had other steps, hyper-parameters or trajectories.
    """
    firsts: dict[tuple[str, ...], tuple[str, Entry]] = {}
    for entry in entries:
        for key, value in entry.budget:
            # One trains on what all engines of a variant have.
            of = (entry.variant, entry.interval) if key == "starts" else ()
            told, first = firsts.setdefault((entry.model, key, *of), (value, entry))
            if value != told:
                msg = (
                    f"{entry.path}: has another {key} than {first.path}; to compare them would "
                    "tell of that, not of engines: train both alike, or remove one"
                )
                raise InputError(msg)


def check_data(entries: Sequence[Entry], test: Paired) -> None:
    """Refuse a model that was trained on other data of a domain, or on what it is tested on.

    Raises:
        InputError: The checksums differ, or the split of its data is another.
    """
    contents = {domain.name: domain.content for domain in test.domains}
    for entry in entries:
        if entry.drawn is not None and entry.drawn[0] == test.seed:
            known = split_of(test.index, entry.drawn[1]) != NAMES.index("test")
            if known.any():
                msg = (
                    f"{entry.path}: was trained or chosen by trajectory {test.index[known][0]} of "
                    f"the test part, being made of {entry.drawn[1]} drawn with the same seed; test "
                    "it on as many"
                )
                raise InputError(msg)
        for engine, content in entry.data:
            name = f"{engine}-{entry.variant}"
            if contents.get(name, content) != content:
                msg = (
                    f"{entry.path}: was trained on another data set {name} than is tested on; "
                    "train it on this one, or test it on its own"
                )
                raise InputError(msg)


def _words(option: str, given: str | None, known: tuple[str, ...]) -> tuple[str, ...]:
    words = [word.strip() for word in given.split(",")] if given else []
    for word in words:
        if word not in known:
            msg = f"{option}: got {word!r}, allowed is {', '.join(known)}, comma-separated"
            raise InputError(msg)
    return tuple(dict.fromkeys(words))


def trivial_entries() -> list[Entry]:
    """Give the models that learn nothing."""
    return [Entry(name, "nothing", (), "", 0, None, name, _TRIVIAL_MODULE) for name in TRIVIAL]


def _data(facts: dict[str, str]) -> tuple[tuple[str, str], ...]:
    told = msgspec.json.decode(facts.get("data", "{}"), type=dict[str, str])
    return tuple(sorted(told.items()))


def _drawn(facts: dict[str, str]) -> tuple[int, int] | None:
    told = msgspec.json.decode(facts.get("drawn", "null"), type=dict[str, int] | None)
    return None if told is None else (told["seed"], told["trajectories"])


def _order(entry: Entry) -> tuple[str, str, int, int, str, int]:
    """Single engines, leave-one-out, all, single intervals; variant by variant."""
    part = INTERVALS.index(entry.interval or INTERVALS[0])
    return entry.model, entry.variant, part, len(entry.engines), entry.training, entry.seed

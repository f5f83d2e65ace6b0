"""Which models are compared: trained ones from files, and the trivial ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mbds_xsim.base.errors import InputError
from mbds_xsim.dataset.layout import SPLITS, split_of
from mbds_xsim.learn.shift.domains import Paired
from mbds_xsim.learn.shift.result import INTERVALS
from mbds_xsim.learn.trained import TrainedModel, trained_model

TRIVIAL = ("hold", "constant_velocity", "constant_acceleration")
"""What every model must beat."""

_VARIANTS = ("native", "matched")
_WAYS = ("each", "leave-one-out", "all", "by-interval")


@dataclass(frozen=True)
class Selection:
    """Which of the models and domains that there are take part; left out, all."""

    variants: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    seeds: int | None = None
    """How many, from 0 on."""

    @staticmethod
    def parse(settings: str | None, on: str | None, seeds: int | None) -> Selection:
        """Read it from a user's words; InputError says which there are."""
        return Selection(
            _words("--settings", settings, _VARIANTS), _words("--on", on, _WAYS), seeds
        )

    def has(self, model: TrainedModel) -> bool:
        """Whether a trained model takes part."""
        return (
            (not self.variants or model.variant in self.variants)
            and (not self.ways or model.way in self.ways)
            and (self.seeds is None or model.seed < self.seeds)
        )


WHOLE = Selection()


def find_models(folder: Path, scene: str, selection: Selection = WHOLE) -> list[TrainedModel]:
    """Find the files `<scene>/<variant>/<model>/<training>-s<seed>.pt` below a folder.

    InputError where there is none, one does not say what it was trained on, or two say the same.
    """
    paths = sorted((folder / scene).glob("*/*/*-s*.pt"))
    if not paths:
        msg = (
            f"{folder / scene}: no trained models (<variant>/<model>/<training>-s<seed>.pt); make "
            "some with mbds-xsim train"
        )
        raise InputError(msg)
    models = sorted(map(trained_model, paths), key=_order)
    known: dict[tuple[str, str, int], Path | None] = {}
    for model in models:
        key = (model.model, model.training, model.seed)
        if key in known:
            msg = f"{model.path} and {known[key]} are both {' '.join(map(str, key))}; remove one"
            raise InputError(msg)
        known[key] = model.path
    chosen = [model for model in models if selection.has(model)]
    if not chosen:
        msg = f"{folder / scene}: none of the {len(models)} models there was asked for"
        raise InputError(msg)
    return chosen


def trivial_models() -> list[TrainedModel]:
    """Give the models that learn nothing."""
    profile = "mbds_xsim.learn.model"
    return [TrainedModel(name, "nothing", (), "", 0, None, name, profile) for name in TRIVIAL]


def check_budget(models: Sequence[TrainedModel]) -> None:
    """Refuse models of one kind that do not differ in their engines and variant alone."""
    firsts: dict[tuple[str, ...], tuple[str, TrainedModel]] = {}
    for model in models:
        for key, value in model.budget:
            # One trains on what all engines of a variant have.
            of = (model.variant, model.interval) if key == "starts" else ()
            usual, first = firsts.setdefault((model.model, key, *of), (value, model))
            if value != usual:
                msg = (
                    f"{model.path}: has another {key} than {first.path}; to compare them would "
                    "tell of that, not of engines: train both alike, or remove one"
                )
                raise InputError(msg)


def check_data(models: Sequence[TrainedModel], test: Paired) -> None:
    """Refuse a model that was trained on other data of a domain, or on what it is tested on."""
    contents = {domain.name: domain.content for domain in test.domains}
    for model in models:
        if model.drawn is not None and model.drawn[0] == test.seed:
            known = split_of(test.index, model.drawn[1]) != SPLITS.index("test")
            if known.any():
                msg = (
                    f"{model.path}: was trained or chosen by trajectory {test.index[known][0]} of "
                    f"the test part, being made of {model.drawn[1]} drawn with the same seed; test "
                    "it on as many"
                )
                raise InputError(msg)
        for engine, content in model.data:
            name = f"{engine}-{model.variant}"
            if contents.get(name, content) != content:
                msg = (
                    f"{model.path}: was trained on another data set {name} than is tested on; "
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


def _order(model: TrainedModel) -> tuple[str, str, int, int, str, int]:
    """Single engines, leave-one-out, all, single intervals; variant by variant."""
    part = INTERVALS.index(model.interval or INTERVALS[0])
    return model.model, model.variant, part, len(model.engines), model.training, model.seed

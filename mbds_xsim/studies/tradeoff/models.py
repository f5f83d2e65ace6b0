"""Trained models of a trade-off study in words and figures, for all reports alike."""

from __future__ import annotations

from collections.abc import Callable

from mbds_xsim.report import quantity
from mbds_xsim.report.blocks import Column, Table, table_of
from mbds_xsim.studies.tradeoff.rows import Learned, Tradeoff


def models_table(study: Tradeoff) -> Table:
    """Give a row a model."""
    together = f"of {study.models[0].at_once}"
    columns: list[tuple[Column, Callable[[Learned], str]]] = [
        (Column("model", words=True), lambda m: m.model),
        (Column("trained on", "Training and seed", words=True), _trained_on),
        (
            Column("alone", "Wall time per simulated second of one trajectory at a time"),
            lambda m: quantity.span(m.alone.wall_s),
        ),
        (
            Column(together, f"The same of one trajectory in a batch {together}"),
            lambda m: quantity.span(m.batched.wall_s),
        ),
        (
            Column(
                f"error {study.horizon_s:g} s",
                "RMS distance of the particles to the reference then",
            ),
            _error,
        ),
        (
            Column("all times", "The largest over the growth of a disturbance", narrow=False),
            lambda m: quantity.length(m.alone.error_weighted_m),
        ),
        (
            Column("gap", "Largest deviation of a distance that no motion changes", narrow=False),
            lambda m: quantity.length(m.alone.gap_m),
        ),
        (
            Column(
                "energy",
                "Largest unexplained change of the particles' energy over its scale",
                narrow=False,
            ),
            lambda m: quantity.number(m.alone.energy),
        ),
        (Column("steps", "Steps of training", narrow=False), _steps),
        (Column("training", "Wall time of training"), lambda m: quantity.span(m.train_wall_s)),
    ]
    rows = [[tell(model) for _, tell in columns] for model in study.models]
    return table_of([column for column, _ in columns], rows, title="Trained models")


def models_short(study: Tradeoff) -> str:
    """Give the errors of all models in a sentence, the least first; "" without models."""
    order = sorted(study.models, key=lambda m: (m.alone.kind != "done", m.alone.error_m or 0.0))
    if not order:
        return ""
    each = ", ".join(f"{m.model} {_error(m)}" for m in order)
    return f"trained models are off at {study.horizon_s:g} s by: {each}"


def models_told(study: Tradeoff) -> str:
    """Say what models are given, and what their figures are; "" where there are none."""
    if not study.models:
        return ""
    known = study.models[0].known_frames
    return (
        f"start with the reference's first {known} frames, which no engine is given, and are not "
        "told the random forces, which engines are; wall time is that of the frames behind, alone "
        f"or as a share of a batch of {study.models[0].at_once} on one core; training is in no "
        "other time; gap and energy are what particles show" + _elsewhere(study)
    )


def _elsewhere(study: Tradeoff) -> str:
    other = dict.fromkeys(m.machine for m in study.models if m.machine != study.machine)
    return f"; timed on another machine than engines: {', '.join(other)}" if other else ""


def model_told(model: Learned) -> str:
    """Say what a point is when it is pointed at."""
    point = model.alone
    return (
        f"{model.name}\ncost {quantity.span(point.wall_s)} a simulated second alone, "
        f"{quantity.span(model.batched.wall_s)} in a batch of {model.at_once}\n"
        f"error {quantity.length(point.error_m)}, over all times "
        f"{quantity.length(point.error_weighted_m)}\ngap {quantity.length(point.gap_m)}, energy "
        f"{quantity.number(point.energy)}\ntraining took {quantity.span(model.train_wall_s)}"
    )


def _trained_on(model: Learned) -> str:
    return f"{model.training} {model.variant}"


def _steps(model: Learned) -> str:
    return "–" if model.train_steps is None else f"{model.train_steps:.0f}"


def _error(model: Learned) -> str:
    point = model.alone
    return quantity.length(point.error_m) if point.kind == "done" else point.reason

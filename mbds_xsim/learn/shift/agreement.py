"""Whether engines, and the paper, put the models in the same order."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator, Mapping
from importlib import resources

from scipy.stats import kendalltau

from mbds_xsim.learn.shift.board import Board
from mbds_xsim.learn.shift.gaps import Draws, trainings_of
from mbds_xsim.learn.shift.result import Agreement

__all__ = ["PAPER", "agreements_of", "paper_errors", "paper_rows", "tau"]

PAPER = "the paper"
Errors = dict[tuple[str, int], float]
"""Mean errors by model and frame."""

_LEAST = 3  # models: two can only be in order or out of it


def agreements_of(board: Board, draws: Draws) -> Iterator[Agreement]:
    """Compare the orders of models that were trained where they are tested, and the paper's."""
    orders = _orders(board, draws)
    paper = paper_errors(board.test.scene.name, flagged=False)
    if orders and paper:
        orders[PAPER] = paper
    for (first, one), (second, two) in itertools.combinations(orders.items(), 2):
        for frame in board.frames:
            both = [model for model, at in one if at == frame and (model, frame) in two]
            if both:
                here, there = ({m: order[m, frame] for m in both} for order in (one, two))
                yield Agreement(first, second, frame, tuple(both), tau(here, there))


def tau(first: Mapping[str, float], second: Mapping[str, float]) -> float | None:
    """Kendall's τ-b of the models that both have; None of fewer than three, or all ties."""
    both = [model for model in first if model in second]
    if len(both) < _LEAST:
        return None
    found = kendalltau([first[m] for m in both], [second[m] for m in both]).statistic
    return None if found != found else float(found)


def paper_rows(scene: str) -> list[dict[str, str]]:
    """Give the paper's printed values of a scene, as they stand in its tables."""
    text = resources.files("mbds_xsim.learn.shift").joinpath("paper.csv").read_text("utf-8")
    rows = csv.DictReader(text.splitlines())
    return [r for r in rows if r["kind"] == "value" and _plain(r["scenario"]) == scene]


def paper_errors(scene: str, *, flagged: bool = True) -> Errors:
    """Give the same of all speeds together [m², if the paper's unit is the metre].

    Args:
        scene: Which.
        flagged: Whether to give those, too, that a note says cannot be right as printed.
    """
    rows = [r for r in paper_rows(scene) if not r["speed"] and (flagged or not r["note"])]
    return {(row["model"].lower(), int(row["t"])): float(row["mean_si"]) for row in rows}


def _plain(scenario: str) -> str:
    return scenario.replace("-", "").lower()


def _orders(board: Board, draws: Draws) -> dict[str, Errors]:
    """Mean errors by domain."""
    orders: dict[str, Errors] = {}
    tested = {domain.name for domain in board.test.domains}
    for training in (t for model in board.models for t in trainings_of(board, model)):
        if len(training.engines) == 1 and training.domains[0] in tested:
            means = draws.mean(training, training.domains[0]).tolist()
            order = orders.setdefault(training.domains[0], {})
            order.update({(training.model, f): x for f, x in zip(board.frames, means, strict=True)})
    return orders

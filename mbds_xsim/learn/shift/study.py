"""The whole study of a scene: domains, models, floors, gaps and answers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mbds_xsim.errors import InputError
from mbds_xsim.learn.model import trainable
from mbds_xsim.learn.refusal import refusal
from mbds_xsim.learn.shift.agreement import agreements_of
from mbds_xsim.learn.shift.answers import answers_of
from mbds_xsim.learn.shift.board import RESTART, Board, cells_of, known_mean
from mbds_xsim.learn.shift.bootstrap import DRAWS
from mbds_xsim.learn.shift.by_interval import answers_by_interval
from mbds_xsim.learn.shift.domains import REFERENCE, Domain, Paired, Solved, load_paired
from mbds_xsim.learn.shift.evaluate import Plan, evaluate
from mbds_xsim.learn.shift.floors import chaos_floor, floors_of, noise_floor, oracles
from mbds_xsim.learn.shift.gaps import Draws, gaps_of
from mbds_xsim.learn.shift.measure import EXPLODED, LOST
from mbds_xsim.learn.shift.meter import Meter
from mbds_xsim.learn.shift.restart import restarted
from mbds_xsim.learn.shift.result import FRAMES, DomainFacts, ModelFacts, Shift
from mbds_xsim.learn.shift.roster import (
    WHOLE,
    Entry,
    Part,
    check_budget,
    check_data,
    find_entries,
    trivial_entries,
)
from mbds_xsim.learn.shift.truth import read_truth, solve_domain
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.registry import package_version
from mbds_xsim.study.identity import machine

__all__ = ["Asked", "Studied", "asked", "study"]

Array = NDArray[np.float64]
_AT = 10


@dataclass(frozen=True, eq=False)
class Asked:
    """Models and data of one scene that belong together."""

    test: Paired
    trained: tuple[Entry, ...]


@dataclass(frozen=True, eq=False)
class Studied:
    """A study, and the raw figures that it was made from."""

    shift: Shift
    board: Board
    domains: tuple[Domain, ...]


def asked(
    models: Path,
    data: Path,
    scene: str,
    *,
    trajectories: int | None = None,
    part: Part = WHOLE,
) -> Asked:
    """Find what is to be studied.

    Args:
        models: Folder of trained models.
        data: Folder of data sets.
        scene: Name of the scene in both.
        trajectories: Test with at most so many.
        part: Which models and domains.

    Raises:
        InputError: Models or data are missing, or do not belong together.
    """
    test = load_paired(data, scene, trajectories, part.variants)
    trained = find_entries(models, scene, part)
    check_budget(trained)
    check_data(trained, test)
    return Asked(test, tuple(trained))


def study(
    question: Asked,
    *,
    at: int | None = None,
    cache: bool = True,
    workers: int | None = None,
    device: str = "cpu",
    meter: Meter | None = None,
    command: str = "",
) -> Studied:
    """Test all models of a scene on all domains, and say what a change of engine does.

    Args:
        question: Which models, on which data.
        at: Frame of the answers and tables; left out, 10, or the last where there are fewer.
        cache: Whether what was solved, predicted and simulated before is used.
        workers: Processes at a time.
        device: Of the models.
        meter: Told of every model that is tested, and of every engine that goes on.
        command: What was typed.

    Raises:
        InputError: There is no such frame, or a model cannot be tested.
    """
    began = time.perf_counter()
    test, entries = question.test, [*trivial_entries(), *question.trained]
    plan = Plan(min(max(FRAMES), test.batch.steps + 1 - HISTORY), device=device)
    frames = tuple(frame for frame in FRAMES if frame <= plan.horizon)
    at = _frame_of(frames, at)
    solved, reason = solve_domain(test, plan.horizon, cache=cache, workers=workers)
    domains: tuple[Domain, ...] = (*test.domains, *([solved] if solved else []))
    figures = evaluate(
        test.scene, entries, domains, plan, cache=cache, workers=workers, meter=meter
    )
    gone_on, refused = restarted(
        test, domains, plan.horizon, cache=cache, workers=workers, meter=meter
    )
    board = Board(test, frames, figures, oracles(domains, plan.horizon), gone_on)
    left_out = {
        **test.left_out,
        **({} if solved else {REFERENCE: reason}),
        **{f"{RESTART} {name}": why for name, why in refused.items()},
        **_lost(board),
        **_absent(test, board),
    }
    shift = _shift(
        board,
        plan,
        at,
        _floors(test, solved, plan),
        command=command,
        domains=tuple(DomainFacts(d.name, d.engine, d.variant, d.content) for d in domains),
        left_out=left_out,
        models=tuple(map(_facts, entries)),
        kept=len(entries) - figures.tested,
    )
    shift = msgspec.structs.replace(shift, wall_s=time.perf_counter() - began)
    return Studied(shift, board, domains)


def _floors(test: Paired, solved: Solved | None, plan: Plan) -> tuple[Array | None, Array | None]:
    """Give the noise floor and the chaos floor, where the reference is known."""
    if solved is None:
        return None, None
    truth = read_truth(solved.path)
    return noise_floor(truth, plan.horizon), chaos_floor(test, truth, plan.horizon)


def _shift(
    board: Board, plan: Plan, at: int, floors: tuple[Array | None, Array | None], **facts: Any
) -> Shift:
    """Say what was measured and what follows from it."""
    test, draws = board.test, Draws(board)
    gaps = tuple(gaps_of(board, draws, *(_mean(board, floor) for floor in floors)))
    return Shift(
        scene=test.scene.name,
        description=test.scene.description,
        machine=machine(),
        versions={name: package_version(name) for name in ("mbds-xsim", "torch", "numpy")},
        frame_s=test.scene.clock.frame,
        length_m=test.scene.length,
        history=HISTORY,
        horizon=plan.horizon,
        stride=plan.stride,
        lost=LOST,
        exploded=EXPLODED,
        draws=DRAWS,
        frames=board.frames,
        at=at,
        index=tuple(test.index.tolist()),
        noise=test.noise,
        cells=tuple(cells_of(board)),
        floors=tuple(floors_of(board, *floors)),
        gaps=gaps,
        agreements=tuple(agreements_of(board, draws)),
        answers=(*answers_of(board, draws, gaps, at), *answers_by_interval(board, at)),
        wall_s=0.0,
        **facts,
    )


def _frame_of(frames: tuple[int, ...], asked: int | None) -> int:
    """Choose the frame of the answers: early enough not to be chaos everywhere."""
    if asked is None:
        return _AT if _AT in frames else frames[-1]
    if asked not in frames:
        msg = f"--at: got {asked}, allowed is {', '.join(map(str, frames))}"
        raise InputError(msg)
    return asked


def _lost(board: Board) -> dict[str, str]:
    """Say which engines did not go on from which domains."""
    reasons = {}
    for (engine, test), figures in board.restarted.items():
        lost = (figures.error > board.largest).any(axis=1)
        if lost.any():
            reasons[f"{RESTART} {engine} on {test} as a floor"] = (
                f"lost in {lost.sum()} of {len(figures.error)} trajectories; there the distance of "
                "the published motions stands in"
            )
    return reasons


def _absent(test: Paired, board: Board) -> dict[str, str]:
    """Say of models that are not there whether they could be."""
    reasons = {}
    for name in sorted(set(trainable()) - set(board.models)):
        reasons[name] = refusal(name, test.graph) or "no trained model of it was given"
    return reasons


def _mean(board: Board, error: Array | None) -> Array:
    """Over the known trajectories at the frames; NaN where there is nothing."""
    if error is None:
        return np.full(len(board.frames), np.nan)
    return known_mean(board.counted(error))


def _facts(entry: Entry) -> ModelFacts:
    return ModelFacts(
        model=entry.model,
        training=entry.training,
        engines=entry.engines,
        seed=entry.seed,
        profile=entry.profile,
        steps=entry.steps,
        ended=entry.ended,
        content=entry.content,
        interval=entry.interval,
        bodies=entry.bodies,
    )

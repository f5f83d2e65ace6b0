"""The whole study of a scene: domains, models, floors, gaps, answers, and rollouts to look at."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from torch import Tensor

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import InputError
from mbds_xsim.base.files import check_writable
from mbds_xsim.base.isolate import USUAL, Conduct
from mbds_xsim.learn.model import refusal, rollout, trainable
from mbds_xsim.learn.particles import EXPLODED, LOST
from mbds_xsim.learn.plugins import of_another_package
from mbds_xsim.learn.shift.answers import answers_by_interval, answers_of
from mbds_xsim.learn.shift.contact import from_contact
from mbds_xsim.learn.shift.domains import (
    REFERENCE,
    Domain,
    Paired,
    Recorded,
    check_data,
    cost_of,
    load_paired,
    read_reference,
    solve_domain,
)
from mbds_xsim.learn.shift.evaluation import (
    RESTART,
    Evaluation,
    cells_of,
    chaos_floor,
    curve_of,
    floors_of,
    noise_floor,
    oracles,
    seconds_to_floor,
)
from mbds_xsim.learn.shift.gaps import DRAWS, Draws, agreements_of, gaps_of
from mbds_xsim.learn.shift.interaction import (
    answer_of_factors,
    answers_of_interactions,
    interactions_of,
)
from mbds_xsim.learn.shift.result import (
    FRAMES,
    INTERVALS,
    Answer,
    DomainFacts,
    Interaction,
    Shift,
    TrainedFacts,
)
from mbds_xsim.learn.shift.rollouts import RolloutPlan, evaluate, restarted
from mbds_xsim.learn.shift.worth import answer_of_harms, harms_of
from mbds_xsim.learn.trained import (
    WHOLE,
    Selection,
    TrainedModel,
    check_budget,
    find_models,
    trivial_models,
)
from mbds_xsim.learn.window import HISTORY
from mbds_xsim.measure.runner import machine
from mbds_xsim.reference.cache import directory
from mbds_xsim.simulate.registry import package_version

_AT = 10
_SINCE = " after the first contact"


ShiftQuestion = tuple[Paired, list[TrainedModel], int]
"""Data and models of one scene that belong together, and the frame of answers and tables."""


@dataclass(frozen=True, eq=False)
class ShiftStudy:
    """Study, and the raw figures that it was made from."""

    shift: Shift
    evaluation: Evaluation

    @functools.cached_property
    def samples(self) -> Samples:
        """Rollouts to look at, predicted once for all pages and pictures."""
        return samples_of(self.evaluation)


def question_of(
    models: Path,
    data: Path,
    scene: str,
    trajectories: int | None = None,
    part: Selection = WHOLE,
    at: int | None = None,
) -> ShiftQuestion:
    """Find the models and data of a scene for a study, and check that they belong together.

    Answers and tables are for frame `at`; by default 10, or the last if there are fewer. Raises
    InputError with the reason if something is missing or does not belong.
    """
    check_writable(directory() / "shift" / f"{scene}.npz", "MBDS_XSIM_CACHE")
    test = load_paired(data, scene, trajectories, part.variants)
    trained = find_models(models, scene, part)
    check_budget(trained)
    check_data(trained, test)
    for model in trained:
        curve_of(model)  # a damaged one is refused now, not after all the work
    return test, trained, _frame_of(test, at)


def study(
    question: ShiftQuestion,
    *,
    conduct: Conduct = USUAL,
    device: str = "cpu",
    command: str = "",
) -> ShiftStudy:
    """Test all models of a scene on all domains, and assess the effect of a change of engine.

    Stored predictions and simulations are reused if `conduct.cache` allows it.
    """
    begin = time.perf_counter()
    test, trained, at = question
    models = [*trivial_models(), *trained]
    plan = RolloutPlan(min(max(FRAMES), test.batch.steps + 1 - HISTORY), device=device)
    solved, reason = solve_domain(test, plan.horizon, conduct)
    domains: tuple[Domain, ...] = (*test.domains, *([solved] if solved else []))
    figures = evaluate(test.scene, models, domains, plan, conduct)
    restart_figures, reasons = restarted(test, domains, plan.horizon, conduct)
    engine_figures, floors = oracles(domains, plan.horizon), {}
    if solved is not None:
        truth = read_reference(solved.path)
        floors["noise"] = noise_floor(truth, plan.horizon)
        floors["chaos"] = chaos_floor(test, truth, plan.horizon)
    evaluation = Evaluation(test, _frames(test), figures, engine_figures, restart_figures, floors)
    shift = _shift(
        evaluation,
        plan,
        at,
        command=command,
        domains=tuple(
            DomainFacts(d.name, d.engine, d.variant, d.content, cost_of(d)) for d in domains
        ),
        left_out={
            **test.left_out,
            **({} if solved else {REFERENCE: reason}),
            **{f"{RESTART} {name}": why for name, why in reasons.items()},
            **_left_out(evaluation),
        },
        models=tuple(_facts(evaluation, model) for model in models),
        kept=len(models) - figures.tested,
    )
    answers, wall_s = (*answer_of_harms(shift), *shift.answers), time.perf_counter() - begin
    return ShiftStudy(msgspec.structs.replace(shift, answers=answers, wall_s=wall_s), evaluation)


def _shift(evaluation: Evaluation, plan: RolloutPlan, at: int, **facts: Any) -> Shift:
    """Collect all measurements and the conclusions from them."""
    test, draws = evaluation.test, Draws(evaluation)
    gaps, interactions = tuple(gaps_of(draws)), interactions_of(draws)
    later = from_contact(evaluation)
    later_draws = Draws(later) if later else None
    after_contact = interactions_of(later_draws) if later_draws else ()
    told, speeds = tuple(answers_of(draws, gaps, at)), tuple(answers_by_interval(evaluation, at))
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
        frames=evaluation.frames,
        at=at,
        index=tuple(test.index.tolist()),
        noise=test.noise,
        cells=tuple(cells_of(evaluation)),
        floors=tuple(floors_of(evaluation)),
        gaps=gaps,
        agreements=tuple(agreements_of(draws)),
        interactions=interactions,
        contact_frames=later.frames if later else (),
        contact_trajectories=len(later.test.index) if later else 0,
        after_contact=after_contact,
        harms=harms_of(draws),
        harms_after_contact=harms_of(later_draws) if later_draws else (),
        answers=(
            *_changes(interactions, evaluation.frames, at),
            *(_changes(after_contact, later.frames, at, _SINCE) if later else ()),
            *(told + speeds if gaps else speeds + told),
        ),
        wall_s=0.0,
        **facts,
    )


def _changes(
    interactions: Sequence[Interaction], frames: Sequence[int], at: int, since: str = ""
) -> Iterator[Answer]:
    """Yield the costs of changes: all side by side if there are several, else the only one."""
    place = max(k for k, frame in enumerate(frames) if frame <= at)
    side_by_side = list(answer_of_factors(interactions, place, frames[place], since))
    yield from side_by_side or answers_of_interactions(interactions, place, frames[place], since)


def _facts(evaluation: Evaluation, model: TrainedModel) -> TrainedFacts:
    facts = msgspec.convert(model, TrainedFacts, from_attributes=True)
    count = int(float(model.facts.get("train_trajectories") or 0))
    seconds = seconds_to_floor(evaluation, model)
    return msgspec.structs.replace(facts, to_floor_s=seconds, trajectories=count)


def _frames(test: Paired) -> tuple[int, ...]:
    """Return the reported frames that the data reach."""
    return tuple(frame for frame in FRAMES if frame <= test.batch.steps + 1 - HISTORY)


def _frame_of(test: Paired, at: int | None) -> int:
    """Choose the frame of the answers, early enough that not all motion is chaotic."""
    frames = _frames(test)
    if at is None:
        return _AT if _AT in frames else frames[-1]
    if at not in frames:
        allowed = ", ".join(map(str, frames))
        raise InputError(f"--at: got {at}, allowed in {test.scene.name} is {allowed}")
    return at


def _left_out(evaluation: Evaluation) -> dict[str, str]:
    """Return the reasons why restarted engines or models are left out."""
    lost = {
        pair: np.any(figures.error > evaluation.largest, axis=1)
        for pair, figures in evaluation.restarted.items()
    }
    some = {pair: rows for pair, rows in lost.items() if rows.any()}
    reasons = {}
    if some:
        (engine, test), rows = max(some.items(), key=lambda item: int(item[1].sum()))
        reasons[f"{RESTART}s as floors, in {len(some)} of {len(lost)} pairs"] = (
            f"lost in up to {rows.sum()} of {len(rows)} trajectories ({engine} on {test}); there "
            "the distance of the published motions stands in"
        )
    for name in sorted(set(trainable()) - {entry.kind for entry in evaluation.entries}):
        why = refusal(name, evaluation.test.graph)
        reasons[name] = why or "no trained model was tested"
    return reasons


@dataclass(frozen=True, eq=False)
class SampleRollout:
    """Predictions of one model."""

    model: str
    training: str
    position: Array
    """Positions [m], shape (trajectory, frame, particle, 3); NaN where lost."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Predictions of the same trajectories, from the last known frame on."""

    evaluation: Evaluation
    domain: Recorded
    index: Index
    """Numbers of the trajectories, one of each interval."""
    truth: Array
    """True positions [m], shape (trajectory, frame, particle, 3)."""
    models: tuple[SampleRollout, ...]


def samples_of(evaluation: Evaluation) -> Samples:
    """Predict one trajectory of each interval, on the first domain that a model was trained on.

    Each model takes part with the first seed of its training there, and of its training on the
    engine that is furthest away.
    """
    homes = [entry.training for entry in evaluation.entries if entry.single]
    domains = evaluation.test.domains
    domain = next((d for d in domains if d.name in homes), domains[0])
    firsts = [np.flatnonzero(r)[0] for name, r in evaluation.intervals() if name != INTERVALS[0]]
    rows = torch.tensor(firsts)
    motions = domain.motions(torch.float64)[rows]
    horizon = min(motions.frame_count - HISTORY, max(evaluation.frames))
    return Samples(
        evaluation=evaluation,
        domain=domain,
        index=motions.index,
        truth=motions.position[:, HISTORY - 1 : HISTORY + horizon].numpy(),
        models=tuple(
            SampleRollout(m.model, m.training, _predicted(evaluation, m, domain, rows, horizon))
            for m in _chosen(evaluation, domain)
        ),
    )


def _chosen(evaluation: Evaluation, domain: Recorded) -> list[TrainedModel]:
    models = []
    for model in evaluation.models:
        singles = [entry for entry in evaluation.entries if entry.model == model and entry.single]
        others = [e for e in singles if e.variant == domain.variant and e.training != domain.name]
        others = [e for e in others if (e.training, domain.name) in evaluation.oracles]
        furthest = sorted(
            others, key=lambda e: -float(evaluation.floor(e.training, domain.name).mean())
        )
        models += [e for e in singles if e.training == domain.name][:1] + furthest[:1]
    return models


def _predicted(
    evaluation: Evaluation, trained: TrainedModel, domain: Domain, rows: Tensor, horizon: int
) -> Array:
    """Return predicted positions, starting with the last known frame."""
    model = trained.load(evaluation.test.scene)
    motions = domain.motions(model.dtype)[rows]
    with trained.named_in_errors(), of_another_package():
        predicted = rollout(model, motions, steps=horizon)
    positions = torch.cat([motions.position[:, HISTORY - 1 : HISTORY], predicted], dim=1)
    return np.asarray(positions.double().numpy())

"""What a shift study finds, as it is written to JSON; `docs/shift.md` defines every figure.

Lists beside `frames` have one value a frame. Null stands for what is not known, does not exist, or
is not finite.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

SCHEMA = "mbds-xsim/shift/1"
FRAMES = (1, 10, 20, 30, 40, 50, 60, 90, 100)
"""Frames behind the last known one at which errors are told."""
INTERVALS = ("all", "low", "medium", "high")

Values = tuple[float | None, ...]


class DomainFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """What a model can be tested on."""

    name: str
    engine: str
    variant: str
    content: str
    """Checksum of the data."""
    cost_s: float | None = None
    """Processor time that the engine took for a trajectory, where the data's log is beside them."""


class TrainedFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """A model that was tested."""

    model: str
    training: str
    engines: tuple[str, ...]
    seed: int
    profile: str
    steps: int
    """Of the optimiser; 0 where not stated."""
    ended: str
    content: str
    """Checksum of its file; its name for trivial models."""
    interval: str = ""
    """Of the starts that it was trained on; all when left out."""
    bodies: bool = False
    """Whether it starts from the bodies' states, not from the particles' positions alone."""
    to_floor_s: float | None = None
    """Processor time of its training until it was as near its engine as the nearest other one."""
    trajectories: int = 0
    """That it was trained on; 0 where not stated."""


class ErrorCell(msgspec.Struct, frozen=True):
    """One model of one training and seed on one domain, over one interval."""

    model: str
    training: str
    seed: int
    test: str
    interval: str
    known: tuple[int, ...]
    """Trajectories whose truth is known."""
    finite: tuple[int, ...]
    """Of them, those whose prediction is."""
    diverged: tuple[int, ...]
    """Of them, those that were not finite or had exploded by then."""
    mse: Values
    """Mean over the known, those lost or exploded counting as exploded [m²]."""
    median: Values
    """Over the known, the others being infinite [m²]."""
    energy: Values
    """Median of the energy error."""
    gap: Values
    """Median of the constraint gap [m]."""
    one_step: float | None
    """Mean of the teacher-forced error [m²]."""
    valid_s: float | None
    """Median valid prediction time [s]; what never was lost counts with the horizon."""
    never_lost: int
    """Trajectories that stayed valid over the whole horizon."""
    curve: Values = ()
    """Median at every frame [m²]; of interval "all"."""


class ErrorFloor(msgspec.Struct, frozen=True):
    """What no figure on a domain can resolve below."""

    kind: str
    """"engine": one domain as the prediction of another; "restarted engine": an engine that goes on
    from the domain's last known frame; "noise"; "chaos"."""
    first: str
    test: str
    interval: str
    mse: Values
    """Mean [m²]."""
    median: Values
    curve: Values = ()


class Gap(msgspec.Struct, frozen=True):
    """A training on a domain against the model trained there, both means over seeds."""

    model: str
    kind: str
    """"single", "leave-one-out" or "all"."""
    training: str
    test: str
    seeds: tuple[int, int]
    """Of the training and of the target's."""
    own: Values
    """Error of the training on its own domain [m²]; of several on that whose bound is least."""
    transferred: Values
    """Error of the training on the target [m²]."""
    target: Values
    """Error on the target of the model trained there [m²]."""
    ratio: Values
    ratio_low: Values
    ratio_high: Values
    difference: Values
    """[m²]"""
    difference_low: Values
    difference_high: Values
    engine_floor: Values
    """D of that domain's engine, gone on from the target's last known frame [m²]."""
    noise_floor: Values
    chaos_floor: Values
    resolved: tuple[bool, ...]
    why: tuple[str, ...]
    """Why a shift is not resolvable; empty where it is."""


class PairRatio(msgspec.Struct, frozen=True):
    """A ratio of errors of one model that learned from two domains, at each frame."""

    model: str
    first: str
    second: str
    """Domains that taught it."""
    seeds: int
    """Of the training that has fewer."""
    value: Values
    low: Values
    high: Values
    resolved: tuple[bool, ...]
    """Whether it is told from 1, of all such ratios of the study together."""


class Interaction(PairRatio, frozen=True):
    """What a change between two engines costs a model, both ways together.

    √(R_ij R_ji / (R_ii R_jj)) of mean squared errors, each domain trained and tested on: the luck
    of trainings and how hard the domains are cancel in it; 1 is no loss.
    """

    noticed: tuple[bool, ...] = ()
    """Whether the domains are further apart than the model errs where it learned."""


class Harm(PairRatio, frozen=True):
    """What the error of its data costs a model: its error on the truth over the least to be had.

    That is where the second taught it, the reference's data that are nearest the truth.
    """


class Agreement(msgspec.Struct, frozen=True):
    """Whether two domains, or a domain and the paper, rank the models alike."""

    first: str
    second: str
    frame: int
    models: tuple[str, ...]
    tau: float | None
    """Kendall's τ-b."""


class BoundedRatio(msgspec.Struct, frozen=True):
    """A figure that is 1 where nothing changes, at the frames, with its 95 % interval."""

    value: Values
    low: Values
    high: Values


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """A question, and its answer from the figures."""

    kind: str
    """"worth", "interaction", "resolvable", "robust", "leave-one-out", "all", "matched" or
    "speed"."""
    question: str
    answer: str
    variant: str = ""
    ratios: dict[str, BoundedRatio] = {}
    """By model: of "robust" the worst gap, of the others the ratio that decides the answer."""


class Shift(msgspec.Struct, frozen=True, kw_only=True):
    """A study of one scene."""

    schema: str = SCHEMA
    scene: str
    description: str
    command: str
    machine: str
    versions: dict[str, str]
    frame_s: float
    length_m: float
    history: int
    horizon: int
    stride: int
    lost: float
    exploded: float
    draws: int
    """Of the bootstrap."""
    frames: tuple[int, ...]
    at: int
    """Which of them answers and tables are given at."""
    index: tuple[int, ...]
    """Numbers of the trajectories."""
    noise: bool
    domains: tuple[DomainFacts, ...]
    left_out: dict[str, str]
    models: tuple[TrainedFacts, ...]
    cells: tuple[ErrorCell, ...]
    floors: tuple[ErrorFloor, ...]
    gaps: tuple[Gap, ...]
    agreements: tuple[Agreement, ...]
    answers: tuple[Answer, ...]
    interactions: tuple[Interaction, ...] = ()
    contact_frames: tuple[int, ...] = ()
    """Frames from the first contact on, of `after_contact`; none without contact in flight."""
    contact_trajectories: int = 0
    after_contact: tuple[Interaction, ...] = ()
    """As `interactions`, at these frames."""
    harms: tuple[Harm, ...] = ()
    """Of studies that have data of the reference, too."""
    wall_s: float
    kept: int = 0
    """How many of the models had been tested before, in no time of this."""


def values(numbers: Iterable[float], digits: int = 7) -> Values:
    """Write numbers, to so many digits; those that are not finite become None."""
    return tuple(float(f"{x:.{digits}g}") if math.isfinite(x) else None for x in numbers)

"""Results of a shift study, as they are written to JSON; `docs/shift.md` defines every figure.

Lists that go with `frames` have one value per frame. Null stands for a value that is unknown,
missing, or not finite.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

SCHEMA = "mbds-xsim/shift/1"
FRAMES = (1, 10, 20, 30, 40, 50, 60, 90, 100)
"""Frames after the last known one at which errors are reported."""
INTERVALS = ("all", "low", "medium", "high")

Values = tuple[float | None, ...]


class DomainFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """Domain on which a model can be tested."""

    name: str
    engine: str
    variant: str
    content: str
    """Checksum of the data."""
    cost_s: float | None = None
    """Processor time of the engine per trajectory [s]; None if the data have no log."""


class TrainedFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """Model that was tested."""

    model: str
    training: str
    engines: tuple[str, ...]
    seed: int
    profile: str
    steps: int
    """Number of optimiser steps; 0 if not stated."""
    ended: str
    content: str
    """Checksum of its file; its name for trivial models."""
    interval: str = ""
    """Interval of the starts that it was trained on; empty for all."""
    bodies: bool = False
    """Whether it starts from the bodies' states, not from the particles' positions alone."""
    to_floor_s: float | None = None
    """Processor time of training until it was as near its engine as the nearest other one [s]."""
    trajectories: int = 0
    """Number of trajectories that it was trained on; 0 if not stated."""


class ErrorCell(msgspec.Struct, frozen=True):
    """Figures of one model, training and seed on one domain, over one interval."""

    model: str
    training: str
    seed: int
    test: str
    interval: str
    known: tuple[int, ...]
    """Number of trajectories whose truth is known."""
    finite: tuple[int, ...]
    """Number of known trajectories whose prediction is finite."""
    diverged: tuple[int, ...]
    """Number of known trajectories whose prediction was not finite or had exploded by then."""
    mse: Values
    """Mean squared error of known trajectories; lost or exploded ones count as exploded [m²]."""
    median: Values
    """Median squared error of known trajectories; predictions not finite are infinite [m²]."""
    energy: Values
    """Median of the energy error."""
    gap: Values
    """Median of the constraint gap [m]."""
    one_step: float | None
    """Mean of the teacher-forced error [m²]."""
    valid_s: float | None
    """Median valid prediction time [s]; trajectories that are never lost count with the horizon."""
    never_lost: int
    """Number of trajectories that stayed valid over the whole horizon."""
    curve: Values = ()
    """Median squared error at every frame [m²]; only for interval "all"."""


class ErrorFloor(msgspec.Struct, frozen=True):
    """Floor below which no figure on a domain resolves anything."""

    kind: str
    """Kind: "engine", one domain as the prediction of another; "restarted engine", an engine that
    goes on from the domain's last known frame; "noise"; "chaos"."""
    first: str
    test: str
    interval: str
    mse: Values
    """Mean squared distance [m²]."""
    median: Values
    curve: Values = ()


class Gap(msgspec.Struct, frozen=True):
    """Training compared on a domain with the model trained there, both as means over seeds."""

    model: str
    kind: str
    """Kind of training: "single", "leave-one-out" or "all"."""
    training: str
    test: str
    seeds: tuple[int, int]
    """Number of seeds of the training and of the target's."""
    own: Values
    """Error of the training on its own domain [m²]; with several, on that of the least bound."""
    transferred: Values
    """Error of the training on the target [m²]."""
    target: Values
    """Error on the target of the model trained there [m²]."""
    ratio: Values
    ratio_low: Values
    ratio_high: Values
    difference: Values
    """Difference of the errors `transferred` and `target` [m²]."""
    difference_low: Values
    difference_high: Values
    engine_floor: Values
    """Squared distance D of that domain's engine from the target, restarted in its window [m²]."""
    noise_floor: Values
    chaos_floor: Values
    resolved: tuple[bool, ...]
    why: tuple[str, ...]
    """Why a shift is not resolvable; empty where it is."""


class PairRatio(msgspec.Struct, frozen=True):
    """Ratio of errors of one model that learned from two domains, at each frame."""

    model: str
    first: str
    second: str
    """Second of the two domains that it learned from."""
    seeds: int
    """Number of seeds of the training that has fewer."""
    value: Values
    low: Values
    high: Values
    resolved: tuple[bool, ...]
    """Whether it differs from 1 significantly, among all such ratios of the study."""


class Interaction(PairRatio, frozen=True):
    """Cost of a change between two domains to a model, both directions together.

    √(R_ij R_ji / (R_ii R_jj)) of mean squared errors, trained on domain i and tested on j: the luck
    of trainings and the difficulty of domains cancel; 1 is no loss.
    """

    noticed: tuple[bool, ...] = ()
    """Whether the domains are further apart than the model's error at home."""


class Harm(PairRatio, frozen=True):
    """Cost of data errors to a model: its error on the truth, over that after the best data.

    The best data are those of `second`, the reference's data that are nearest the truth.
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
    """Figure at each frame that is 1 if nothing changes, with its 95 % interval."""

    value: Values
    low: Values
    high: Values


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """Question, and its answer from the figures."""

    kind: str
    """Kind: "worth", "interaction", "resolvable", "robust", "leave-one-out", "all", "matched" or
    "speed"."""
    question: str
    answer: str
    variant: str = ""
    ratios: dict[str, BoundedRatio] = {}
    """Ratios by model: the worst gap for "robust", else the ratio that decides the answer."""


class Shift(msgspec.Struct, frozen=True, kw_only=True):
    """Study of one scene."""

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
    """Number of bootstrap draws."""
    frames: tuple[int, ...]
    at: int
    """Frame of answers and tables, one of `frames`."""
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
    """Frames since the first contact, for `after_contact`; empty if too few motions have one."""
    contact_trajectories: int = 0
    after_contact: tuple[Interaction, ...] = ()
    """Interactions at these frames."""
    harms: tuple[Harm, ...] = ()
    """Harms by data; only in studies that have data of the reference, too."""
    harms_after_contact: tuple[Harm, ...] = ()
    """Harms at `contact_frames`."""
    wall_s: float
    kept: int = 0
    """Number of models that had been tested before and took no time of this study."""

    def contact_place(self, frame: int) -> int:
        """Return the place in `contact_frames` of the last that is not after a frame."""
        return max(k for k, since in enumerate(self.contact_frames) if since <= frame)


def values(numbers: Iterable[float], digits: int = 7) -> Values:
    """Round numbers to so many significant digits; those that are not finite become None."""
    return tuple(float(f"{x:.{digits}g}") if math.isfinite(x) else None for x in numbers)

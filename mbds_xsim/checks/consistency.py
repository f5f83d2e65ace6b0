"""Do runs at halved steps converge, at the declared order, to the reference?

An accuracy budget lets a wrong model pass as long as it is a little wrong. Here the error of the
method itself is taken out by Richardson extrapolation, so that what is left is the model's.
Roache, Verification and Validation in Computational Science and Engineering, 1998, chapter 5.

The extrapolation holds where steps are short enough for the declared order to show. Three runs
suffice where they are; further ones, each at half the step of the one before, are asked for by
`Consistency.unsettled`. Where even those show no order, the check says that it cannot measure.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.agreement import CHAOS, markers_of
from mbds_xsim.checks.conservation import energy_of
from mbds_xsim.checks.coordinates import clear_of_stops
from mbds_xsim.checks.extrapolation import (
    LEAST_SPAN,
    OVER,
    SHORT,
    Extrapolation,
    extrapolate,
    running,
)
from mbds_xsim.checks.finding import Finding
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import Method

_FACTOR = 3.0
_UNEXPLAINED = 5.0
"""Moves of the finest run beyond which no order explains how far the reference is: at half an
order already, all that is left to converge is 2.4 moves."""
_HARMLESS = 1e-3
"""Of the accuracy budget: noise of the engine's arithmetic up to here has no order to show."""
UNMEASURED = "not measurable"
"""What a finding's note says of trajectories that it does not judge."""
STOPPED = "run of the check stopped"
"""What a finding's note says of a run of its own that did not reach the end."""
_PLACES = ("coarsest", "second coarsest", "third", "fourth", "fifth")


@dataclass(frozen=True, eq=False)
class Consistency:
    """Runs at steps h, h/2, h/4 and so on, whose limit is held against the reference."""

    scene: Scene
    batch: Batch
    """Its starts and inputs."""
    runs: Sequence[Trajectory]
    """Two or more, each at half the step of the one before. Three are far sharper than two: they
    show the order, and so how good the extrapolation is. Four show whether it is steady."""
    reference: Trajectory
    """The solution that the limit must meet."""
    method: Method
    """Whose order is extrapolated with."""
    growth: Array | None = None
    """Sensitivity G, shape (trajectory, frame), if known."""
    resolution: float = 1e-9
    """Accuracy of the reference and of the engine's arithmetic, over the scene's length and over
    the energy scale; grows with G."""
    step: float = 0.0
    """The shortest one [s]; 0: unknown. By so much the instant of a bump may be off."""

    @property
    def findings(self) -> list[Finding]:
        """Findings for positions (particles) and for energy.

        Their series is the deviation of the limit over its estimated uncertainty, which may reach
        3, at each frame by the shortest steps that show the order; frames outside the asymptotic
        range, or of growth 100 and more, are NaN. A trajectory that shows the declared order over
        no ten frames has no figure. It does not pass where it converges at a lower order or not at
        all. Where the order still rises, or runs of the check stopped, it is not judged, and the
        note says why, unless it is further from the reference than any order explains.
        """
        return [_finding(each, self) for each in self._compared]

    @property
    def unsettled(self) -> bool:
        """Whether a run at half the shortest step could change the findings.

        It could where no order shows, where a run stopped early, and where the limit misses the
        reference by no more than an order that is not steady explains.
        """
        return any(bool(each.open.any()) for each in self._compared)

    @functools.cached_property
    def _compared(self) -> list[_Comparison]:
        scene, every, growth = self.scene, (*self.runs, self.reference), self.growth
        order, lower = self.method.order_for(scene), self.method.velocity_order_for(scene)
        mechanism = Mechanism.of(scene)
        places = [_flat(markers_of(mechanism, run)) for run in every]
        stored = [energy_of(Record(scene, self.batch, run)) for run in every]
        levels = [energy.by_body / stored[-1].scale[:, None, None] for energy in stored]
        shape = places[-1].shape[:2]
        grown = np.ones(shape) if growth is None else np.maximum(1.0, growth[:, : shape[1]])
        near = scene.length * scene.budget.error_1s
        with np.errstate(over="ignore", invalid="ignore"):
            predictable = grown < CHAOS
            # A jump of a body's kinetic energy is known, whenever it is.
            lifted = levels[-1][..., mechanism.body_count :]
            floors = [
                scale * self.resolution * grown + self._late(values)
                for scale, values in ((scene.length, places[-1]), (1.0, lifted))
            ]
            positions = "consistency of positions", places, floors[0], predictable, near
            allowed = scene.budget.energy
            energies = "consistency of energy", levels, floors[1], predictable, allowed
            compare = functools.partial(_compare, mechanism.braked or mechanism.saturates)
            both = [compare(each, *energies) for each in (order, lower)]
            return [compare(order, *positions), _either(*both) if lower < order else both[0]]

    @functools.cached_property
    def _bumps(self) -> Mask:
        """Steps in which a joint may stick or run into a stop, or a servo saturate."""
        record = Record(self.scene, self.batch, self.reference)
        clear = clear_of_stops(record.mechanism, record.world, record.frame, None)
        return np.asarray(~(clear & record.steady))

    def _late(self, values: Array) -> Array:
        """Say what bumps up to each frame leave open, as runs may agree on the wrong instant.

        In a step the rates of the values jump, at an instant that may be off by as much as a step.

        Args:
            values: Of the reference, shape (trajectory, frame, component).
        """
        step = self.step * 2.0 ** max(0, len(self.runs) - 3)  # the shortest of the first three
        bend = np.pad(np.linalg.norm(np.diff(values, 2, axis=1), axis=-1), ((0, 0), (1, 1)))
        jumps = np.where(self._bumps, np.nan_to_num(bend[:, :-1] + bend[:, 1:]), 0.0)
        grown = np.maximum.accumulate(jumps, axis=1)
        return step / self.scene.clock.frame * np.pad(grown, ((0, 0), (1, 0)))


@dataclass(frozen=True, eq=False)
class _Comparison:
    """One quantity of all runs, held against the reference."""

    name: str
    declared: str
    bumps: bool
    """As in `extrapolate`: there one order says little of the next."""
    series: Array
    """Deviation of the limit over its uncertainty, NaN where no order shows, (trajectory, frame).
    """
    orders: Array
    """Typical order of each three runs that follow each other; NaN: none, (trajectory, three)."""
    unexplained: Array
    """Distance of the finest run from the reference over what any order could leave of it, the
    largest of the frames that are predictable, shape (trajectory,)."""
    harmless: Mask
    """Whether the runs differ by less than matters to any budget, shape (trajectory,)."""
    stopped: Mask
    """Whether one of the last three runs ends while the reference goes on, (trajectory,)."""
    brief: Mask
    """Whether less than half of the frames that are predictable are judged, (trajectory,)."""

    @property
    def judged(self) -> Mask:
        """Trajectories with a figure, shape (trajectory,)."""
        return np.asarray(np.isfinite(self.series).any(axis=1))

    @property
    def open(self) -> Mask:
        """Trajectories of which finer runs could tell more, shape (trajectory,)."""
        passed = ~(np.nan_to_num(self.series).max(axis=1) > _FACTOR)
        return (self.unexplained <= 1.0) & (self.brief | self.stopped | ~passed)

    def refusal(self, row: int) -> str:
        """Say what is wrong with the orders of a trajectory that is not judged; empty: nothing."""
        seen = self.orders[row][np.isfinite(self.orders[row])]
        if self.unexplained[row] > 1.0:
            return f"{_told(seen)} observed, and further from the reference than any explains"
        alone = len(seen) == 1 and self.orders.shape[1] == 1 and not self.bumps
        rises = len(seen) > 1 and seen[-1] > seen[0] + OVER and seen.mean() > SHORT
        if not len(seen) or self.harmless[row] or not (alone or len(seen) > 1) or rises:
            return ""
        return f"{_told(seen)} observed, nowhere as high as declared"

    def excuse(self, row: int, runs: Sequence[Trajectory]) -> str:
        """Say why a trajectory cannot be judged."""
        seen = self.orders[row][np.isfinite(self.orders[row])]
        if len(seen) and self.harmless[row]:
            return "the runs differ by less than a thousandth of the accuracy budget at any step"
        if len(seen) > 1:
            return f"the order still rises as steps are halved, {_told(seen)}"
        if stops := _stops(runs, row):
            return stops
        irregular = f"three runs do not tell how errors of bumps fall, {_told(seen)}"
        return irregular if len(seen) else "the runs agree to rounding"


def _either(first: _Comparison, second: _Comparison) -> _Comparison:
    """Take the second where the first judges little of a trajectory and the second does not.

    Energy goes from body to body at the order of the velocities, its sum at that of positions.
    """
    rows = first.brief & ~second.brief
    picked: dict[str, Any] = {
        name: np.where(rows if a.ndim == 1 else rows[:, None], getattr(second, name), a)
        for name, a in vars(first).items()
        if isinstance(a, np.ndarray)
    }
    orders = f"{first.declared} of positions and {second.declared} of velocities"
    return dataclasses.replace(first, declared=orders, **picked)


def _compare(
    bumps: bool,
    order: int,
    name: str,
    values: list[Array],
    floor: Array,
    predictable: Mask,
    budget: float,
) -> _Comparison:
    frames = min(value.shape[1] for value in values)
    floor, predictable = floor[:, :frames], predictable[:, :frames]
    *runs, truth = (value[:, :frames] for value in values)
    found = [extrapolate(part, order, floor, bumps=bumps) for part in _threes(runs)]
    series = np.full(floor.shape, np.nan)
    before: Extrapolation | None = None
    for each, finest in zip(found, runs[-len(found) :], strict=True):
        judged = _longest(each.asymptotic & predictable)
        deviation = np.sqrt(np.sum((each.limit - truth) ** 2, axis=-1))
        unsure = each.uncertainty if before is None else _unsteady(before, each, finest, floor)
        series, before = np.where(judged, deviation / unsure, series), each
    moves = running(runs[-1] - runs[-2])
    left = np.sqrt(np.sum((runs[-1] - truth) ** 2, axis=-1)) / (_UNEXPLAINED * moves + floor)
    known = predictable & np.isfinite(left)
    there = np.isfinite(truth).all(axis=-1)
    ended = predictable & there & ~np.isfinite(found[-1].uncertainty)
    orders = [np.where(known & np.isfinite(each.order), each.order, np.nan) for each in found]
    return _Comparison(
        name=name,
        declared=str(order),
        bumps=bumps,
        series=series,
        orders=np.stack([_median(each) for each in orders], axis=1),
        unexplained=np.where(known, left, 0.0).max(axis=1),
        harmless=np.where(known, moves, 0.0).max(axis=1) <= _HARMLESS * budget,
        stopped=np.asarray(ended.any(axis=1)),
        brief=2 * np.isfinite(series).sum(axis=1) < (predictable & there).sum(axis=1),
    )


def _threes(runs: list[Array]) -> list[list[Array]]:
    """Give the runs three at a time, or the two that there are."""
    return [runs[k : k + 3] for k in range(max(1, len(runs) - 2))]


def _unsteady(before: Extrapolation, found: Extrapolation, finest: Array, floor: Array) -> Array:
    """Take all that the extrapolation moves for uncertain where the order itself still moves.

    An order that rises passes the declared one, and then looks as if it were confirmed.
    """
    moves = np.abs(found.order - before.order) > OVER
    whole = running(found.limit - finest) + floor
    return np.where(moves, np.maximum(found.uncertainty, whole), found.uncertainty)


def _finding(compared: _Comparison, about: Consistency) -> Finding:
    batch, runs, frame = about.batch, about.runs, about.scene.clock.frame
    rows = range(len(compared.series))
    refused = {row: compared.refusal(row) for row in rows if not compared.judged[row]}
    remarks: dict[str, list[str]] = {}
    for row in rows:
        remark = "" if refused.get(row, "refused") else compared.excuse(row, runs)
        remark = f"{UNMEASURED}, because {remark}" if remark else _stops(runs, row)
        if remark:
            remarks.setdefault(remark, []).append(str(batch.index[row]))
    told = [f"trajectory {', '.join(indices)}: {remark}" for remark, indices in remarks.items()]
    note = "; ".join([f"order {compared.declared} declared", *told])
    finding = Finding.of(compared.name, "1", compared.series[..., None], budget=_FACTOR, note=note)
    spans = (refused.get(row) or _span(compared.series[row], frame) for row in rows)
    judged = np.array([refused.get(row, "judged") != "" for row in rows])
    return dataclasses.replace(finding, where=tuple(spans), applies=judged)


def _told(orders: Array) -> str:
    """Spell out orders, coarsest steps first."""
    return f"order {', '.join(f'{order:.2f}' for order in orders)}" if len(orders) else "no order"


def _stops(runs: Sequence[Trajectory], row: int) -> str:
    """Say which runs of a trajectory stopped, and why."""
    ends = [(k, run.failures[row]) for k, run in enumerate(runs)]
    return ", ".join(
        f"the {_PLACES[k]} {STOPPED} at frame {end.frame} ({end.reason})"
        for k, end in ends
        if end is not None
    )


def _median(values: Array) -> Array:
    """Median of what is known of each row, NaN where nothing is."""
    return np.array(
        [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in values]
    )


def _flat(points: Array) -> Array:
    """Components whose sum of squares is the mean square over the particles."""
    scaled = points / np.sqrt(points.shape[2])
    return scaled.reshape(*points.shape[:2], -1)


def _longest(mask: Mask) -> Mask:
    """Keep each row's longest unbroken stretch, if it is long enough to judge by."""
    kept = np.zeros_like(mask)
    least = min(LEAST_SPAN, mask.shape[1])
    for row, keep in zip(mask, kept, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
        begins, ends = edges[::2], edges[1::2]
        if len(begins):
            best = int(np.argmax(ends - begins))
            if ends[best] - begins[best] >= least:
                keep[begins[best] : ends[best]] = True
    return kept


def _span(series: Array, frame: float) -> str:
    frames = np.flatnonzero(np.isfinite(series))
    if not len(frames):
        return ""
    return f"judged from {frames[0] * frame:.2f} to {frames[-1] * frame:.2f} s"

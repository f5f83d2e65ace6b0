"""Do runs at halved steps converge, at the declared order, to the reference?

An accuracy budget lets a slightly wrong model pass. Here Richardson extrapolation removes the
error of the method itself, so that the error that is left is the model's.
Roache, Verification and Validation in Computational Science and Engineering, 1998, chapter 5.

The extrapolation holds if steps are short enough for the declared order to show. Then three runs
suffice; if not, `Consistency.unsettled` asks for further ones, each at half the step of the one
before. If even those show no order, the check reports that it cannot measure.
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
"""Distance of the finest run from the reference, over its difference from the run before it, that
no order explains: even order ½ leaves only 2.4 such differences to converge."""
_HARMLESS = 1e-3
"""Share of the accuracy budget: smaller differences of runs are noise, which shows no order."""
UNMEASURED = "not measurable"
"""Words in a finding's note for trajectories that it does not judge."""
STOPPED = "run of the check stopped"
"""Words in a finding's note for a run of the check that did not reach the end."""
_PLACES = ("coarsest", "second coarsest", "third", "fourth", "fifth")


@dataclass(frozen=True, eq=False)
class Consistency:
    """Runs at steps h, h/2, h/4 and so on, whose limit is compared with the reference."""

    scene: Scene
    batch: Batch
    """Starts and inputs of all runs."""
    runs: Sequence[Trajectory]
    """Two or more, each at half the step of the one before. Three are far sharper than two: they
    show the order, and so how good the extrapolation is. Four show whether the order is steady."""
    reference: Trajectory
    """Reference solution that the limit must meet."""
    method: Method
    """Method whose order the extrapolation uses."""
    growth: Array | None = None
    """Sensitivity G, shape (trajectory, frame); None if unknown."""
    resolution: float = 1e-9
    """Accuracy of the reference and of the engine's arithmetic, over the scene's length and over
    the energy scale; grows with G."""
    step: float = 0.0
    """Shortest step [s], 0 if unknown. The instant of a bump may be off by that much."""

    @property
    def findings(self) -> list[Finding]:
        """Findings for positions (particles) and for energy.

        Their series is the deviation of the limit over its estimated uncertainty, which may reach
        3. Each frame uses the shortest steps that show the order; frames outside the asymptotic
        range, or with growth of 100 or more, are NaN. A trajectory without ten successive frames of
        the declared order has no figure. It fails if it converges at a lower order or not at all.
        If the order still rises, or runs of the check stopped, it is not judged and the note says
        why, unless it is farther from the reference than any order explains.
        """
        return [_finding(each, self) for each in self._compared]

    @property
    def unsettled(self) -> bool:
        """Whether a run at half the shortest step could change the findings.

        It could if no order shows, if a run stopped early, or if the limit misses the reference by
        no more than an unsteady order explains.
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
            # The size of a jump in kinetic energy is known, whatever its instant.
            lifted = levels[-1][..., mechanism.body_count :]
            floors = [
                scale * self.resolution * grown + self._late(values)
                for scale, values in ((scene.length, places[-1]), (1.0, lifted))
            ]
            positions = "consistency of positions", places, floors[0], predictable, near
            allowed, beside = scene.budget.energy, self._bumps
            beside = np.pad(beside, ((0, 0), (1, 0))) | np.pad(beside, ((0, 0), (0, 1)))
            energies = "consistency of energy", levels, floors[1], predictable, allowed, beside
            compare = functools.partial(_compare, mechanism.braked or mechanism.saturates)
            both = [compare(each, *energies) for each in (order, lower)]
            return [compare(order, *positions), _either(*both) if lower < order else both[0]]

    @functools.cached_property
    def _bumps(self) -> Mask:
        """Steps in which a joint may stick or run into a stop, or a servo saturate."""
        record = Record(self.scene, self.batch, self.reference)
        return np.asarray(~(clear_of_stops(record) & record.steady))

    def _late(self, values: Array) -> Array:
        """Bound the error of bumps up to each frame, as runs may agree on the wrong instant.

        A bump makes the rates of the values jump at an instant that may be off by up to a step.

        Args:
            values: Values of the reference, shape (trajectory, frame, component).
        """
        step = self.step * 2.0 ** max(0, len(self.runs) - 3)  # the shortest of the first three
        bend = np.pad(np.linalg.norm(np.diff(values, 2, axis=1), axis=-1), ((0, 0), (1, 1)))
        jumps = np.where(self._bumps, np.nan_to_num(bend[:, :-1] + bend[:, 1:]), 0.0)
        grown = np.maximum.accumulate(jumps, axis=1)
        return step / self.scene.clock.frame * np.pad(grown, ((0, 0), (1, 0)))


@dataclass(frozen=True, eq=False)
class _Comparison:
    """One quantity of all runs, compared with the reference."""

    name: str
    declared: str
    bumps: bool
    """Whether motions have bumps, as in `extrapolate`; one order then says little of the next."""
    series: Array
    """Deviation of the limit over its uncertainty, NaN where no order shows, (trajectory, frame).
    """
    orders: Array
    """Median order of each three successive runs, NaN if none shows; (trajectory, triple)."""
    unexplained: Array
    """Distance of the finest run from the reference over the most that any order could leave,
    largest over the predictable frames, shape (trajectory,)."""
    harmless: Mask
    """Whether the runs differ too little to matter to any budget, shape (trajectory,)."""
    stopped: Mask
    """Whether one of the last three runs ends while the reference goes on, (trajectory,)."""
    brief: Mask
    """Whether fewer than half of the predictable frames are judged, shape (trajectory,)."""

    @property
    def judged(self) -> Mask:
        """Whether each trajectory has a figure, shape (trajectory,)."""
        return np.asarray(np.isfinite(self.series).any(axis=1))

    @property
    def open(self) -> Mask:
        """Whether finer runs could change the result, shape (trajectory,)."""
        passed = ~(np.nan_to_num(self.series).max(axis=1) > _FACTOR)
        return (self.unexplained <= 1.0) & (self.brief | self.stopped | ~passed)

    def refusal(self, row: int) -> str:
        """Return what is wrong with orders of a trajectory without a figure; empty if nothing."""
        orders = self.orders[row][np.isfinite(self.orders[row])]
        if self.unexplained[row] > 1.0:
            return f"{_describe(orders)} observed, but further from the reference than any explains"
        alone = len(orders) == 1 and self.orders.shape[1] == 1 and not self.bumps
        rises = len(orders) > 1 and orders[-1] > orders[0] + OVER and orders.mean() > SHORT
        if not len(orders) or self.harmless[row] or not (alone or len(orders) > 1) or rises:
            return ""
        return f"{_describe(orders)} observed, nowhere as high as declared"

    def excuse(self, row: int, runs: Sequence[Trajectory]) -> str:
        """Return the reason why a trajectory cannot be judged."""
        orders = self.orders[row][np.isfinite(self.orders[row])]
        if len(orders) and self.harmless[row]:
            return "the runs differ by less than a thousandth of the accuracy budget at any step"
        if len(orders) > 1:
            return f"the order still rises as steps are halved, {_describe(orders)}"
        if stops := _stops(runs, row):
            return stops
        irregular = f"three runs do not tell how errors of bumps fall, {_describe(orders)}"
        return irregular if len(orders) else "the runs agree to rounding"


def _either(first: _Comparison, second: _Comparison) -> _Comparison:
    """Take the second comparison for trajectories of which only the first judges too little.

    Energy exchanged between bodies converges at the order of velocities, its sum at that of
    positions.
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
    beside: Mask | None = None,
) -> _Comparison:
    """Compare runs with the reference; the quantity jumps next to frames in `beside`, if any."""
    frames = min(value.shape[1] for value in values)
    floor, predictable = floor[:, :frames], predictable[:, :frames]
    *runs, truth = (value[:, :frames] for value in values)
    threes = [runs[k : k + 3] for k in range(max(1, len(runs) - 2))]  # or both, if there are two
    limits = [extrapolate(part, order, floor, bumps=bumps) for part in threes]
    series = np.full(floor.shape, np.nan)
    before: Extrapolation | None = None
    for each, finest in zip(limits, runs[-len(limits) :], strict=True):
        judged = _longest(each.asymptotic & predictable)
        deviation = np.sqrt(np.sum((each.limit - truth) ** 2, axis=-1))
        uncertainty = each.uncertainty if before is None else _unsteady(before, each, finest, floor)
        figure = _off_peaks(deviation / uncertainty, beside)
        series, before = np.where(judged, figure, series), each
    moves = running(runs[-1] - runs[-2])
    ratio = np.sqrt(np.sum((runs[-1] - truth) ** 2, axis=-1)) / (_UNEXPLAINED * moves + floor)
    ratio = _off_peaks(ratio, beside)
    known = predictable & np.isfinite(ratio)
    there = np.isfinite(truth).all(axis=-1)
    ended = predictable & there & ~np.isfinite(limits[-1].uncertainty)
    orders = [np.where(known & np.isfinite(each.order), each.order, np.nan) for each in limits]
    return _Comparison(
        name=name,
        declared=str(order),
        bumps=bumps,
        series=series,
        orders=np.stack([_median(each) for each in orders], axis=1),
        unexplained=np.where(known, ratio, 0.0).max(axis=1),
        harmless=np.where(known, moves, 0.0).max(axis=1) <= _HARMLESS * budget,
        stopped=np.asarray(ended.any(axis=1)),
        brief=2 * np.isfinite(series).sum(axis=1) < (predictable & there).sum(axis=1),
    )


def _off_peaks(figure: Array, beside: Mask | None) -> Array:
    """Lower peaks of one frame next to a bump: a jump just before it may be after it in all runs.

    Runs tell an instant to a step, and a frame within this step has the energy of before or after.
    """
    if beside is None:
        return figure
    around = np.pad(figure, ((0, 0), (1, 1)), constant_values=np.nan)
    highest = np.fmax(around[:, :-2], around[:, 2:])
    return np.where(beside[:, : figure.shape[1]] & (figure > highest), highest, figure)


def _unsteady(before: Extrapolation, after: Extrapolation, finest: Array, floor: Array) -> Array:
    """Return the uncertainty, at least the whole extrapolation where the order still changes.

    A rising order passes through the declared one, and then looks as if it were confirmed.
    """
    moves = np.abs(after.order - before.order) > OVER
    whole = running(after.limit - finest) + floor
    return np.where(moves, np.maximum(after.uncertainty, whole), after.uncertainty)


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
    lines = [f"trajectory {', '.join(indices)}: {remark}" for remark, indices in remarks.items()]
    note = "; ".join([f"order {compared.declared} declared", *lines])
    finding = Finding.of(compared.name, "1", compared.series[..., None], budget=_FACTOR, note=note)
    spans = (refused.get(row) or _span(compared.series[row], frame) for row in rows)
    judged = np.array([refused.get(row, "judged") != "" for row in rows])
    return dataclasses.replace(finding, where=tuple(spans), applies=judged)


def _describe(orders: Array) -> str:
    """Format orders, coarsest steps first."""
    return f"order {', '.join(f'{order:.2f}' for order in orders)}" if len(orders) else "no order"


def _stops(runs: Sequence[Trajectory], row: int) -> str:
    """Describe which runs of a trajectory stopped, and why."""
    ends = [(k, run.failures[row]) for k, run in enumerate(runs)]
    return ", ".join(
        f"the {_PLACES[k]} {STOPPED} at frame {end.frame} ({end.reason})"
        for k, end in ends
        if end is not None
    )


def _median(values: Array) -> Array:
    """Return the median of the known values of each row, NaN if there are none."""
    return np.array(
        [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in values]
    )


def _flat(points: Array) -> Array:
    """Return components whose sum of squares is the mean square over the particles."""
    scaled = points / np.sqrt(points.shape[2])
    return scaled.reshape(*points.shape[:2], -1)


def _longest(mask: Mask) -> Mask:
    """Keep each row's longest unbroken stretch, if it is long enough to judge by."""
    longest = np.zeros_like(mask)
    least = min(LEAST_SPAN, mask.shape[1])
    for row, stretch in zip(mask, longest, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
        begins, ends = edges[::2], edges[1::2]
        if len(begins):
            best = int(np.argmax(ends - begins))
            if ends[best] - begins[best] >= least:
                stretch[begins[best] : ends[best]] = True
    return longest


def _span(series: Array, frame: float) -> str:
    frames = np.flatnonzero(np.isfinite(series))
    if not len(frames):
        return ""
    return f"judged from {frames[0] * frame:.2f} to {frames[-1] * frame:.2f} s"

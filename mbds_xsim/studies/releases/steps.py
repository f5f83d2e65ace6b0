"""Steps: figures that differ by more than a factor of two between releases, and why."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import Literal

import msgspec

from mbds_xsim.measure.runner import Keyed
from mbds_xsim.testing.contact_cases import RESTITUTION

SCHEMA = "mbds-xsim/releases/1"
FACTOR = 2.0
"""Factor between two figures above which their difference is a step."""

UNITS = {"error": "m", "order": "1", "gap": "m", "energy": "1", "restitution": "1", "time": "s"}
"""Units of the figures of a row."""
_QUARTER = 4.0
"""Orders are compared by the error's fall at a quarter of the step: half an order is a step."""
_LEAST = {"error": 1e-9, "gap": 1e-9, "energy": 1e-9, "restitution": 0.01, "order": 1e-14}
"""Differences below these do not count, in the units of the figures that are compared."""


class ReleaseRow(Keyed, frozen=True, kw_only=True):
    """One release of an engine on one case."""

    release: str
    case: str
    way: str
    """Method on a small case, or profile of settings on a scene."""
    kind: Literal["done", "failed", "crashed", "timed out", "refused"] = "done"
    reason: str = ""
    error_m: float | None = None
    """Largest error on a small case at 8 steps per frame; particle error at 1 s on a scene [m]."""
    order: float | None = None
    """Measured order of convergence; None if the answer is met to rounding."""
    gap_m: float | None = None
    energy: float | None = None
    restitution: float | None = None
    """Measured restitution of a ball's impact; 0.9332 was asked for."""
    cpu_s: float | None = None
    """Processor time per simulated second, the least of the repeats."""

    @property
    def name(self) -> str:
        """Case and way."""
        return f"{self.case}, {self.way}"

    @property
    def figures(self) -> dict[str, float | None]:
        """Figures by name, in the order of `UNITS`."""
        values = (
            self.error_m, self.order, self.gap_m, self.energy, self.restitution, self.cpu_s,
        )  # fmt: skip
        return dict(zip(UNITS, values, strict=True))


class Release(msgspec.Struct, frozen=True):
    """One release."""

    version: str
    reason: str = ""
    """Reason why it has no rows: it cannot be installed or driven."""


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """A figure that differs between a release and the one before."""

    release: str
    before: str
    """Previous release that has the row."""
    name: str
    """Case and way."""
    what: str
    unit: str
    old: float | None
    new: float | None
    factor: float | None
    """New over old figure, both by `comparable`, an old one of 0 as the least that counts; None
    if a motion is lost or runs again."""
    course: Literal["worse", "better", "lost", "runs"]
    reason: str = ""
    """Reason why the motion is lost in one of the two releases."""
    explanation: str = ""
    """Explanation in the change log; empty if there is none."""

    @property
    def unexplained(self) -> bool:
        """Whether there is no explanation; a motion that was lost and now runs needs none."""
        return not self.explanation and self.course != "runs"

    @property
    def worse(self) -> bool:
        """Whether the later release is worse, without an explanation."""
        return self.course in ("worse", "lost") and not self.explanation


class History(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a study of an engine's releases: the documented JSON."""

    schema: str
    engine: str
    package: str
    command: str
    machine: str
    versions: dict[str, str]
    measured: int
    kept: int
    wall_s: float
    change_log: str
    """Address of the change log; empty if unknown."""
    releases: tuple[Release, ...]
    steps: tuple[Step, ...]
    rows: tuple[ReleaseRow, ...]

    @property
    def driven(self) -> list[str]:
        """Versions of the releases that were driven."""
        return [release.version for release in self.releases if not release.reason]

    @property
    def names(self) -> list[str]:
        """Names of rows in the order in which they were measured."""
        return list(dict.fromkeys(row.name for row in self.rows))

    @property
    def regressions(self) -> list[Step]:
        """Unexplained worse steps of the newest release, without times, which vary by machine."""
        newest = [step for step in self.steps if step.release == self.releases[-1].version]
        return [step for step in newest if step.worse and step.what != "time"]

    @property
    def verdict(self) -> Literal["pass", "fail"]:
        """Verdict: "pass" if the newest release is driven and has no regressions."""
        return "fail" if self.releases[-1].reason or self.regressions else "pass"

    def by_release(self, name: str) -> dict[str, ReleaseRow]:
        """Return the rows of a name keyed by release, in the order of the releases."""
        return {row.release: row for row in self.rows if row.name == name}

    def series(self, name: str, what: str) -> list[float | None]:
        """Return a figure of the rows of a name in each release that was driven, if it has any."""
        rows = self.by_release(name)
        return [rows[each].figures[what] if each in rows else None for each in self.driven]


class LogLine(msgspec.Struct, frozen=True):
    """Explanation of some rows' steps from a change log."""

    release: str
    rows: str
    """Regular expression that is searched for in a row's name and figure."""
    line: str


class KnownReleases(msgspec.Struct, frozen=True):
    """Known facts about an engine's releases."""

    since: str = ""
    """First release to measure if no other is asked for."""
    source: str = ""
    """Address of the change log."""
    lines: tuple[LogLine, ...] = ()

    def explanation(self, release: str, row: str) -> str:
        """Return the change log's explanation of a row in a release; empty if there is none."""
        lines = (e.line for e in self.lines if e.release == release and re.search(e.rows, row))
        return next(lines, "")


@cache
def known_of(engine: str) -> KnownReleases:
    """Return the known facts about an engine's releases."""
    text = (files(__package__ or "") / "changes.toml").read_bytes()
    known = msgspec.toml.decode(text, type=dict[str, KnownReleases])
    return known.get(engine, KnownReleases())


def steps_of(rows: Sequence[ReleaseRow], known: KnownReleases) -> Iterator[Step]:
    """Compare every row with that of the previous release that has it, the oldest first."""
    last: dict[str, ReleaseRow] = {}
    for row in rows:
        for step in _steps_between(last[row.name], row) if row.name in last else ():
            explanation = known.explanation(step.release, f"{step.name}: {step.what}")
            yield msgspec.structs.replace(step, explanation=explanation)
        last[row.name] = row


def comparable(kind: str, value: float) -> float:
    """Convert a figure to the number that is compared, of which smaller is always better."""
    if kind == "order":
        return _QUARTER**-value
    return abs(value - RESTITUTION) if kind == "restitution" else abs(value)


def _steps_between(old: ReleaseRow, new: ReleaseRow) -> Iterator[Step]:
    at = {"release": new.release, "before": old.release, "name": new.name}
    if (old.kind == "done") != (new.kind == "done"):
        lost = new.kind != "done"
        yield Step(
            **at, what="motion", unit="1", old=None, new=None, factor=None,
            course="lost" if lost else "runs", reason=new.reason if lost else old.reason,
        )  # fmt: skip
        return
    figures = new.figures
    for what, was in old.figures.items():
        factor = _factor(what, was, figures[what])
        if factor is not None:
            yield Step(
                **at, what=what, unit=UNITS[what], old=was, new=figures[what], factor=factor,
                course="worse" if factor > 1.0 else "better",
            )  # fmt: skip


def _factor(what: str, was: float | None, now: float | None) -> float | None:
    """Return the new over the old figure, both by `comparable`; None if there is no step.

    An old figure of exactly 0 counts as the least that matters; 0 s of processor time is none.
    """
    if was is None or now is None:
        return None
    least = _LEAST.get(what, 0.0)
    old, new = comparable(what, was) or least, comparable(what, now)
    same = math.isclose(old, new, rel_tol=1.0 - 1.0 / FACTOR, abs_tol=least)
    return None if same or old == 0.0 else new / old

"""What of a study is carried out, and the runs that it comes to."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from mbds_xsim.engine import Profile
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Trajectory
from mbds_xsim.study.stability.contenders import Contender
from mbds_xsim.study.stability.definition import COUNTS, Study, Value
from mbds_xsim.versions import CHECKS

__all__ = ["LIMIT", "Case", "Job", "Plan"]

LIMIT = 30.0
"""Longest that a cell may take [s]."""


@dataclass(frozen=True)
class Plan:
    """What of a study is carried out, and how."""

    study: Study
    engines: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    """All of an engine's where none is named."""
    profiles: tuple[Profile, ...] = ("matched", "native")
    values: tuple[Value, ...] = ()
    """The study's where none is given."""
    counts: tuple[int, ...] = COUNTS
    """Steps a frame, the fewest first."""
    limit: float = LIMIT
    """Longest that a cell may take [s]."""
    workers: int | None = None
    """Processes at a time; all cores when None, none but this one for 0."""
    fresh: bool = False
    """Whether cells that were measured earlier are measured again."""
    cache: bool = True
    """Whether reference solutions are kept."""
    command: str = ""
    others: tuple[Contender, ...] = ()
    """Who takes part beside the engines' methods."""
    faulty: Mapping[str, str] = field(default_factory=dict)
    """Engines that would take part but cannot be used, each with the reason."""


@dataclass(frozen=True, eq=False)
class Case:
    """The scene at one value."""

    value: Value
    scene: Scene
    batch: Batch
    truth: Trajectory | None


@dataclass(frozen=True, eq=False)
class Job:
    """One cell to be run."""

    case: Case
    contender: Contender
    count: int
    """Steps a frame."""
    key: str
    """Hash of all that decides the figures."""

    @staticmethod
    def of(case: Case, contender: Contender, count: int) -> Job:
        """Make a job, with its key."""
        what = (CHECKS, contender.key(case, count), case.truth is None, case.batch.steps)
        key = hashlib.sha256(repr(what).encode()).hexdigest()
        return Job(case, contender, count, key)

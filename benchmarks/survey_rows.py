"""Stored findings about each published model, and the known causes of failed verdicts."""

from __future__ import annotations

from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

import msgspec

from mbds_xsim.base.text import in_markdown
from mbds_xsim.scene.imported import Fate, Outcome
from mbds_xsim.studies.readers import Difference

READERS = ("mujoco", "pybullet", "dart")
"""Engines whose own readers are surveyed."""


class SurveyRow(msgspec.Struct, omit_defaults=True):
    """Findings about one model."""

    key: str
    package: str
    path: str
    format: str = ""
    refused: str = ""
    """Reason why it is not imported; empty if it is."""
    bodies: int = 0
    degrees_of_freedom: int = 0
    import_s: float = 0.0
    kept: int = 0
    """Number of kept kinds of elements and attributes that affect the motion."""
    lost: tuple[Fate, ...] = ()
    """Other elements and attributes that affect the motion, without their places."""
    from_compiled: float | None = None
    """Largest relative deviation of masses, places and axes from MuJoCo's compiled model."""
    from_second: float | None = None
    """The same deviation from Pinocchio's reading of a URDF."""
    readers: dict[str, str] = {}
    """Results by engine: "alike", "refuses: …", or the fields that its reader reads differently."""
    differences: dict[str, tuple[Difference, ...]] = {}
    """Differences in these fields, by engine."""
    moved_m: dict[str, float] = {}
    """Distance of each engine's bodies from the motion of the file after 1 s [m]."""
    verdicts: dict[str, str] = {}
    """Verdicts by engine, as in `Verdicts`; empty if not validated."""
    reasons: dict[str, str] = {}
    """Reasons for not passing, by engine."""
    reference: str = ""
    """Reason why the reference ends early or is missing."""
    validation_s: float = 0.0

    def counts(self, outcome: Outcome) -> Counter[str]:
        """Count dropped or approximated elements, by element and attribute."""
        counts: Counter[str] = Counter()
        for fate in self.lost:
            if fate.outcome == outcome:
                counts[what_of(fate)] += fate.count
        return counts

    @property
    def place(self) -> str:
        """Package, folder and file of the model."""
        return in_markdown(f"{self.package}: {Path(self.path).parent.name}/{Path(self.path).name}")


def what_of(fate: Fate) -> str:
    """Name an element, and its attribute if there is exactly one."""
    single = fate.properties if len(fate.properties) == 1 else ()
    return " ".join((fate.element, *single))


class Cause(msgspec.Struct):
    """Known cause of failed verdicts."""

    models: str
    """Shell pattern of the models' paths."""
    engine: str
    finding: str
    """Beginning of the verdict's reason; a cause does not outlive its finding."""
    why: str

    def explains(self, row: SurveyRow, engine: str) -> bool:
        """Return whether this is why a model does not pass in an engine."""
        matches = row.reasons.get(engine, "").startswith(self.finding)
        return matches and engine == self.engine and fnmatch(row.path, self.models)

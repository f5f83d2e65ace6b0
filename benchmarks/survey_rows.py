"""What the survey of published models keeps of each, and what was found out about failures."""

from __future__ import annotations

from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

import msgspec

from mbds_xsim.base.text import in_markdown
from mbds_xsim.scene.imported import Fate, Outcome
from mbds_xsim.studies.readers import Difference

READERS = ("mujoco", "pybullet", "dart")
"""Engines whose own readers are looked at."""


class SurveyRow(msgspec.Struct, omit_defaults=True):
    """What was found of one model."""

    key: str
    package: str
    path: str
    format: str = ""
    refused: str = ""
    """Why it is not imported."""
    bodies: int = 0
    degrees_of_freedom: int = 0
    import_s: float = 0.0
    kept: int = 0
    """Elements and attributes that bear on the motion."""
    lost: tuple[Fate, ...] = ()
    """What else bears on the motion, without the places."""
    from_compiled: float | None = None
    """Largest deviation of masses, places and axes from MuJoCo's compiled model, relative."""
    from_second: float | None = None
    """The same from Pinocchio's reading of a URDF."""
    readers: dict[str, str] = {}
    """By engine: "alike", "refuses: …", or the fields that its own reader has otherwise."""
    differences: dict[str, tuple[Difference, ...]] = {}
    """By engine, these fields."""
    moved_m: dict[str, float] = {}
    """By engine, how far the bodies are after 1 s from where the file has them go [m]."""
    verdicts: dict[str, str] = {}
    """By engine, where it was validated: as in `Verdicts`."""
    reasons: dict[str, str] = {}
    """By engine, why it does not pass."""
    reference: str = ""
    """Why the reference ends early, or is not there."""
    validation_s: float = 0.0

    def counts(self, outcome: Outcome) -> Counter[str]:
        """Count what is dropped or approximated, by element and attribute."""
        found: Counter[str] = Counter()
        for fate in self.lost:
            if fate.outcome == outcome:
                found[what_of(fate)] += fate.count
        return found

    @property
    def place(self) -> str:
        """Package, folder and file."""
        return in_markdown(f"{self.package}: {Path(self.path).parent.name}/{Path(self.path).name}")


def what_of(fate: Fate) -> str:
    """Name an element, and its attribute where there is one."""
    single = fate.properties if len(fate.properties) == 1 else ()
    return " ".join((fate.element, *single))


class Cause(msgspec.Struct):
    """What was found out about failed verdicts."""

    models: str
    """Pattern of their paths, as of a shell."""
    engine: str
    finding: str
    """What the verdict's reason begins with: a cause does not outlive its finding."""
    why: str

    def explains(self, row: SurveyRow, engine: str) -> bool:
        """Say whether this is why a model does not pass in an engine."""
        told = row.reasons.get(engine, "").startswith(self.finding)
        return told and engine == self.engine and fnmatch(row.path, self.models)

"""Findings about some trajectories at a time, as one about all of them."""

from __future__ import annotations

import msgspec
import numpy as np

from mbds_xsim.checks import Finding
from mbds_xsim.measure.judge import failed_lines, finding_result
from mbds_xsim.measure.result import FindingResult
from mbds_xsim.scene.state import Batch


class Pooled:
    """Keeps of each check the figures, and what comes off worst."""

    def __init__(self) -> None:
        self._found: dict[str, FindingResult] = {}
        self._excess: dict[str, float] = {}
        self._lines: dict[str, list[str]] = {}

    def add(self, batch: Batch, findings: list[Finding]) -> None:
        """Take findings about further trajectories."""
        for finding in findings:
            row, name = finding.worst, finding.check
            over = float(np.nan_to_num(finding.figure[row] - finding.uncertainty[row], nan=np.inf))
            before, new = self._found.get(name), finding_result(batch, finding)
            if before is None or over > self._excess[name]:
                self._excess[name] = over
                self._lines[name] = failed_lines(batch, [finding])
                worst = new
            else:
                worst = before
            self._found[name] = msgspec.structs.replace(
                worst,
                passed=new.passed and (before is None or before.passed),
                figures=(before.figures if before else ()) + new.figures,
                note=new.note if before is None else "",  # told of some trajectories alone
            )

    @property
    def checks(self) -> set[str]:
        """Those that ran."""
        return set(self._found)

    @property
    def results(self) -> tuple[FindingResult, ...]:
        """One a check, in the order in which they came."""
        return tuple(self._found.values())

    @property
    def reasons(self) -> tuple[str, ...]:
        """A line for each check that failed."""
        return tuple(line for lines in self._lines.values() for line in lines)

"""Write reports/margins.md: how much of its budgets each engine uses at matched settings.

python -m benchmarks.margins reports > reports/margins.md
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import msgspec

from benchmarks.harness import print_head, print_table
from mbds_xsim.base.text import apart
from mbds_xsim.measure.result import FindingResult, Validation, from_plain
from mbds_xsim.report import quantity

_LEAST = 1e-3

_COMMAND = "python -m benchmarks.margins reports > reports/margins.md"
_TEXT = """\
The worst figure of every check, over all starts of all [validated](README.md#validation) scenes, as
a share of what the scene allows. At 100 % a budget is only just kept; where it is not (bold), the
trajectories that are over it are counted. Then the figure itself and the scene; without a share it
is shown and not judged, 0 is exact, and – means that there is no figure. What checks mean:
[checks](../docs/checks.md).
"""


@dataclass(frozen=True, slots=True)
class Worst:
    """Finding of a check that is nearest to its budget, or furthest beyond it."""

    scene: str
    finding: FindingResult

    @property
    def share(self) -> float:
        """Share of the budget, or the figure itself without a budget; infinite if it is NaN."""
        figure = self.finding.figure
        return math.inf if math.isnan(figure) else figure / (self.finding.budget or 1.0)

    @property
    def place(self) -> tuple[bool, float]:
        """Sort key: failed findings are worse than passed ones, then the larger share is worse."""
        return not self.finding.passed, self.share


Found = dict[str, dict[str, Worst]]
"""Worst findings by check, then by engine."""


def main(folder: Path) -> None:
    """Print the page."""
    findings: Found = {}
    for file in sorted(folder.glob("*.json")):
        _add(findings, from_plain(msgspec.json.decode(file.read_bytes()), Validation))
    engines = sorted({engine for worst in findings.values() for engine in worst})
    print_head("How near the budgets", _COMMAND, _TEXT)
    rows = (
        [check, *(_cell(worst.get(engine)) for engine in engines)]
        for check, worst in sorted(findings.items(), key=_tightness)
    )
    print_table("|".join(["check", *engines]), rows)


def _add(findings: Found, validation: Validation) -> None:
    for engine in validation.engines:
        for finding in engine.findings:
            worst = Worst(validation.scene, finding)
            previous = findings.setdefault(finding.check, {}).setdefault(engine.engine, worst)
            if worst.place > previous.place:
                findings[finding.check][engine.engine] = worst


def _tightness(item: tuple[str, dict[str, Worst]]) -> tuple[bool, float]:
    """Return a sort key: the tightest checks first, and those without a budget last."""
    worst = item[1].values()
    return any(one.finding.budget is None for one in worst), -max(one.share for one in worst)


def _cell(worst: Worst | None) -> str:
    if worst is None:
        return quantity.NONE
    finding = worst.finding
    figure, _ = quantity.beside(finding.figure, finding.budget, finding.unit)
    if math.isnan(finding.figure):
        return quantity.NONE if finding.passed else f"**no figure**, {worst.scene}"
    if finding.figure == 0:
        return "0"
    if finding.budget is None:
        return f"{figure}, {worst.scene}"
    percent, _ = apart(100 * worst.share, 100.0, quantity.number, 2)
    share = f"{percent} %"
    if worst.share < _LEAST:
        share = f"<{100 * _LEAST} %"
    if finding.passed:
        return f"{share}: {figure}, {worst.scene}"
    judged = [value for value in finding.figures if value is not None]
    over = sum(value > finding.budget for value in judged)
    return f"**{share}**, {over} of {len(judged)}: {figure}, {worst.scene}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))

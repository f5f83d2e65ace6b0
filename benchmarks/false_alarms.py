"""Does a check blame a sound engine? python -m benchmarks.false_alarms [SCENE…] [--seeds N]

Validates scenes with all defaults, as `mbds-xsim validate SCENE --seed SEED` does, with seeds that
no search for settings has used. It prints the number of runs of each engine, the failed ones and
the reasons. The second table shows the largest figure of each check over its budget.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator

from benchmarks.harness import print_table
from mbds_xsim.base.isolate import HERE
from mbds_xsim.measure.result import EngineResult
from mbds_xsim.scene.sampling import Starts
from mbds_xsim.simulate.choice import Choice
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene
from mbds_xsim.studies.validate import validate_with_evidence

FIRST = 9001


def main(scenes: tuple[str, ...], seeds: int) -> None:
    """Print a line for each engine and scene, then one for each check."""
    worst: dict[str, tuple[float, str]] = defaultdict(lambda: (0.0, ""))
    rows = (row for name in scenes for row in _blamed(name, seeds, worst))
    print_table("scene|engine|seeds|blamed|by", rows)
    print()
    tightest = sorted(worst.items(), key=lambda item: -item[1][0])
    shares = ([check, f"{share:.2f}", run] for check, (share, run) in tightest)
    print_table("check|largest, of its budget|where", shares)


def _blamed(name: str, seeds: int, worst: dict[str, tuple[float, str]]) -> Iterator[list[str]]:
    runs: dict[str, list[tuple[int, EngineResult]]] = defaultdict(list)
    for seed in range(FIRST, FIRST + seeds):
        validation, _ = validate_with_evidence(
            load_scene(name), choice=Choice.parse(), starts=Starts(seed=seed), conduct=HERE
        )
        for row in validation.engines:
            runs[row.engine].append((seed, row))
            _keep(worst, row, f"{name}, {row.engine}, seed {seed}")
    for engine, rows in runs.items():
        blamed = [(seed, row) for seed, row in rows if row.verdict == "fail"]
        reasons = "; ".join(f"seed {seed}: {', '.join(row.reasons)}" for seed, row in blamed)
        yield [name, engine, str(len(rows)), str(len(blamed)), reasons or "–"]


def _keep(worst: dict[str, tuple[float, str]], row: EngineResult, run: str) -> None:
    for finding in row.findings:
        if finding.budget and finding.figure is not None:
            worst[finding.check] = max(worst[finding.check], (finding.figure / finding.budget, run))


if __name__ == "__main__":
    count = int(sys.argv[sys.argv.index("--seeds") + 1]) if "--seeds" in sys.argv else 10
    named = sys.argv[1 : sys.argv.index("--seeds")] if "--seeds" in sys.argv else sys.argv[1:]
    main(tuple(named) or PAPER_SCENES, count)

"""Write reports/contact-limits.md: how near the exact answers contact comes, over many starts.

python -m benchmarks.contact_limits > reports/contact-limits.md
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from benchmarks.harness import print_head, print_table
from mbds_xsim.base.isolate import Crash, Task, run_tasks
from mbds_xsim.checks import Finding, audit
from mbds_xsim.measure.campaign import ReferenceOutcome, run_references
from mbds_xsim.measure.contact import contact_findings
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.matched import settings_for
from mbds_xsim.simulate.registry import installed_engines, load_adapter, load_scene
from mbds_xsim.simulate.timed import Simulation, simulate

_STARTS = 20  # of each interval
_SEED = 3
_CASES = (
    ("ballscroll", False),
    ("ballscroll", True),
    ("balldrop", True),
    ("simplecubli", True),
    ("particlecar", True),
)
_CHECKS = ("penetration", "passivity")

_COMMAND = "python -m benchmarks.contact_limits > reports/contact-limits.md"
_TEXT = f"""\
The worst of {_STARTS} starts of each interval (seed {_SEED}), against what is allowed. Errors are
distances of centres of mass from the exact motion: over all 4 s for `ballscroll`, up to the third
bounce for `balldrop`, up to the first impact for `simplecubli`. Rebound is the height of the first
bounce, relative, told at the frame nearest its top. Passivity, penetration (over the scene's
length) and momentum are the figures of the checks of those names. Where two limits are named, the
second is that of methods of order 4 and more. `mbds-xsim match` keeps to these limits too."""


def main() -> None:
    """Print the page."""
    engines = installed_engines()
    print_head("Contact at matched settings", _COMMAND, _TEXT)
    print_table(f"scene|figure|>{'|>'.join(engines)}|allowed", _rows(engines))


def _rows(engines: Sequence[str]) -> Iterator[list[str]]:
    for name, noise in _CASES:
        found = dict(zip(engines, _figures(name, noise), strict=True))
        yield from _lines(f"{name}, noise {'on' if noise else 'off'}", found)


def _figures(name: str, noise: bool) -> Iterator[dict[str, Finding] | str]:
    """Simulate in each engine and measure, or say what went wrong."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(3 * _STARTS), seed=_SEED, noise=noise)
    exact = run_references(scene, batch, cache=True, workers=None)
    adapters = [load_adapter(engine) for engine in installed_engines()]
    tasks = [
        Task(simulate, (scene, batch, a.name, settings_for(scene, a, "matched"))) for a in adapters
    ]
    for adapter, made in zip(adapters, run_tasks(tasks), strict=True):
        print(name, adapter.name, file=sys.stderr)
        if isinstance(made, Crash):
            yield made.reason
        elif any(made.trajectory.failures):
            yield next(failure.reason for failure in made.trajectory.failures if failure)
        else:
            yield _measured(scene, batch, exact, adapter, made)


def _measured(
    scene: Scene, batch: Batch, exact: ReferenceOutcome, adapter: Adapter, made: Simulation
) -> dict[str, Finding]:
    """Give what the checks and the limits of contact find, by name."""
    motion, settings = made.trajectory, made.settings
    method = adapter.methods[settings.method]
    checks = {
        finding.check: finding
        for finding in audit(scene, batch, motion, method, step=settings.step)
    }
    momentum = checks["momentum"].series if "momentum" in checks else None
    limits = contact_findings(scene, motion, exact, method, momentum)
    kept = [checks[check] for check in _CHECKS if check in checks]
    return {finding.check: finding for finding in [*kept, *limits]}


def _lines(label: str, found: dict[str, dict[str, Finding] | str]) -> Iterator[list[str]]:
    measured = [findings for findings in found.values() if isinstance(findings, dict)]
    for what in dict.fromkeys(check for findings in measured for check in findings):
        told = [findings[what] for findings in measured if what in findings]
        unit = "" if told[0].unit == "1" else f" [{told[0].unit}]"
        cells = [_cell(findings, what) for findings in found.values()]
        budgets = {finding.budget for finding in told if finding.budget is not None}
        allowed = " / ".join(f"{budget:g}" for budget in sorted(budgets, reverse=True))
        yield [label, f"{what}{unit}", *cells, allowed]


def _cell(findings: dict[str, Finding] | str, what: str) -> str:
    """A figure, in bold letters where it is more than is allowed."""
    if isinstance(findings, str):
        return f"**{findings}**"
    if what not in findings:
        return "–"
    finding = findings[what]
    text = f"{finding.figure[finding.worst]:.1e}"
    return text if finding.passed.all() else f"**{text}**"


if __name__ == "__main__":
    main()

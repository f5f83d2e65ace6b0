"""Write reports/contact-limits.md: how near the exact answers contact comes, over many starts.

python benchmarks/contact_limits.py > reports/contact-limits.md
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim import reference, rotation
from mbds_xsim.checks import Finding, audit
from mbds_xsim.isolate import Crash, Task, run_tasks
from mbds_xsim.matched import settings_for
from mbds_xsim.registry import installed_engines, load_adapter, load_scene
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import GRAVITY
from mbds_xsim.simulate import simulate
from mbds_xsim.state import Trajectory

Array = NDArray[np.float64]

_STARTS = 20  # of each interval
_SEED = 3
_CASES = (
    ("ballscroll", False),
    ("ballscroll", True),
    ("balldrop", True),
    ("simplecubli", True),
    ("particlecar", True),
)
_COMPLIANT = ("mujoco", "exudyn")
_HIGH_ORDER = ("mujoco",)  # RK4, away from the ground
_G = -GRAVITY[2]

_HEAD = f"""\
# Contact at matched settings

<!-- Written by: python benchmarks/contact_limits.py > reports/contact-limits.md -->

The worst of {_STARTS} starts of each interval (seed {_SEED}), against what is allowed. Errors are
distances of centres of mass from the exact motion: over all 4 s for `ballscroll`, up to the third
bounce for `balldrop`, up to the first impact for `simplecubli`. Rebound is the height of the first
bounce, told at the frame nearest its top. Passivity, penetration (over the scene's length) and
momentum are the figures of the checks of those names. MuJoCo and Exudyn have compliant contact:
they may sink deeper, and be farther off after a bounce.
"""


@dataclass(frozen=True)
class Limit:
    """What a figure may reach."""

    rigid: float
    compliant: float
    high_order: float | None = None
    """For methods of order 4 and more, where it differs."""

    def of(self, engine: str) -> float:
        """Give what an engine may reach."""
        if self.high_order is not None and engine in _HIGH_ORDER:
            return self.high_order
        return self.compliant if engine in _COMPLIANT else self.rigid


_LIMITS = {
    "penetration": Limit(0.02, 0.05),
    "passivity": Limit(1e-3, 1e-3),
    "error [m]": Limit(2e-3, 2e-3),
    "error before the first impact [m]": Limit(5e-4, 5e-4),
    "height of the first rebound, relative": Limit(0.02, 0.02),
    "error up to the third bounce [m]": Limit(0.02, 0.05),
    "error in flight [m]": Limit(5e-4, 5e-4),
    "error in flight [rad]": Limit(1e-3, 1e-3),
    "momentum before the first impact": Limit(1e-3, 1e-3, high_order=1e-6),
    "momentum in flight": Limit(1e-3, 1e-3),
}


def main() -> None:
    """Print the page."""
    engines = installed_engines()
    print(_HEAD)
    print(f"| scene | figure | {' | '.join(engines)} | allowed |")
    print(f"| --- | --- |{' ---: |' * len(engines)} --- |")
    for name, noise in _CASES:
        found = dict(zip(engines, _figures(name, noise), strict=True))
        for line in _lines(f"{name}, noise {'on' if noise else 'off'}", found):
            print(line, flush=True)


def _figures(name: str, noise: bool) -> Iterator[dict[str, float] | str]:
    """Simulate in each engine and measure, or say what went wrong."""
    scene = load_scene(name)
    batch = draw_batch(scene, range(3 * _STARTS), seed=_SEED, noise=noise)
    exact = reference.solve(scene, batch)
    adapters = [load_adapter(engine) for engine in installed_engines()]
    tasks = [
        Task(simulate, (scene, batch, a.name, settings_for(scene, a, "matched"))) for a in adapters
    ]
    for adapter, made in zip(adapters, run_tasks(tasks), strict=True):
        print(name, adapter.name, file=sys.stderr)
        if isinstance(made, Crash):
            yield made.reason
            continue
        motion = made.trajectory
        if any(motion.failures):
            yield next(failure.reason for failure in motion.failures if failure)
            continue
        method = adapter.methods[made.settings.method]
        checks = {
            finding.check: finding
            for finding in audit(scene, batch, motion, method, step=made.settings.step)
        }
        yield _checked(checks, exact) | _AGAINST_EXACT[name](exact, motion)


def _checked(checks: dict[str, Finding], exact: Trajectory) -> dict[str, float]:
    found: dict[str, float] = {}
    for check in ("penetration", "passivity"):
        if check in checks:
            found |= {check: float(np.nanmax(checks[check].figure))}
    if "momentum" in checks:
        series = checks["momentum"].series
        found["momentum in flight"] = float(np.nanmax(series))
        known = np.asarray(np.isfinite(exact.position).all(axis=(2, 3)))
        if known[:, 1:].any() and not known.all():
            found["momentum before the first impact"] = float(np.nanmax(series[known]))
    return found


def _scrolled(exact: Trajectory, motion: Trajectory) -> dict[str, float]:
    return {"error [m]": float(_distance(motion, exact).max())}


def _dropped(exact: Trajectory, motion: Trajectory) -> dict[str, float]:
    error, bounces = _distance(motion, exact), _bounces(exact)
    return {
        "error before the first impact [m]": float(error[bounces == 0].max()),
        "height of the first rebound, relative": float(_rebound(exact, motion, bounces).max()),
        "error up to the third bounce [m]": float(error[(bounces > 0) & (bounces < 3)].max()),
    }


def _bounces(exact: Trajectory) -> NDArray[np.int64]:
    """Count the bounces so far, (trajectory, frame): vertical speed jumps upwards."""
    climb = exact.velocity[:, :, 0, 2]
    return np.cumsum(np.diff(climb, axis=1, prepend=climb[:, :1]) > 0.0, axis=1)


def _rebound(exact: Trajectory, motion: Trajectory, bounces: NDArray[np.int64]) -> Array:
    """Compare heights above the lowest at the frame nearest the top, what is left to climb added.

    The lowest is that of a ball that lies on the ground: of all trajectories and frames.
    """
    lowest = exact.position[:, :, 0, 2].min()
    speed = np.where(bounces == 1, np.abs(exact.velocity[:, :, 0, 2]), np.inf)
    top = speed.argmin(axis=1)
    rows = np.arange(len(top))
    reached, wanted = (
        each.position[rows, top, 0, 2] - lowest + each.velocity[rows, top, 0, 2] ** 2 / (2 * _G)
        for each in (motion, exact)
    )
    share: Array = np.abs(reached / wanted - 1.0)[np.isfinite(speed.min(axis=1))]
    return share


def _flown(exact: Trajectory, motion: Trajectory) -> dict[str, float]:
    turn = rotation.multiply(motion.orientation, rotation.conjugate(exact.orientation))
    angle = 2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(turn[..., 1:], axis=-1)))
    return {
        "error in flight [m]": float(np.nanmax(_distance(motion, exact))),
        "error in flight [rad]": float(np.nanmax(angle)),
    }


def _driven(_exact: Trajectory, _motion: Trajectory) -> dict[str, float]:
    """The car starts in contact: there is nothing exact to compare with."""
    return {}


_AGAINST_EXACT = {
    "ballscroll": _scrolled,
    "balldrop": _dropped,
    "simplecubli": _flown,
    "particlecar": _driven,
}


def _distance(motion: Trajectory, exact: Trajectory) -> Array:
    """Largest over the bodies, (trajectory, frame); NaN where there is no exact motion."""
    worst: Array = np.linalg.norm(motion.position - exact.position, axis=-1).max(axis=2)
    return worst


def _lines(label: str, found: dict[str, dict[str, float] | str]) -> Iterator[str]:
    for what, limit in _LIMITS.items():
        if any(isinstance(figures, dict) and what in figures for figures in found.values()):
            cells = [_cell(figures, what, limit.of(name)) for name, figures in found.items()]
            allowed = dict.fromkeys(f"{limit.of(name):g}" for name in found)
            yield f"| {label} | {what} | {' | '.join(cells)} | {' / '.join(allowed)} |"


def _cell(figures: dict[str, float] | str, what: str, allowed: float) -> str:
    """A figure, in bold letters where it is more than is allowed."""
    if isinstance(figures, str):
        return f"**{figures}**"
    if what not in figures:
        return "–"
    text = f"{figures[what]:.1e}"
    return text if figures[what] <= allowed else f"**{text}**"


if __name__ == "__main__":
    main()

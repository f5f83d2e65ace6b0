"""Trajectories per second at equal error: python -m benchmarks.frontier [SCENE …].

The reference at several tolerances, and MuJoCo's RK4 at several steps, take turns on the same
medium starts. The error is the RMS distance of the markers, over all starts and frames, from the
reference at a tolerance of 1e-13. Rates at a given error are interpolated between measured ones.
Times are processor times of one thread, medians over the turns, and include all work.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.harness import print_made, print_table, take_turns
from mbds_xsim.checks.agreement import particle_error
from mbds_xsim.reference import solve
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.choice import settings_for

_STARTS, _TURNS = 24, 3
_TRUTH = 1e-13
_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
_COUNTS = (1, 2, 4, 8, 16, 32, 64)
_ERRORS = (1e-4, 1e-6, 1e-8)

Points = list[tuple[float, float]]
"""Pairs of error [m] and trajectories per second."""


def main(names: list[str]) -> None:
    print_table(
        "scene|what|>at 1e-4 m|>at 1e-6 m|>at 1e-8 m|measured: error [m] at trajectories a second",
        (row for name in names for row in _rows(registry.load_scene(name))),
    )
    print_made(f"MuJoCo {registry.load_adapter('mujoco').version()}")


def _rows(scene: Scene) -> Iterator[list[str]]:
    wide = draw_batch(scene, range(3 * _STARTS))
    medium = [row for row in range(len(wide)) if wide.interval(row) == "medium"]
    batch = wide[medium[:_STARTS]]
    truth = solve(scene, batch, rtol=_TRUTH, cache=False)
    adapter = registry.load_adapter("mujoco")
    options = settings_for(scene, adapter, "matched").options
    engine = {count: Settings("RK4", scene.clock.frame / count, options) for count in _COUNTS}

    def reference(rtol: float) -> Trajectory:
        return solve(scene, batch, rtol=rtol, cache=False)

    def rolled(count: int) -> Trajectory:
        with adapter.open(scene, engine[count]) as run:
            return run.rollout(batch)

    work: dict[str, list[Callable[[], Trajectory]]] = {
        "reference": [partial(reference, rtol) for rtol in _TOLERANCES],
        "mujoco RK4": [partial(rolled, count) for count in _COUNTS],
    }
    makes = [make for own in work.values() for make in own]
    errors = [_error(scene, make(), truth) for make in makes]
    rates = len(batch) / np.median(take_turns(makes, (_TURNS, _TURNS)), axis=0)
    measured = zip(errors, rates.tolist(), strict=True)
    for method, own in work.items():
        points = list(itertools.islice(measured, len(own)))
        text = ", ".join(f"{error:.1e} at {rate:.3g}" for error, rate in points)
        yield [scene.name, method, *(_rate_at(points, error) for error in _ERRORS), text]


def _error(scene: Scene, motion: Trajectory, truth: Trajectory) -> float:
    errors = particle_error(Mechanism.of(scene), motion, truth)
    return float(np.sqrt(np.mean(errors**2)))


def _rate_at(points: Points, error: float) -> str:
    """Interpolate the rate in log-log scale; past the largest error, return a lower bound."""
    points = sorted(point for point in points if np.isfinite(point[0]))
    if not points or error < points[0][0]:
        return "–"
    if error > points[-1][0]:
        return f"≥ {max(rate for _, rate in points):.3g}"
    errors, rates = np.log(np.array(points)).T
    return f"{np.exp(np.interp(np.log(error), errors, rates)):.3g}"


if __name__ == "__main__":
    main(sys.argv[1:] or ["6pendulum", "3ladder"])

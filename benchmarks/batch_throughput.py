"""Throughput over batch size: python -m benchmarks.batch_throughput [SCENE …].

MuJoCo Warp on its CPU backend and MuJoCo run on one thread, both with RK4 at the same step, with
models loaded and kernels compiled beforehand. A rate is the simulated time of all trajectories over
the processor time of the rollout, including the output of body states: the best of three rounds in
turns. The error is the RMS distance of the bodies from the reference after one second, in a batch
of 16, relative to the scene's length.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial

import numpy as np

from benchmarks.harness import print_made, print_table, take_turns
from mbds_xsim.reference import solve
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Run, Settings

_STEPS_PER_FRAME, _SECOND, _TURNS = 4, 50, 3
_SIZES = (1, 4, 16, 64, 256, 1024, 4096)
_MOST_FRAMES = 5_000  # over all trajectories of a rollout; at least two each
_OPTIONS: dict[str, dict[str, float]] = {"mujoco": {"turn": 0.0}, "mujoco-warp": {}}


def main(names: list[str]) -> None:
    print_table(
        f"scene|engine|>error at 1 s|{'|'.join(f'>{size}' for size in _SIZES)}",
        (row for name in names for row in _rows(registry.load_scene(name))),
    )
    versions = (f"{name} {registry.load_adapter(name).version()}" for name in _OPTIONS)
    print_made(*versions)


def _rows(scene: Scene) -> Iterator[list[str]]:
    """Yield table rows of the rates [simulated seconds per processor second]."""
    runs = {name: _loaded(scene, name) for name in _OPTIONS}
    rates = []
    for size in _SIZES:
        frames = min(_SECOND, max(2, _MOST_FRAMES // size))
        batch = draw_batch(scene, range(size)).truncated(frames)
        works = [partial(run.rollout, batch) for run in runs.values()]
        seconds = take_turns(works, (_TURNS, _TURNS)).min(axis=0)
        rates.append(size * frames * scene.clock.frame / seconds)
    for (name, run), row in zip(runs.items(), np.transpose(rates), strict=True):
        yield [scene.name, name, f"{_error(scene, run):.1e}", *(f"{rate:.3g}" for rate in row)]


def _loaded(scene: Scene, name: str) -> Run:
    step = scene.clock.frame / _STEPS_PER_FRAME
    return registry.load_adapter(name).open(scene, Settings("RK4", step, _OPTIONS[name]))


def _error(scene: Scene, run: Run) -> float:
    batch = draw_batch(scene, range(16)).truncated(_SECOND)
    apart = run.rollout(batch).position[:, -1] - solve(scene, batch).position[:, -1]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))) / scene.length)


if __name__ == "__main__":
    main(sys.argv[1:] or ["6pendulum", "3ladder"])

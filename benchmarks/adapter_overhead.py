"""Cost of the adapters in addition to that of their engines.

python -m benchmarks.adapter_overhead [SCENE…] > reports/adapter-overhead.md

A stopwatch runs while an adapter's rollout is inside the engine's own functions: steps, loads and
state queries. The rest is the adapter's work: passing inputs, storing and converting states.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from statistics import median, quantiles
from timeit import timeit
from typing import Any
from unittest.mock import patch

import dartpy
import exudyn
import mujoco
import numpy as np
import pybullet

from benchmarks.harness import print_head, print_made, print_table, processor_s
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_adapter, load_scene

SCENES = ("3ladder", "simplecubli")
RUNS = (("mujoco", 10), ("mujoco", 1), ("pybullet", 1), ("dart", 1), ("exudyn", 1))
"""Engine and starts per rollout; MuJoCo takes only milliseconds for one, so it also runs ten."""
ROUNDS, PATIENCE = (3, 9), 1.0  # (least, most) rounds, and the time to fill with them [s]
ENGINE: dict[str, tuple[tuple[Any, str], ...]] = {
    "mujoco": ((mujoco, "mj_step mj_forward mj_kinematics mj_comPos mj_comVel mj_resetData"),),
    "pybullet": (
        (pybullet, "stepSimulation getLinkStates getBasePositionAndOrientation getBaseVelocity"),
        (pybullet, "applyExternalForce applyExternalTorque setJointMotorControl2"),
    ),
    "dart": (
        (dartpy.simulation.World, "step"),
        (dartpy.dynamics.BodyNode, "setExtForce addExtForce addExtTorque"),
        (dartpy.dynamics.Skeleton, "getPositions getVelocities clearExternalForces"),
    ),
    "exudyn": ((exudyn.MainSystem, "SolveDynamic SetLoadParameter GetMarkerOutput"),),
}


class Stopwatch:
    """Stopwatch of the processor time inside the functions that it wraps [s]."""

    def __init__(self) -> None:
        self.inside, self.calls = 0.0, 0

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        clock = time.thread_time

        def call(*args: Any, **options: Any) -> Any:
            begin = clock()
            try:
                return function(*args, **options)
            finally:
                self.inside += clock() - begin
                self.calls += 1

        return call

    @staticmethod
    def own_cost() -> tuple[float, float]:
        """Return the cost of one timed call, and the part of it that counts as inside [s]."""
        costs = []
        for _ in range(20):
            watch = Stopwatch()
            spent = timeit(watch.timed(lambda: None), timer=time.process_time, number=2000)
            costs.append((spent / watch.calls, watch.inside / watch.calls))
        return min(costs)


@contextmanager
def watched(engine: str) -> Iterator[Stopwatch]:
    """Time an engine's functions; load models inside, because adapters keep some functions."""
    watch = Stopwatch()
    with ExitStack() as patches:
        for owner, names in ENGINE[engine]:
            for name in names.split():
                wrapped = watch.timed(getattr(owner, name))
                patches.enter_context(patch.object(owner, name, wrapped))
        yield watch


def row(name: str, engine: str, starts: int) -> list[str]:
    """Time rollouts, and return a table row with the adapter's overhead."""
    scene, adapter = load_scene(name), load_adapter(engine)
    settings = settings_for(scene, adapter, "matched")
    batch = draw_batch(scene, range(starts))
    load = median(processor_s(lambda: adapter.open(scene, settings).close()) for _ in range(5))
    with watched(engine) as watch, adapter.open(scene, settings) as run:
        still = median(processor_s(lambda: run.rollout(batch.truncated(0))) for _ in range(9))
        rounds = int(np.clip(PATIENCE / processor_s(lambda: run.rollout(batch)), *ROUNDS))
        whole_each, inside_each = watch.own_cost()
        wholes, shares = [], []
        for _ in range(rounds):
            watch.inside, watch.calls = 0.0, 0
            whole = processor_s(lambda: run.rollout(batch))
            whole -= watch.calls * whole_each
            wholes.append(whole)
            shares.append(whole / (watch.inside - watch.calls * inside_each) - 1.0)
    low, middle, high = quantiles(shares, n=4)
    return [
        name,
        engine,
        str(starts),
        f"{1e3 * median(wholes):.1f} ms",
        f"{middle:+.1%}",
        f"{low:+.1%} to {high:+.1%}",
        f"{load / median(wholes):.1%}",
        f"{still / median(wholes):.1%}",
    ]


_COMMAND = "python -m benchmarks.adapter_overhead > reports/adapter-overhead.md"
_TEXT = f"""\
The adapter's rollout over 4 s at matched settings, beside the time that it spends in the engine's
own functions: steps, loads and what is read of the state. Overhead: the rest (inputs handed over,
states kept and turned into those of bodies) over that time, the median of {ROUNDS[0]} rollouts or
more; of 50 %: the range of the middle half of the rollouts. Load: building the model, once for all
starts; start: what a rollout costs before its first step and after its last, with the state reset
and nothing built. Both as a part of the rollout's time. Times are the processor's, in one process
on one thread.
"""


def main(names: list[str]) -> None:
    print_head("What the adapters cost beside their engines", _COMMAND, _TEXT)
    lines = (row(name, *run) for name in names or SCENES for run in RUNS)
    print_table("scene|engine|>starts|>rollout|>overhead|>of 50 %|>load|>start", lines)
    engines = [f"{name} {load_adapter(name).version()}" for name in ENGINE]
    print_made(f"numpy {np.__version__}", *engines)


if __name__ == "__main__":
    main(sys.argv[1:])

"""What contact costs: wall time for a simulated second of `balldrop`."""

from __future__ import annotations

import numpy as np

from mbds_xsim.engine import Profile
from mbds_xsim.registry import load_scene
from mbds_xsim.sampling import draw_batch
from mbds_xsim.simulate import simulate
from mbds_xsim.study.contact_bench import Bench, Measured, reason

__all__ = ["cost"]

_SCENE = "balldrop"
_REPEATS = 3


def cost(engine: str, profile: Profile) -> list[Measured]:
    """Time one trajectory, set-up apart, by one core that may have other work."""
    bench, scene = Bench(engine, profile, _SCENE), load_scene(_SCENE)
    batch = draw_batch(scene, [1], noise=False)
    runs = [simulate(scene, batch, engine, bench.settings) for _ in range(_REPEATS)]
    spent = np.array([run.rollout_s for run in runs]) / scene.clock.duration
    note = reason(runs[0].trajectory)
    return [bench.measured("cost of a simulated second", "s", spent, {}, note)]

"""MuJoCo's own ways: what it is given, how loops close, and exact answers on small scenes."""

import numpy as np
import pytest

from mbds_xsim.engine import Settings
from mbds_xsim.errors import InputError
from mbds_xsim.registry import load_adapter, load_scene
from mbds_xsim.sampling import draw_batch
from mbds_xsim.scene import Scene
from mbds_xsim.state import Trajectory

pytest.importorskip("mujoco")

ENGINE = load_adapter("mujoco")


def simulate(scene: Scene, method: str = "RK4", substeps: int = 10, **options: float) -> Trajectory:
    batch = draw_batch(scene, [0], noise=False)
    with ENGINE.open(scene, Settings(method, scene.clock.frame / substeps, options)) as run:
        return run.rollout(batch)


@pytest.mark.parametrize("name", ["5pendulum", "2ladder"])
def test_the_start_is_kept(name: str) -> None:
    scene = load_scene(name)
    batch = draw_batch(scene, [0, 1, 2]).truncated(1)
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)
        readback = run.readback(batch)
    for key in ("position", "orientation", "velocity", "angular_velocity"):
        start = getattr(batch, key)
        np.testing.assert_allclose(getattr(motion, key)[:, 0], start, rtol=0, atol=1e-13)
    np.testing.assert_allclose(readback.com, batch.position[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(readback.velocity, batch.velocity[0], rtol=0, atol=1e-13)


def test_the_same_batch_gives_the_same_bits() -> None:
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [0, 1]).truncated(3)
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        first, second = run.rollout(batch), run.rollout(batch)
        alone = run.rollout(batch[[1]])
    assert np.array_equal(first.position, second.position)
    assert np.array_equal(first.velocity[[1]], alone.velocity)


def test_wrong_options_are_refused() -> None:
    scene = load_scene("5pendulum")
    for options in ({"solver": "Jacobi"}, {"loop_time_constant": -1.0}, {"stiffness": 1.0}):
        with pytest.raises(InputError):
            ENGINE.open(scene, Settings("RK4", 0.01, options))
    with pytest.raises(InputError):
        ENGINE.open(scene, Settings("RK4", 0.003))
    with pytest.raises(InputError):
        ENGINE.open(scene, Settings("RK45", 0.01))

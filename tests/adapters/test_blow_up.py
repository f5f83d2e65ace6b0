"""A trajectory that blows up ends with the reason, alone or beside another, which goes on."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import installed_engines, load_adapter, load_scene
from mbds_xsim.testing import CASES


@pytest.mark.parametrize("stretched", [0, 1])
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("drake", "runge_kutta5"),
        ("mujoco-warp", "RK4"),
        ("pinocchio", "forward-dynamics-RK4"),
    ],
)
def test_what_blows_up_ends_and_what_is_stepped_beside_it_goes_on(
    name: str, method: str, stretched: int
) -> None:
    """One of two masses is let go where its stiff spring is slack, the other 0.1 m further out."""
    if name not in installed_engines():
        pytest.skip(f"{name} is not installed")
    adapter, slack = load_adapter(name), 1 - stretched
    (soft,) = (case.scene for case in CASES if case.name == "spring")
    spring = msgspec.structs.replace(soft.springs[0], stiffness=1e8, damping=0.0)
    scene = msgspec.structs.replace(soft, springs=(spring,))
    batch = draw_batch(scene, [0, 1])
    batch.position[slack] = (1.0, 0.0, 0.0)

    with adapter.open(scene, Settings(method, scene.clock.frame)) as run:
        motion, alone = run.rollout(batch), run.rollout(batch[[stretched]])

    rounding = 1e-7 if adapter.methods[method].single else 0.0
    assert np.abs(motion.position[slack] - [1.0, 0.0, 0.0]).max() <= rounding
    end = motion.failures[stretched]
    assert motion.failures[slack] is None
    assert end is not None
    assert end.reason
    assert alone.failures == (end,)
    assert np.isnan(motion.position[stretched, end.frame :]).all()
    assert np.isfinite(motion.position[stretched, : end.frame]).all()


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("drake", "runge_kutta5"),
        ("drake", "semi-implicit-euler"),
        ("mujoco-warp", "RK4"),
        ("pinocchio", "forward-dynamics-RK4"),
    ],
)
def test_balls_that_turn_too_fast_end_the_trajectory_and_not_the_process(
    name: str, method: str
) -> None:
    if name not in installed_engines():
        pytest.skip(f"{name} is not installed")
    scene = load_scene("6pendulum")
    batch = draw_batch(scene, [2])
    batch.velocity[:] *= 10.0
    batch.angular_velocity[:] *= 10.0

    with load_adapter(name).open(scene, Settings(method, scene.clock.frame)) as run:
        motion = run.rollout(batch)

    (end,) = motion.failures
    assert end is not None
    assert "speed passes" in end.reason or "not finite" in end.reason
    assert np.isnan(motion.position[0, end.frame :]).all()

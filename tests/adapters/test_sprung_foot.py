"""A foot that a spring stamps on the ground: predicted touchdowns must include the spring."""

from __future__ import annotations

import msgspec
import pytest

from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import GRAVITY, Ground, Joint
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing.contact_cases import ball

_DRAWN = 0.35  # [m]


@pytest.mark.parametrize("stiffness", [500.0, 5000.0])
@pytest.mark.parametrize("name", ["mujoco", "pybullet", "dart", "exudyn"])
def test_an_impact_takes_what_restitution_leaves_out(name: str, stiffness: float) -> None:
    """The spring pulls up to 180 times as hard as gravity; two engines once blew up there."""
    adapter = load_adapter(name)
    leg = Joint("leg", "slider", "world", "ball", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    leg = msgspec.structs.replace(leg, stiffness=stiffness, rest=-_DRAWN)
    scene = msgspec.structs.replace(ball(0.05, ground=Ground(0.2, 0.5), steps=20), joints=(leg,))

    with adapter.open(scene, adapter.settings(scene, "matched")) as run:
        motion = run.rollout(draw_batch(scene, [0]))

    climbed = motion.position[0, :, 0, 2] - motion.position[0, 0, 0, 2]
    energy = 0.5 * motion.velocity[0, :, 0, 2] ** 2 - GRAVITY[2] * climbed
    energy += 0.5 * stiffness * (climbed + _DRAWN) ** 2
    assert motion.failures == (None,)
    assert energy.max() <= (1.0 + scene.budget.energy_first_order) * energy[0]
    # In the end the foot rests on the ground, its spring still drawn.
    assert 0.7 <= energy[-1] / energy[0] <= 0.75

"""Part of the contract suite about colliding bodies; it skips engines without collisions."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim.checks.audit import audit
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import GRAVITY, Ground, Scene
from mbds_xsim.scene.state import Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.testing.collision_cases import (
    RADIUS,
    TWO,
    Flying,
    balls,
    collided,
    cradle,
    gate,
    swings,
)
from mbds_xsim.testing.contact_contract import matched_or_skip

_REBOUNDS = (0.0, 0.5, 1.0)


class CollisionContract:
    """Tests of collisions, one for each way in which they go wrong."""

    @pytest.mark.parametrize("restitution", _REBOUNDS)
    @pytest.mark.parametrize("name", TWO)
    def test_balls_part_as_newton_and_coulomb_say(
        self, adapter: Adapter, name: str, restitution: float
    ) -> None:
        """Errors stay within the budgets of restitution and friction, times the approach speed."""
        scene = balls(TWO[name], restitution=restitution)
        motion = _simulate(adapter, scene)
        exact, touch = collided(scene, TWO[name])
        mass = np.array([ball.mass for ball in TWO[name]])
        meet = float(np.linalg.norm(exact.velocity[0, 0, 0] - exact.velocity[0, 0, 1]))
        within = (scene.budget.restitution + scene.budget.friction) * meet + 1e-9
        off = motion.velocity[:, -1] - exact.velocity[:, -1]
        turn = motion.angular_velocity[:, -1] - exact.angular_velocity[:, -1]
        assert np.abs(off).max() <= within
        assert np.abs(turn).max() * RADIUS <= 2.5 * within
        before = exact.time < touch
        assert np.abs(motion.position - exact.position)[:, before].max() < 1e-9
        together = np.einsum("b,fbi->fi", mass, motion.velocity[0])
        assert np.abs(together - together[0]).max() < 1e-3 * meet

    @pytest.mark.parametrize("restitution", _REBOUNDS)
    def test_joined_bodies_collide_as_free_ones_do(
        self, adapter: Adapter, restitution: float
    ) -> None:
        """One of two pendulums falls on the other: they swing up to (1 ∓ e)² / 4 of its height."""
        scene = cradle(restitution)
        height = swings(scene, _simulate(adapter, scene))
        wanted = np.array([(1.0 - restitution) ** 2, (1.0 + restitution) ** 2]) / 4.0
        assert height[0, 1] == pytest.approx(0.0, abs=1e-9)
        assert height[-1] / height[0, 0] == pytest.approx(wanted, abs=0.02)

    @pytest.mark.parametrize("restitution", _REBOUNDS)
    def test_a_body_collides_with_the_one_that_carries_it(
        self, adapter: Adapter, restitution: float
    ) -> None:
        """An arm swings back from its post at e times its speed."""
        motion = _simulate(adapter, gate(restitution))
        rates = motion.angular_velocity[0, [0, -1], 1, 2]
        assert rates == pytest.approx([3.0, -3.0 * restitution], abs=0.06)

    def test_what_is_no_pair_goes_through(self, adapter: Adapter) -> None:
        """The first ball passes through a third one in its way, which it may not touch."""
        left, right = TWO["head on"]
        three = balls([left, right, Flying((0.2, 0.0, 1.0))])
        assert three.collisions is not None
        alone = msgspec.structs.replace(three.collisions, pairs=three.collisions.pairs[:1])
        motion = _simulate(adapter, msgspec.structs.replace(three, collisions=alone))
        assert np.abs(motion.velocity[0, :, 2]).max() == 0.0
        assert motion.velocity[0, -1, 0, 0] < 0.0  # the other two have met beyond it

    def test_collisions_read_back_as_the_scenes(self, adapter: Adapter) -> None:
        """Coefficients of pairs, which engines mix from two, are right, also with a ground."""
        for ground in (None, Ground(0.2, 0.5)):
            scene = balls(TWO["slides"], ground=ground)
            settings, batch = matched_or_skip(adapter, scene), draw_batch(scene, [0])
            with adapter.open(scene, settings) as run:
                native = run.readback(batch)
                assert native.collision is not None
                assert readback.compare(Mechanism.of(scene), batch, settings, native) == []
                assert run.size.contact_pairs == 1 + 2 * (ground is not None)

    def test_the_checks_pass_through_collisions_and_bounces(self, adapter: Adapter) -> None:
        """Three balls that fall, collide and bounce pass every check."""
        three = (
            Flying((0.0, 0.0, 0.3), (1.2, 0.05, 0.0), (0.0, 0.0, 9.0)),
            Flying((0.35, 0.02, 0.32), (-0.4, 0.0, 0.0), mass=2.0),
            Flying((-0.4, 0.0, 0.4), (0.9, 0.0, -0.2), (0.0, 6.0, 0.0), mass=0.5),
        )
        scene = balls(three, ground=Ground(0.2, 0.6), gravity=GRAVITY, steps=60)
        motion = _simulate(adapter, scene)
        settings = adapter.settings(scene, "matched")
        method = adapter.methods[settings.method]
        batch, time = draw_batch(scene, [0]), adapter.contact_scales(settings).time
        findings = audit(scene, batch, motion, method, step=settings.step, contact_time=time)
        assert {"collision restitution", "collision friction"} <= {one.check for one in findings}
        for one in findings:
            over = one.budget is not None and one.figure > one.budget + one.uncertainty
            assert not np.any(over), f"{one.check}: {one.figure}, {one.where}"


def _simulate(adapter: Adapter, scene: Scene) -> Trajectory:
    with adapter.open(scene, matched_or_skip(adapter, scene)) as run:
        motion = run.rollout(draw_batch(scene, [0]))
    assert motion.failures == (None,)
    return motion

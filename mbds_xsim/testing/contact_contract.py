"""Parts of the contract suite about contact; they skip engines without a ground or collisions.

Contact is a claim of the matched settings, so these are tested. On the ground their careful steps
are made coarser; the allowed error grows with them.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.audit import audit
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import (
    GRAVITY,
    PARTICLE_RADIUS,
    Body,
    ContactSphere,
    Force,
    Ground,
    Particle,
    Scene,
)
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Profile, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.claims import ContactScales
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.collision_cases import TWO, Flying, balls, collided, cradle, gate, swings
from mbds_xsim.testing.contact_cases import CONTACT_CASES, RESTITUTIONS, ball, gaps, rebound_heights
from mbds_xsim.testing.ladder import whole_motion

_G = -GRAVITY[2]
_COARSER = 4
_REBOUNDS = (0.0, 0.5, 1.0)
_SCENES = ("ballscroll", "balldrop", "particlecar", "simplecubli")


class ContactContract:
    """Tests of contact, one for each way in which it goes wrong."""

    @pytest.mark.parametrize("name", CONTACT_CASES)
    def test_on_the_ground_bodies_follow_the_answer(self, adapter: Adapter, name: str) -> None:
        """Errors stay within the displacement that the declared contact time and slip allow."""
        case = CONTACT_CASES[name]()
        settings = _settings(adapter, case.scene)
        scales, motion = _simulate(adapter, case.scene, case.batch, settings)
        error = np.abs(motion.position - case.exact.position)
        worst = np.nanmax(error, axis=(0, 2, 3))
        excess = worst - case.allowed(scales)
        assert excess.max() <= 0.0, (
            f"{adapter.name} {settings.method} on {name}: {worst[excess.argmax()]:.2e} m off "
            f"at frame {excess.argmax()}, {case.allowed(scales)[excess.argmax()]:.2e} allowed"
        )

    def test_friction_stops_where_a_ball_rolls(self, adapter: Adapter) -> None:
        """Momentum about the contact point fixes the final motion, however friction got there."""
        case = CONTACT_CASES["slide to roll"]()
        scales, motion = _simulate(adapter, case.scene, case.batch)
        sink = _G * scales.time**2
        # A ball that sinks rolls on a smaller radius.
        allowed = 1e-6 + sink / PARTICLE_RADIUS * np.abs(case.exact.velocity).max()
        end = motion.velocity[:, -1] - case.exact.velocity[:, -1]
        turn = motion.angular_velocity[:, -1] - case.exact.angular_velocity[:, -1]
        assert np.abs(end).max() <= allowed
        assert np.abs(turn).max() <= 2.5 * allowed / PARTICLE_RADIUS
        assert np.abs(gaps(case.scene, motion)).max() <= 1e-9 + sink  # neither hops nor sinks

    @pytest.mark.parametrize("restitution", RESTITUTIONS)
    def test_a_ball_bounces_as_high_as_its_restitution_says(
        self, adapter: Adapter, restitution: float
    ) -> None:
        """Height and speed in flight give the rebound; an impact may be one contact time late."""
        scene = ball(0.5, ground=Ground(0.43, restitution), steps=75)
        scales, motion = _simulate(adapter, scene)
        height = motion.position[0, :, 0, 2] - PARTICLE_RADIUS
        top = height + motion.velocity[0, :, 0, 2] ** 2 / (2 * _G)
        number, wanted = rebound_heights(scene, motion.time)
        late = scales.time * (1 + number) ** 2
        around = [rebound_heights(scene, motion.time + shift)[0] for shift in (-late, late)]
        sure = (around[0] == number) & (around[1] == number)
        off = np.sqrt(2 * _G * wanted[0]) * scales.time
        assert {0.0, 1.0} <= set(number[sure].tolist())
        assert np.all(np.abs(top - wanted)[sure] <= (1 + number[sure]) * off + 1e-5)
        assert height.min() >= -off
        if restitution == 0.0:
            assert np.abs(motion.velocity[0, -1]).max() <= _G * scales.time

    @pytest.mark.parametrize("restitution", RESTITUTIONS)
    def test_restitution_does_not_depend_on_the_speed(
        self, adapter: Adapter, restitution: float
    ) -> None:
        """Speeds go from a walk to a fall from a house; gravity also acts during the impact."""
        ground = Ground(0.43, restitution)
        for speed in (0.3, 1.0, 3.0, 8.0):
            drop = 0.0137 * speed  # touches down in the middle of a step
            scene = ball(drop, (0.0, 0.0, -speed), ground=ground, steps=1)
            settings = _settings(adapter, scene, coarser=1)
            scales, motion = _simulate(adapter, scene, settings=settings)
            impact = np.sqrt(speed**2 + 2 * _G * drop)
            measured = _rebound(motion, _G) / impact
            within = scene.budget.restitution + _G * scales.time / speed
            assert measured == pytest.approx(restitution, abs=within), f"at {speed} m/s"

    def test_a_ball_that_is_pushed_down_comes_back_as_its_restitution_says(
        self, adapter: Adapter
    ) -> None:
        """A held force of a hundred weights brings the ball down within a frame, from rest."""
        height, push = 0.15, 1000.0
        scene = ball(height, ground=Ground(0.43, 0.6), steps=1)
        scene = msgspec.structs.replace(scene, forces=(Force("ball", ((0.0, 0.0, -push),), 1),))
        scales, motion = _simulate(adapter, scene, settings=_settings(adapter, scene, coarser=1))
        pull = push / Mechanism.of(scene).mass[0] + _G
        impact = np.sqrt(2 * pull * height)
        within = scene.budget.restitution + pull * scales.time / impact
        assert _rebound(motion, pull) / impact == pytest.approx(0.6, abs=within)

    def test_without_friction_nothing_turns(self, adapter: Adapter) -> None:
        """A smooth ground takes no speed and no spin."""
        scene = ball(0.3, (3.0, 1.0, 0.0), (0.0, 0.0, 4.0), ground=Ground(0.0, 0.5))
        _, motion = _simulate(adapter, scene)
        along, spin = motion.velocity[0, :, 0, :2], motion.angular_velocity[0, :, 0]
        np.testing.assert_allclose(along, [[3.0, 1.0]] * 51, atol=1e-12)
        np.testing.assert_allclose(spin, [[0.0, 0.0, 4.0]] * 51, atol=1e-12)

    @pytest.mark.parametrize("name", _SCENES)
    @pytest.mark.parametrize("profile", ["native", "matched"])
    def test_the_native_contact_reads_back_as_the_scenes(
        self, adapter: Adapter, name: str, profile: Profile
    ) -> None:
        """Radii and the coefficients of pairs, which engines mix from two, are the scene's."""
        scene = load_scene(name)
        _settings(adapter, scene)
        batch, settings = draw_batch(scene, [0, 2]), settings_for(scene, adapter, profile)
        with adapter.open(scene, settings) as run:
            for start in (batch[[0]], batch[[1]]):
                native = run.readback(start)
                assert native.contact is not None
                assert native.sphere is not None
                assert readback.compare(Mechanism.of(scene), start, settings, native) == []
            assert run.size.contact_pairs == len(scene.contacts)

    @pytest.mark.parametrize("name", [*_SCENES, "slow ball"])
    def test_contacts_of_one_trajectory_are_forgotten_in_the_next(
        self, adapter: Adapter, name: str
    ) -> None:
        """The same start gives the same bits: as the first of three, as the last, and alone.

        A ball put back by a tenth of a radius may still have its old contact points in reach.
        """
        slow = ball(velocity=(0.01, 0.0, 0.0), spin=(0.0, 0.01 / PARTICLE_RADIUS, 0.0), steps=20)
        scene = slow if name == "slow ball" else load_scene(name)
        batch = draw_batch(scene, [2, 0, 2]).truncated(60)
        settings = _settings(adapter, scene)
        with adapter.open(scene, settings) as run:
            several, alone = run.rollout(batch), run.rollout(batch[:1])
        assert several.failures == (None,) * 3
        assert gaps(scene, several).min(axis=(1, 2)).max() < 0.03  # all of them have touched
        for key in STATES:
            first, _, last = getattr(several, key)
            np.testing.assert_array_equal(first, last)
            np.testing.assert_array_equal(first, getattr(alone, key)[0])

    def test_spheres_touch_the_ground_and_nothing_else(self, adapter: Adapter) -> None:
        """A ball rolls through another one."""
        single = ball(velocity=(2.0, 0.0, 0.0))
        centre = (0.5, 0.0, PARTICLE_RADIUS)
        scene = msgspec.structs.replace(
            single,
            bodies=(*single.bodies, Body("still", (Particle(centre),))),
            contacts=(*single.contacts, ContactSphere("still", centre, PARTICLE_RADIUS)),
        )
        settings = _settings(adapter, scene)
        scales, both = _simulate(adapter, scene, settings=settings)
        _, alone = _simulate(adapter, single, settings=settings)
        # Engines that choose their steps by contacts may round differently.
        np.testing.assert_allclose(both.position[:, :, 0], alone.position[:, :, 0], atol=1e-12)
        sink = 1e-9 + _G * scales.time**2
        np.testing.assert_allclose(both.position[0, :, 1], [centre] * 51, rtol=0, atol=sink)

    def test_a_thrown_cubli_flies_as_the_reference_until_it_lands(self, adapter: Adapter) -> None:
        """Flywheels that torques spin up turn the frame back; the total angular momentum stays."""
        scene = load_scene("simplecubli")
        batch = draw_batch(scene, range(3), noise=False).truncated(30)
        exact = reference.solve(scene, batch, cache=False)
        settings = _settings(adapter, scene, coarser=1)
        _, motion = _simulate(adapter, scene, batch, settings)
        first_order = adapter.methods[settings.method].order == 1
        assert np.nanmax(np.abs(motion.position - exact.position)) < (5e-4 if first_order else 5e-7)
        back = rotation.conjugate(exact.orientation)
        turn = rotation.to_vector(rotation.multiply(back, motion.orientation))
        assert np.nanmax(np.linalg.norm(turn, axis=-1)) < (1e-3 if first_order else 5e-6)
        for row, landing in enumerate(exact.failures):
            assert landing is not None
            spins = _spins(scene, motion, row)[: landing.frame]
            total = spins.sum(axis=1)
            assert np.linalg.norm(spins - spins[0], axis=-1).max() > 0.2
            change = np.linalg.norm(total - total[0], axis=-1).max()
            assert change < 1e-3 * np.linalg.norm(spins, axis=-1).max()


class CollisionContract:
    """Tests of collisions between bodies, one for each way in which they go wrong."""

    @pytest.mark.parametrize("restitution", _REBOUNDS)
    @pytest.mark.parametrize("name", TWO)
    def test_balls_part_as_newton_and_coulomb_say(
        self, adapter: Adapter, name: str, restitution: float
    ) -> None:
        """Errors stay within the budgets of restitution and friction, times the approach speed."""
        scene = balls(TWO[name], restitution=restitution)
        motion = _motion_of(adapter, scene)
        exact, touch = collided(scene, TWO[name])
        mass = np.array([ball.mass for ball in TWO[name]])
        meet = float(np.linalg.norm(exact.velocity[0, 0, 0] - exact.velocity[0, 0, 1]))
        within = (scene.budget.restitution + scene.budget.friction) * meet + 1e-9
        off = motion.velocity[:, -1] - exact.velocity[:, -1]
        turn = motion.angular_velocity[:, -1] - exact.angular_velocity[:, -1]
        assert np.abs(off).max() <= within
        assert np.abs(turn).max() * scene.contacts[0].radius <= 2.5 * within
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
        height = swings(scene, _motion_of(adapter, scene))
        wanted = np.array([(1.0 - restitution) ** 2, (1.0 + restitution) ** 2]) / 4.0
        assert height[0, 1] == pytest.approx(0.0, abs=1e-9)
        assert height[-1] / height[0, 0] == pytest.approx(wanted, abs=0.02)

    @pytest.mark.parametrize("restitution", _REBOUNDS)
    def test_a_body_collides_with_the_one_that_carries_it(
        self, adapter: Adapter, restitution: float
    ) -> None:
        """An arm swings back from its post at e times its speed."""
        motion = _motion_of(adapter, gate(restitution))
        rates = motion.angular_velocity[0, [0, -1], 1, 2]
        assert rates == pytest.approx([3.0, -3.0 * restitution], abs=0.06)

    def test_what_is_no_pair_goes_through(self, adapter: Adapter) -> None:
        """The first ball passes through a third one in its way, which it may not touch."""
        left, right = TWO["head on"]
        three = balls([left, right, Flying((0.2, 0.0, 1.0))])
        assert three.collisions is not None
        alone = msgspec.structs.replace(three.collisions, pairs=three.collisions.pairs[:1])
        motion = _motion_of(adapter, msgspec.structs.replace(three, collisions=alone))
        assert np.abs(motion.velocity[0, :, 2]).max() == 0.0
        assert motion.velocity[0, -1, 0, 0] < 0.0  # the other two have met beyond it

    def test_collisions_read_back_as_the_scenes(self, adapter: Adapter) -> None:
        """Coefficients of pairs, which engines mix from two, are right, also with a ground."""
        for ground in (None, Ground(0.2, 0.5)):
            scene = balls(TWO["slides"], ground=ground)
            settings, batch = _matched_or_skip(adapter, scene), draw_batch(scene, [0])
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
        motion = _motion_of(adapter, scene)
        settings = adapter.settings(scene, "matched")
        method = adapter.methods[settings.method]
        batch, time = draw_batch(scene, [0]), adapter.contact_scales(settings).time
        findings = audit(scene, batch, motion, method, step=settings.step, contact_time=time)
        assert {"collision restitution", "collision friction"} <= {one.check for one in findings}
        for one in findings:
            over = one.budget is not None and one.figure > one.budget + one.uncertainty
            assert not np.any(over), f"{one.check}: {one.figure}, {one.where}"


def _settings(adapter: Adapter, scene: Scene, *, coarser: int = _COARSER) -> Settings:
    """Return the matched settings; skip the test if the engine cannot simulate the scene."""
    careful = _matched_or_skip(adapter, scene)
    if value := adapter.cannot_hold(scene):
        pytest.skip(f"{adapter.name} cannot hold {value}")
    stored = settings_for(scene, adapter, "matched")
    if stored != careful:
        return stored  # no finer than necessary
    if adapter.methods[careful.method].adaptive:
        return careful
    return Settings(careful.method, careful.step * coarser, careful.options)


def _matched_or_skip(adapter: Adapter, scene: Scene) -> Settings:
    """Return the preset of matched settings; skip the test if its method refuses the scene."""
    settings = adapter.settings(scene, "matched")
    if adapter.refusals(scene, settings.method):
        pytest.skip(f"{adapter.name} {settings.method} cannot do {scene.name}")
    return settings


def _simulate(
    adapter: Adapter, scene: Scene, batch: Batch | None = None, settings: Settings | None = None
) -> tuple[ContactScales, Trajectory]:
    """Simulate a scene's first start, or a batch, at `_settings` or others."""
    batch = draw_batch(scene, [0]) if batch is None else batch
    settings = settings or _settings(adapter, scene)
    with adapter.open(scene, settings) as run:
        motion = whole_motion(run, batch, scene, settings.method)
    lag = settings.step if adapter.methods[settings.method].order == 1 else 0.0
    scales = adapter.contact_scales(settings)
    return ContactScales(max(scales.time, lag), scales.slip), motion


def _rebound(motion: Trajectory, pull: float) -> float:
    """Return the speed at which a ball left the ground, by its height and speed after a step."""
    height, climb = motion.position[0, 1, 0, 2] - PARTICLE_RADIUS, motion.velocity[0, 1, 0, 2]
    return float(np.sqrt(max(0.0, climb**2 + 2 * pull * height)))


def _spins(scene: Scene, motion: Trajectory, row: int) -> Array:
    """Return the bodies' angular momenta about the common centre of mass, (frame, body, 3)."""
    mechanism = Mechanism.of(scene)
    turn = rotation.matrix(mechanism.native_rotation(motion.orientation[row]))
    own = np.einsum(
        "fbij,bjk,fblk,fbl->fbi", turn, mechanism.inertia, turn, motion.angular_velocity[row]
    )
    share = mechanism.mass / mechanism.mass.sum()
    place, speed = motion.position[row], motion.velocity[row]
    place, speed = (part - np.einsum("b,fbi->fi", share, part)[:, None] for part in (place, speed))
    return np.asarray(own + np.cross(place, mechanism.mass[:, None] * speed))


def _motion_of(adapter: Adapter, scene: Scene) -> Trajectory:
    return _simulate(adapter, scene, settings=_matched_or_skip(adapter, scene))[1]

"""Motions of scenes in engines, most of them the paper's with contact, and the exact ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.checks.conservation import energy_of
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.constraints import constraint_rows
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Adapter, Readback, Settings
from mbds_xsim.simulate.choice import settings_for
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball, gaps

Rollout = Callable[[Scene, Batch], Trajectory]


@dataclass(frozen=True)
class Runs:
    """Rollouts in an engine, at matched settings but for the scenes in `careful`."""

    engine: Adapter
    careful: dict[str, Settings]

    def rollout(self, scene: Scene, batch: Batch, settings: Settings | None = None) -> Trajectory:
        own = settings or self.careful.get(scene.name)
        with self.engine.open(scene, own or settings_for(scene, self.engine, "matched")) as run:
            return run.rollout(batch)

    def alone(self, scene: Scene, settings: Settings | None = None) -> Trajectory:
        """Run a scene that draws nothing."""
        motion = self.rollout(scene, draw_batch(scene, [0]), settings)
        assert motion.failures == (None,)
        return motion

    def stepped(self, scene: Scene, substeps: int = 100, **options: float) -> Trajectory:
        """Run one start at `substeps` steps a frame; `options` override the preset's."""
        preset = self.engine.settings(scene, "matched")
        step, used = scene.clock.frame / substeps, {**preset.options, **options}
        batch = draw_batch(scene, [0], noise=False)
        motion = self.rollout(scene, batch, Settings(preset.method, step, used))
        assert motion.failures == (None,)
        return motion

    def read_back(self, scene: Scene, other: Scene) -> tuple[Readback, list[str]]:
        """Return what a loaded scene reads back as, and in what that differs from another scene."""
        batch, settings = draw_batch(scene, [0]), self.engine.settings(scene, "matched")
        with self.engine.open(scene, settings) as run:
            native = run.readback(batch)
        return native, readback.compare(Mechanism.of(other), batch, settings, native)

    def native(self, scene: Scene) -> str:
        """Return the text of a scene in the words of the engine."""
        with self.engine.open(scene, settings_for(scene, self.engine, "matched")) as run:
            return run.native(draw_batch(scene, [0]))


def worst_gap(scene: Scene, motion: Trajectory) -> float:
    """Largest residual of the joints and links at any frame [m, or a sine]."""
    mechanism = Mechanism.of(scene)
    rows = constraint_rows(mechanism, BodyStates.of(mechanism, motion))
    return float(np.abs(rows.residual).max())


def ballscroll_followed(rollout: Rollout, *, noise: bool, within: float = 1e-3) -> Trajectory:
    """Compare three starts with the exact motion: they neither hop nor sink."""
    scene = load_scene("ballscroll")
    batch = draw_batch(scene, range(3), noise=noise)
    exact, motion = reference.solve(scene, batch, cache=False), rollout(scene, batch)

    error = np.linalg.norm(motion.position - exact.position, axis=-1)
    assert motion.failures == (None,) * 3
    assert error.max() < within
    assert np.abs(motion.position[..., 2] - R).max() < 1e-5
    return motion


def balldrop_followed(
    rollout: Rollout, starts: int, *, noise: bool, apex: float, flight: float = 1e-10
) -> Trajectory:
    """Compare starts with the exact motion, and the first rebound's height to a share `apex`.

    Before the first impact, positions agree to `flight` [m].
    """
    scene = load_scene("balldrop")
    batch = draw_batch(scene, range(starts), noise=noise)
    exact, motion = reference.solve(scene, batch, cache=False), rollout(scene, batch)

    error = np.linalg.norm(motion.position - exact.position, axis=-1)[..., 0]
    height = exact.position[..., 0, 2]
    assert motion.failures == (None,) * starts
    for row in range(starts):
        climbs = np.diff(exact.velocity[row, :, 0, 2]) > 0.5
        first, second, third, *_ = (np.flatnonzero(climbs) + 1).tolist()
        assert error[row, :first].max() < flight
        assert error[row, first:third].max() < 2e-2
        rebound, expected = (
            values[row, first:second].max() - 5 * R
            for values in (motion.position[..., 0, 2], height)
        )
        assert rebound == pytest.approx(expected, rel=apex)
    return motion


def cubli_loses_energy(rollout: Rollout, starts: int, *, depth: float, rise: float) -> None:
    """Assert energy loss without flywheel torques, between frames in which no corner touches."""
    scene = load_scene("simplecubli")
    batch = draw_batch(scene, range(starts), noise=False, inputs=False)
    motion = rollout(scene, batch)
    gap = gaps(scene, motion).min(axis=-1)

    assert motion.failures == (None,) * starts
    assert gap.min() > -depth * scene.length
    for row in range(starts):
        energy = energy_of(Record(scene, batch, motion)).total[row, gap[row] > 0]
        assert np.max(energy - np.minimum.accumulate(energy)) < rise * energy[0]
        assert energy[-1] < 0.8 * energy[0]  # it has hit the ground, hard


def car_slips_on_the_ground(alone: Callable[[Scene], Trajectory], frames: int) -> None:
    """Assert that wheels at 100 rad/s slow down by slip under a car at rest, and none lifts off."""
    car = load_scene("particlecar")
    rates = HingeRate(tuple(j.name for j in car.joints), rate=(100.0, 100.0))
    clock = Clock(steps=frames)
    scene = msgspec.structs.replace(car, sampling=(rates,), noise=0.0, clock=clock)
    motion = alone(scene)

    first = motion.angular_velocity[0, 1, 1:, 1]
    slowing = 0.43 * 18.0 * 9.81 * 0.2 / Mechanism.of(scene).inertia[1, 1, 1] * 0.02
    assert 100.0 - first.mean() == pytest.approx(slowing, rel=0.02)
    gap = gaps(scene, motion).min(axis=-1)
    assert -1e-3 < gap.min() <= gap.max() < 1e-3


def elastic_ball_keeps_its_energy(alone: Callable[[Scene], Trajectory], within: float) -> None:
    """Assert that a ball has as much energy in the air after every bounce."""
    motion = alone(ball(0.2, ground=Ground(0.43, 1.0), steps=200))
    height, velocity = motion.position[0, :, 0, 2] - R, motion.velocity[0, :, 0, 2]
    energy = (0.5 * velocity**2 + 9.81 * height)[height > 0] / (9.81 * 0.2)

    assert np.sum(np.diff(np.sign(velocity)) > 0) > 5
    np.testing.assert_allclose(energy, 1.0, atol=within)


def ends_in_the_ground(motion: Trajectory) -> None:
    """Assert that a trajectory has failed because a sphere sank in, and goes no further."""
    failure = motion.failures[0]
    assert failure is not None
    assert "in the ground" in failure.reason
    assert np.isnan(motion.position[0, failure.frame :]).all()


def gimbal_followed(engine: Adapter, off: float) -> Scene:
    """Assert that a hinge closes a loop of bodies whose centres are `off` [m] from its anchor.

    With a ball joint in its place, quaternions would be off by 0.15. Returns the scene.
    """
    at, bend = (0.3, 0.0, 0.0), 0.6
    out = (float(np.cos(bend)), 0.0, float(np.sin(bend)))
    held = Inertia(1.0, (0.03, 0.05, 0.04), (0.01, -0.004, 0.006), com=(0.2 + off, 0.0, 0.0))
    names = ("driven", "cross--piece", "driving")
    joints = (
        Joint("bearing", "hinge", "world", "driven", at, (1.0, 0.0, 0.0), rate=4.0),
        Joint("yoke", "hinge", "driven", "cross--piece", at, (0.0, 1.0, 0.0)),
        Joint("other bearing", "hinge", "driving", "world", at, out),
        Joint("other yoke", "hinge", "cross--piece", "driving", at, (-out[2], 0.0, out[0])),
    )
    bodies = tuple(Body(name, inertia=held, position=(0.1, 0.0, 0.0)) for name in names)
    scene = Scene("gimbal", bodies, 0.6, joints=joints, clock=Clock(0.01, 30))
    assert [joint.name for joint in Mechanism.of(scene).loops] == ["other yoke"]

    motion = Runs(engine, {}).stepped(scene, 80)
    exact = reference.solve(scene, draw_batch(scene, [0]), cache=False)
    assert np.abs(motion.orientation - exact.orientation).max() < 1e-5
    return scene

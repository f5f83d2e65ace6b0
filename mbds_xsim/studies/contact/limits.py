"""How fast things may move before an engine delivers something else, and whether it says so."""

from __future__ import annotations

import dataclasses

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Ground, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import Profile
from mbds_xsim.studies.contact.bench import (
    FRICTION,
    RADIUS,
    RESTITUTION,
    UP,
    ContactBench,
    ContactFigure,
    ball,
)

SPINS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
"""[rad/s]"""
DROPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
"""Speeds of impacts [m/s]."""
_GROUND = Ground(FRICTION, RESTITUTION)
_AXIS = np.array([0.0, 1.0, 0.0])
_DURATION = 0.1  # [s]
_FRAME = 0.02
_WRONG = 0.01  # relative
_FALL = 0.01  # to the ground [s]


def limits(engine: str, profile: Profile) -> list[ContactFigure]:
    """Find the fastest spin of a free ball and of a hinged wheel, and the fastest impact."""
    free, hinged = (ContactBench(engine, profile, like) for like in ("balldrop", "particlecar"))
    return [
        _spinning(free, "free spin", *_flying(free)),
        _spinning(hinged, "hinge spin", *_hinged(hinged)),
        _falling(free),
    ]


def _flying(bench: ContactBench) -> tuple[Scene, Batch]:
    position, spin = np.tile(UP, (len(SPINS), 1)), np.outer(SPINS, _AXIS)
    clock = bench.clock(_FRAME, _DURATION)
    return ball(_GROUND, clock, position=position, angular_velocity=spin)


def _hinged(bench: ContactBench) -> tuple[Scene, Batch]:
    """Make a wheel on an axle that stands still."""
    wheel = Body("wheel", inertia=Inertia(1.0, (0.01, 0.02, 0.01)), position=(0.0, 0.0, 1.0))
    axle = Joint("axle", "hinge", "world", "wheel", anchor=(0.0, 0.0, 1.0), axis=(0.0, 1.0, 0.0))
    clock = bench.clock(_FRAME, _DURATION)
    scene = Scene("wheel", (wheel,), length=1.0, joints=(axle,), clock=clock)
    batch = draw_batch(scene, range(len(SPINS)))
    return scene, dataclasses.replace(batch, angular_velocity=np.outer(SPINS, _AXIS)[:, None])


def _spinning(bench: ContactBench, quantity: str, scene: Scene, batch: Batch) -> ContactFigure:
    """Hold rates against the start's, and turns against rate times time."""
    motion = bench.motion(scene, batch)
    angle = batch.angular_velocity[:, 0] @ _AXIS
    wanted = rotation.from_vector((angle[:, None] * motion.time)[..., None] * _AXIS)
    error = rotation.multiply(rotation.conjugate(wanted), motion.orientation[:, :, 0])
    turned = np.linalg.norm(rotation.to_vector(error), axis=-1)
    rate = motion.angular_velocity[:, :, 0] @ _AXIS
    right = np.abs(rate - angle[:, None]) <= _WRONG * angle[:, None]
    # A turn of a frame that is 1 % short shows at every speed, though whole turns do not.
    right &= turned <= _WRONG * angle[:, None] * np.maximum(motion.time, motion.time[1])
    whole = np.logical_and.reduce(right, axis=1)
    return _highest(bench, quantity, "rad/s", SPINS, whole, rate[:, -1], motion)


def _falling(bench: ContactBench) -> ContactFigure:
    """Ask whether the ground still holds: it is not whether the rebound is right."""
    start, clock = np.outer(DROPS, UP), bench.clock(_FRAME, _DURATION)
    motion = bench.motion(*ball(_GROUND, clock, position=_FALL * start, velocity=-start))
    height = motion.position[:, :, 0, 2]
    held = np.logical_and.reduce(height > 0.0, axis=1)
    return _highest(bench, "impact speed held", "m/s", DROPS, held, height[:, -1] - RADIUS, motion)


def _highest(
    bench: ContactBench,
    quantity: str,
    unit: str,
    asked: tuple[float, ...],
    right: Mask,
    got: Array,
    motion: Trajectory,
) -> ContactFigure:
    """Give the last that is right, with what the engine does, or says, beyond."""
    failed = np.array([failure is not None for failure in motion.failures])
    beyond = np.flatnonzero(failed | ~right)
    first = int(beyond[0]) if len(beyond) else len(asked)
    note = f"all up to {asked[-1]:g} {unit} delivered"
    if first < len(asked):
        failure = motion.failures[first]
        silent = f"silent at {asked[first]:g} {unit}: {got[first]:.4g}"
        note = silent if failure is None else f"told at {asked[first]:g} {unit}: {failure.reason}"
    reached = asked[first - 1] if first else None
    return ContactFigure(bench.engine, bench.profile, quantity, unit, reached, note=note)

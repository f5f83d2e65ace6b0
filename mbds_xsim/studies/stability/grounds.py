"""Bodies that meet the ground, made harder by one value."""

from __future__ import annotations

from typing import Literal

import msgspec

from mbds_xsim.scene.sampling_terms import HingeRate, Throw
from mbds_xsim.scene.scene import Ground, Scene
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.studies.stability.definition import Study

_SLOWEST = 0.7
"""Of the fastest wheel's rate: they are unequal, as the paper's are."""


def _fast_car(rate: float) -> Scene:
    scene = load_scene("particlecar")
    wheels = next(draw for draw in scene.sampling if isinstance(draw, HingeRate))
    faster = msgspec.structs.replace(wheels, rate=(_SLOWEST * rate, rate))
    return msgspec.structs.replace(scene, sampling=(faster,))


WHEELS = Study(
    name="wheels",
    sentence="a car whose wheels spin, unequally, up to ten times as fast as the paper's",
    quantity="rate of the fastest wheel",
    unit="rad/s",
    values=(10.0, 30.0, 100.0, 300.0, 1000.0),
    make=_fast_car,
    known=False,
)


_NONE = (0.0, 0.0)
_UP = (_NONE, _NONE, (1.0, 1.0))  # [m]


def _ball(throw: Throw, dimension: Literal[2, 3] = 2, ground: Ground | None = None) -> Scene:
    """Make the ball start as thrown, above its usual ground or another."""
    scene = load_scene("ballscroll")
    return msgspec.structs.replace(
        scene, sampling=(throw,), ground=ground or scene.ground, dimension=dimension
    )


def _thrown(speed: float) -> Scene:
    down = (_NONE, _NONE, (-speed, -speed))
    return _ball(Throw("ball", displacement=_UP, velocity=down))


THROW = Study(
    name="throw",
    sentence="a ball thrown down at the ground, up to ten times as fast as the paper's falls",
    quantity="speed",
    unit="m/s",
    values=(0.0, 5.0, 15.0, 50.0, 80.0, 150.0),
    make=_thrown,
)


_SPEED = (3.5, 3.5)  # along x and along y [m/s]


def _sliding(friction: float) -> Scene:
    along = (_SPEED, _SPEED, _NONE)
    return _ball(Throw("ball", velocity=along), 3, Ground(friction, 0.0))


FRICTION = Study(
    name="friction",
    sentence="a ball that slides at 45° to the axes until it rolls",
    quantity="coefficient of friction",
    unit="",
    values=(0.0, 0.1, 0.43, 1.0, 2.0),
    make=_sliding,
)


def _dropped(restitution: float) -> Scene:
    return _ball(Throw("ball", displacement=_UP), ground=Ground(0.43, restitution))


RESTITUTION = Study(
    name="restitution",
    sentence="a ball dropped from 1 m, for 2 s: up to three impacts",
    quantity="coefficient of restitution",
    unit="",
    values=(0.0, 0.2, 0.5, 0.8, 0.95, 1.0),
    make=_dropped,
    frames=20,
)

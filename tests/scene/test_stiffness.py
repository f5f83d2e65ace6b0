"""Rates of springs and dampers, and the steps that follow from them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, SpringDamper, Vector
from mbds_xsim.scene.stiffness import spring_rates, spring_step
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.simulate.timed import simulate
from mbds_xsim.testing import CASES

_OPENING = math.radians(30)
_STEEL = Inertia(0.3, (0.025, 0.025, 5e-6))
"""A rod of 1 m by 1 cm by 1 cm along z."""


def governor(steps: int = 3) -> Scene:
    """A fly-ball governor: arms with balls on a shaft, springs from the arms to a ring below.

    After the fly-ball governor of the IFToMM library of multibody benchmarks, but with
    other masses of the ring and the shaft.
    """
    ring = (0.0, 0.0, -math.cos(_OPENING))
    sides = {"left": -1.0, "right": 1.0}
    return Scene(
        "governor",
        bodies=(
            Body("shaft", inertia=_STEEL, position=(0.0, 0.0, -0.5)),
            Body("ring", inertia=Inertia(3.0, (0.005, 0.005, 0.005)), position=ring),
            *(_arm(name, side) for name, side in sides.items()),
            *(_ball(name, side) for name, side in sides.items()),
        ),
        joints=(
            Joint("bearing", "hinge", "world", "shaft", (0, 0, 0), (0, 0, 1), rate=2 * math.pi),
            Joint("rail", "slider", "shaft", "ring", ring, (0, 0, 1)),
            *(Joint(f"{n} hinge", "hinge", "shaft", n, (0, 0, 0), (0, 1, 0)) for n in sides),
            *(Joint(f"{n} weld", "fixed", n, f"{n} ball", _along(s)) for n, s in sides.items()),
        ),
        springs=tuple(
            SpringDamper(f"{n} spring", (n, "ring"), (_along(s, 0.5), ring), 8e5, 4e4)
            for n, s in sides.items()
        ),
        length=1.0,
        clock=Clock(steps=steps),
    )


def _along(side: float, way: float = 1.0) -> Vector:
    return (side * way * math.sin(_OPENING), 0.0, -way * math.cos(_OPENING))


def _arm(name: str, side: float) -> Body:
    half = -side * _OPENING / 2
    turn = (math.cos(half), 0.0, math.sin(half), 0.0)
    return Body(name, inertia=_STEEL, position=_along(side, 0.5), orientation=turn)


def _ball(name: str, side: float) -> Body:
    return Body(f"{name} ball", inertia=Inertia(5.0, (0.008,) * 3), position=_along(side))


def test_joints_hold_what_a_spring_would_turn_about_its_thin_axis() -> None:
    """The fastest eigenvalue of the equations of motion is 2.1e4/s; without joints it is 2e9/s."""
    oscillating, decaying = spring_rates(governor())

    assert 2.1e4 < decaying < 3e4
    assert 500.0 < oscillating < 1000.0


def test_a_mass_on_a_spring_has_its_own_rates() -> None:
    """A ball of 1 kg on a rail has a spring of 40 N/m and 0.8 N·s/m."""
    (scene,) = (case.scene for case in CASES if case.name == "spring")

    assert spring_rates(scene) == pytest.approx((math.sqrt(40.0), 0.8), rel=1e-9)
    assert spring_step(scene, angle=0.1, decay=0.1) == pytest.approx(0.1 / math.sqrt(40.0))


def test_a_dead_point_of_a_loop_does_not_hide_a_spring() -> None:
    assert spring_rates(load_scene("andrews"))[0] > 100.0


def test_every_preset_gets_through_a_stiff_scene_at_a_step_of_its_rates(adapter: Adapter) -> None:
    scene = governor()
    batch = draw_batch(scene, [0])
    settings = adapter.settings(scene, "matched")

    motion = simulate(scene, batch, adapter.name, settings).trajectory

    assert settings.step >= 1e-5
    assert motion.failures == (None,)
    exact = reference.solve(scene, batch, cache=False)
    assert np.abs(motion.position - exact.position).max() < 1e-5

"""Dry friction of joints allows one motion, whatever sticks, slides and turns back."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mbds_xsim.checks import Record
from mbds_xsim.checks.conservation import energy_balance
from mbds_xsim.reference.first_impact import FirstImpact
from mbds_xsim.reference.solution import solve
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Ground, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.simulate.registry import load_scene
from tests.over_ground import over_ground
from tests.random_scenes import MOVED, SEEDS, Kind, ruled_tree

_STILL = 1e-12


def _rubbing(seed: int, kinds: list[Kind], friction: float) -> Scene:
    law = {"friction": friction, "rate": 0.5, "stiffness": 9.0}
    return ruled_tree(seed, kinds, Clock(frame=0.005, steps=100), **law)


@settings(max_examples=5, deadline=None)
@given(SEEDS, MOVED, st.sampled_from([0.5, 5.0]))
@example(386, ["slider"], 5.0)  # turns back just before a frame ends
def test_friction_takes_what_the_ways_of_joints_cost(
    seed: int, kinds: list[Kind], friction: float
) -> None:
    scene = _rubbing(seed, kinds, friction)
    batch = draw_batch(scene, [0])
    record = Record(scene, batch, solve(scene, batch, cache=False))
    finding = energy_balance.finding(record)

    assert record.trajectory.failures == (None,)
    assert finding.uncertainty is not None
    assert finding.figure.max() < finding.uncertainty.max() + 1e-6


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 3))
def test_where_all_stands_still_no_friction_holds_more_than_it_can(seed: int, hinges: int) -> None:
    kinds: list[Kind] = ["hinge"] * hinges
    scene = _rubbing(seed, [*kinds, "slider"], 40.0)
    batch, mechanism = draw_batch(scene, [0]), Mechanism.of(scene)
    links = to_links(mechanism, BodyStates.of(mechanism, solve(scene, batch, cache=False)))
    at = np.flatnonzero((np.abs(links.rate[0]) < _STILL).all(axis=-1))

    if len(at):
        assert np.ptp(links.coordinate[0, at], axis=0).max() < _STILL
    for k, link in enumerate(mechanism.links):
        if len(at) and link.joint is not None:
            unit = np.zeros_like(links.rate)
            unit[..., k] = 1.0
            moved = to_bodies(mechanism, dataclasses.replace(links, rate=unit)).velocity[0, at]
            weight = moved @ np.array(scene.gravity) @ mechanism.mass
            spring = link.joint.stiffness * links.coordinate[0, at, k]
            assert np.abs(weight - spring).max() < 40.0 * (1 + 1e-6)


def test_heavy_friction_stops_a_chain_and_light_friction_does_not() -> None:
    rates = []
    for friction in (0.1, 400.0):
        scene = _rubbing(7, ["hinge", "slider", "hinge"], friction)
        mechanism = Mechanism.of(scene)
        states = BodyStates.of(mechanism, solve(scene, draw_batch(scene, [0]), cache=False))
        rates.append(to_links(mechanism, states).rate[0, 1:])

    assert (np.abs(rates[0]) > _STILL).all()
    assert (np.abs(rates[1][50:]) < _STILL).all()


@pytest.mark.parametrize("friction", [0.0, 3.0])
def test_a_rubbing_block_lands_when_its_slope_says(friction: float) -> None:
    """The block slides down at 60°, far from its stops: s = ½ (g sin α − F/m) t²."""
    slope, mass, radius, gap = np.pi / 3, 0.5, 0.05, 0.3
    down = (np.cos(slope), 0.0, -np.sin(slope))
    body = Body("block", inertia=Inertia(mass, (1e-3,) * 3), position=(0, 0, radius + gap))
    rail = Joint("rail", "slider", "world", "block", (0, 0, radius + gap), down, friction=friction)
    rail = msgspec.structs.replace(rail, limits=(-1.0, 1.0))
    more = {"joints": (rail,), "clock": Clock(0.02, 40)}
    scene = over_ground(body, body.position, radius, Ground(0.5, 0.0), **more)
    motion = solve(scene, draw_batch(scene, [0], noise=False), cache=False)
    pull = 9.81 * np.sin(slope) - friction / mass
    time = np.sqrt(2.0 * gap / np.sin(slope) / pull)

    (end,) = motion.failures
    assert isinstance(end, FirstImpact)
    assert end.time == pytest.approx(time, rel=1e-12)
    assert end.frame == int(time / 0.02) + 1
    assert np.isfinite(motion.position[0, : end.frame]).all()
    assert np.isnan(motion.position[0, end.frame :]).all()


def test_a_stop_that_is_not_reached_changes_no_first_impact() -> None:
    """Maximal coordinates, which know no stops, give the same first impact."""
    scene = msgspec.structs.replace(load_scene("simplecubli"), clock=Clock(0.02, 60))
    hinges = (
        msgspec.structs.replace(one, limits=(-1e3, 1e3)) if one.kind == "hinge" else one
        for one in scene.joints
    )
    limited = msgspec.structs.replace(scene, joints=tuple(hinges))
    batch = draw_batch(scene, range(3), noise=False)
    free, stopped = (solve(one, batch, cache=False) for one in (scene, limited))

    for one, other in zip(free.failures, stopped.failures, strict=True):
        assert isinstance(one, FirstImpact)
        assert isinstance(other, FirstImpact)
        assert other.time == pytest.approx(one.time, rel=1e-9)
        assert other.frame == one.frame
    np.testing.assert_allclose(stopped.position, free.position, atol=1e-8)


def test_a_trial_step_that_overflows_ends_no_more_than_the_trajectory() -> None:
    """One joint stands still by friction, and the next has an extreme damper."""
    rod, bead = Inertia(0.5, (1e-2,) * 3), Inertia(0.01, (1e-15,) * 3)
    bodies = (
        Body("rod", inertia=rod, position=(0.1, 0, 0)),
        Body("bead", inertia=bead, position=(0.2, 0, 0)),
    )
    axis = (0.0, -1.0, 0.0)
    joints = (
        Joint("held", "hinge", "world", "rod", (0, 0, 0), axis, 0.0, 0.0, friction=2.0),
        Joint("damped", "hinge", "rod", "bead", (0.2, 0, 0), axis, 0.0, 1.0, damping=1.0),
    )
    scene = Scene("arm", bodies, 1.0, joints=joints, clock=Clock(0.02, 2))

    with np.errstate(invalid="ignore", over="ignore"):
        (failure,) = solve(scene, draw_batch(scene, [0]), cache=False).failures

    assert failure is not None
    assert "cannot be continued" in failure.reason


_SPRING, _GRIP = 225.0, 1.0


def _sprung_pair(rates: tuple[float, float], frame: float) -> Scene:
    """Two blocks of 1 kg with a spring between them; the first rubs."""
    inertia = Inertia(mass=1.0, moments=(0.01, 0.01, 0.01))
    ends = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    sliders = [
        Joint(
            name=f"slider {name}",
            kind="slider",
            parent="world",
            child=name,
            anchor=end,
            axis=(1.0, 0.0, 0.0),
            start=0.0,
            rate=rate,
            friction=friction,
        )
        for name, end, rate, friction in zip("ab", ends, rates, (_GRIP, 0.0), strict=True)
    ]
    return Scene(
        name="pair",
        length=1.0,
        gravity=(0.0, 0.0, 0.0),
        bodies=tuple(
            Body(name=name, inertia=inertia, position=end)
            for name, end in zip("ab", ends, strict=True)
        ),
        joints=tuple(sliders),
        springs=(SpringDamper(name="s", bodies=("a", "b"), points=ends, stiffness=_SPRING),),
        clock=Clock(frame=frame, steps=round(0.5 / frame)),
    )


def _by_phases(rates: tuple[float, float], duration: float) -> float:
    """Place of the first block at the end, by another method from one event to the next [m]."""
    y, time = np.array([0.0, 0.0, *rates]), 0.0
    sense = float(np.sign(rates[0]))

    def pull(y: np.ndarray) -> float:
        return float(_SPRING * (y[1] - y[0]))

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [abs(sense) * y[2], y[3], abs(sense) * (pull(y) - _GRIP * sense), -pull(y)]

    def event(_: float, y: np.ndarray) -> float:
        return float(sense * y[2]) if sense else _GRIP - abs(pull(y))

    event.terminal, event.direction = True, -1.0  # type: ignore[attr-defined]
    accuracy = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "max_step": 2e-3}
    while time < duration:
        part = solve_ivp(rate, (time, duration), y, events=event, **accuracy)
        time, y = part.t[-1], part.y[:, -1]
        if part.status == 1:
            y[2] *= 1.0 - abs(sense)
            sense = 0.0 if sense and abs(pull(y)) <= _GRIP else float(np.sign(pull(y)))
    return float(y[0])


@pytest.mark.parametrize("frame", [0.1, 0.025])
@pytest.mark.parametrize(
    "rates",
    [(0.154, 0.5), (0.0, 1.01 * _GRIP / _SPRING**0.5)],
    ids=["stops and moves on", "gives way and grips"],
)
def test_events_that_end_inside_a_step_are_noticed(
    rates: tuple[float, float], frame: float
) -> None:
    scene = _sprung_pair(rates, frame)
    place = solve(scene, draw_batch(scene, [0]), cache=False).position[0, -1, 0, 0]

    assert abs(place - _by_phases(rates, 0.5)) < 1e-11

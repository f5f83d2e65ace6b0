"""The compiled reference, against the equations in maximal coordinates and laws of its own."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.integrate import DOP853

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.reference import compiled, dop853, marching
from mbds_xsim.reference.elimination import with_short_loops
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.marching import Marched, Problem
from mbds_xsim.reference.solution import solve, start_states
from mbds_xsim.reference.tree import tree_of, with_rows
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.joint_space import to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, DistanceLink, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.registry import load_scene
from tests.random_scenes import Kind, random_links, random_tree

KINDS = st.lists(
    st.sampled_from(["fixed", "hinge", "slider", "ball", "free"]), min_size=1, max_size=6
)


def with_springs(rng: np.random.Generator, scene: Scene) -> Scene:
    """Add soft springs with dampers between two bodies, to the world, and in half of the joints."""
    names = [body.name for body in scene.bodies]
    ends = [("world", names[0]), ("world" if len(names) == 1 else names[0], names[-1])]
    springs = tuple(
        SpringDamper(
            f"spring{k}",
            pair,
            (_point(rng), _point(rng)),
            stiffness=3.0,
            damping=0.2,
            rest_length=0.7,
        )
        for k, pair in enumerate(ends)
    )
    joints = tuple(
        msgspec.structs.replace(joint, stiffness=2.0, damping=0.3, rest=0.4)
        if joint.kind in ("hinge", "slider") and rng.random() < 0.5
        else joint
        for joint in scene.joints
    )
    return msgspec.structs.replace(scene, springs=springs, joints=joints)


def _point(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = rng.uniform(-2.0, 2.0, 3).tolist()
    return x, y, z


RandomCase = tuple[Mechanism, Array, Array, Array]


def random_case(seed: int, kinds: list[Kind], links: int) -> RandomCase:
    """Make a scene, states of it that keep its joints together, forces and torques."""
    rng = np.random.default_rng(seed)
    scene = with_springs(rng, random_tree(rng, kinds, links=links))
    mechanism = Mechanism.of(scene)
    dynamics = dynamics_of(mechanism)
    states = dynamics.pack(to_bodies(mechanism, random_links(rng, mechanism, (3,))))
    for _ in range(30 if links else 1):
        states = dynamics.project(states)
    force = rng.standard_normal((3, mechanism.body_count, 3))
    return mechanism, states, force, rng.standard_normal((3, len(mechanism.hinges)))


def are_closed(mechanism: Mechanism, states: Array) -> Mask:
    """Return in which states all joints hold, with no hinge's axis turned round.

    Newton's method may close a hinge with its axis turned round, which no motion leads to.
    """
    dynamics = dynamics_of(mechanism)
    bodies = dynamics.unpack(states)
    again = to_bodies(mechanism, to_links(mechanism, bodies))
    joined = np.abs(again.position - bodies.position).max(axis=(1, 2)) < 1e-9
    return np.asarray(joined & (np.abs(dynamics.residual(states)).max(axis=1) < 1e-12))


TREES = st.builds(random_case, st.integers(0, 10**6), KINDS, st.just(0))


@settings(max_examples=60, deadline=None)
@given(TREES)
def test_trees_have_the_accelerations_that_newton_and_euler_give(case: RandomCase) -> None:
    mechanism, states, force, torque = case
    expected = dynamics_of(mechanism).derivative(states, force, torque)[:, :-1, 7:]
    actual = compiled.body_accelerations(mechanism, states, force, torque)
    assert actual == pytest.approx(expected, rel=1e-8, abs=1e-8 * (1.0 + np.abs(expected).max()))


@settings(max_examples=30, deadline=None)
@given(TREES)
def test_a_rotor_is_a_torque_against_the_acceleration_of_its_hinge(case: RandomCase) -> None:
    mechanism, states, force, torque = case
    joints = (
        msgspec.structs.replace(joint, armature=0.8) if joint.kind == "hinge" else joint
        for joint in mechanism.scene.joints
    )
    geared = Mechanism.of(msgspec.structs.replace(mechanism.scene, joints=tuple(joints)))
    actual = compiled.body_accelerations(geared, states, force, torque)
    spin, gain = (
        np.pad(v, ((0, 0), (0, 1), (0, 0))) for v in (states[:, :-1, 10:], actual[..., 3:])
    )
    bodies = dynamics_of(mechanism).unpack(states).with_world()
    for k, hinge in enumerate(mechanism.hinges):
        axis = bodies.arms(hinge.parent, hinge.axis)
        faster = gain[:, hinge.child] - gain[:, hinge.parent]
        faster -= np.cross(spin[:, hinge.parent], spin[:, hinge.child])
        torque[:, k] -= 0.8 * np.sum(axis * faster, axis=-1)

    expected = dynamics_of(mechanism).derivative(states, force, torque)[:, :-1, 7:]
    assert actual == pytest.approx(expected, rel=1e-8, abs=1e-8 * (1.0 + np.abs(expected).max()))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), KINDS, st.integers(0, 1), st.sampled_from([1.0, -2.5]))
@example(741345, ["fixed", "hinge"], 1, 1.0)  # a body that is fixed carries one that is coupled
def test_a_coupling_is_a_torque_on_each_of_its_hinges_that_keeps_their_rates(
    seed: int, kinds: list[Kind], links: int, ratio: float
) -> None:
    kinds = [*kinds, "hinge", "hinge"]
    mechanism, states, force, torque = random_case(seed, kinds, links)
    *_, leader, follower = mechanism.hinges
    coupling = Coupling(follower.name, leader.name, ratio)
    geared = Mechanism.of(msgspec.structs.replace(mechanism.scene, couplings=(coupling,)))
    dynamics, count = dynamics_of(mechanism), len(mechanism.hinges)
    actual = compiled.body_accelerations(geared, states, force, torque)

    def slip(gain: Array) -> Array:
        """Return how much faster the follower becomes than it should."""
        bodies = dynamics.unpack(states).with_world()
        gain = np.pad(gain[..., 3:], ((0, 0), (0, 1), (0, 0)))
        spin, faster = bodies.angular_velocity, []
        for hinge in (follower, leader):
            grown = gain[:, hinge.child] - gain[:, hinge.parent]
            grown -= np.cross(spin[:, hinge.parent], spin[:, hinge.child])
            faster.append(np.sum(bodies.arms(hinge.parent, hinge.axis) * grown, axis=-1))
        return np.asarray(faster[0] - ratio * faster[1])

    unit = np.zeros(count)
    unit[[count - 1, count - 2]] = 1.0, -ratio
    alone, driven = (
        dynamics.derivative(states, force, torque + share * unit)[:, :-1, 7:] for share in (0, 1)
    )
    load = (-slip(alone) / (slip(driven) - slip(alone)))[:, None, None]
    expected = alone + load * (driven - alone)
    closed = are_closed(mechanism, states)
    actual, expected = actual[closed], expected[closed]
    assert actual == pytest.approx(
        expected, rel=1e-7, abs=1e-7 * (1.0 + np.abs(expected).max(initial=0.0))
    )


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.lists(st.sampled_from(["hinge", "ball", "free"]), min_size=3, max_size=5),
    st.integers(1, 3),
)
def test_loops_have_the_accelerations_that_newton_and_euler_give(
    seed: int, kinds: list[Kind], links: int
) -> None:
    mechanism, states, force, torque = random_case(seed, kinds, links)
    dynamics = dynamics_of(mechanism)
    rate, share = dynamics.rate(states, force, torque)
    fit = are_closed(mechanism, states) & (share > 1e-2)
    assume(fit.any())
    expected = rate[fit, :-1, 7:]
    actual = compiled.body_accelerations(mechanism, states[fit], force[fit], torque[fit])
    assert actual == pytest.approx(expected, rel=1e-7, abs=1e-7 * (1.0 + np.abs(rate).max()))


def test_closed_loops_cost_in_proportion_to_their_number() -> None:
    scenes = (load_scene(f"{rungs}ladder") for rungs in (6, 8, 16))
    trees = [tree_of(with_short_loops(Mechanism.of(scene))) for scene in scenes]
    plans = [with_rows(tree, np.arange(tree.loaded), tree.loaded).plan for tree in trees]
    for count in (lambda p: len(p.on_row), lambda p: len(p.on_pair), lambda p: len(p.fill_pair)):
        six, eight, sixteen = map(count, plans)
        assert sixteen - eight == 4 * (eight - six)
    kept = trees[2].plan
    assert len(kept.on_row) > 4 * len(plans[2].on_row)


def problem(mechanism: Mechanism, batch: Batch, rtol: float) -> Problem:
    """Return the problem of a batch's motion."""
    start = start_states(mechanism, batch)
    return Problem(dynamics_of(mechanism), start, batch.force, batch.torque, rtol)


def both(
    name: str, steps: int, *, index: list[int], rtol: float = 1e-11
) -> tuple[Marched, Marched]:
    """March a scene with kernels and without."""
    scene = load_scene(name)
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, index).truncated(steps)
    slow = marching.march(problem(mechanism, batch, 1e-11))
    return compiled.march_compiled(problem(mechanism, batch, rtol)), slow


@pytest.mark.parametrize(
    "name", ["5pendulum", "6pendulum", "workbench", "andrews", "bricard", "2ladder", "5ladder"]
)
def test_scenes_move_as_in_maximal_coordinates(name: str) -> None:
    fast, slow = both(name, 25, index=[0, 1, 3])
    assert fast.failures == slow.failures
    assert np.abs(fast.states[..., :3] - slow.states[..., :3]).max() < 1e-9
    # Quaternions too: each goes on continuously from the start's.
    assert np.abs(fast.states[..., 3:7] - slow.states[..., 3:7]).max() < 1e-8


def test_a_trajectory_does_not_depend_on_those_beside_it() -> None:
    scene = load_scene("workbench")
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(11)).truncated(7)
    whole, row = problem(mechanism, batch, 1e-9), slice(9, 10)
    together, one = (compiled.march_compiled(each) for each in (whole, whole.part(row)))
    assert np.array_equal(together.states[row], one.states)


def test_errors_fall_with_the_tolerance_as_an_order_of_eight_has_it() -> None:
    slow = both("6pendulum", 20, index=[1])[1]
    off = []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        fast = both("6pendulum", 20, index=[1], rtol=rtol)[0]
        off.append(float(np.abs(fast.states[..., :3] - slow.states[..., :3]).max()))
    assert off[0] > 30 * off[2] > 900 * off[3]
    assert off[3] < 1e-9


def test_a_loop_that_turns_as_a_whole_keeps_its_independent_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = load_scene("workbench")
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, range(12))
    monkeypatch.delattr(marching, "march")
    whole = compiled.march_compiled(problem(mechanism, batch, 1e-9))
    assert np.isfinite(whole.states).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_second_hinge_on_the_same_line_holds_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_tree(rng, ["hinge"])
    (hinge,) = scene.joints
    anchor, axis = np.array(hinge.anchor), np.array(hinge.axis)
    x, y, z = (anchor + axis).tolist()
    second = msgspec.structs.replace(hinge, name="second", anchor=(x, y, z))
    twice = msgspec.structs.replace(scene, joints=(hinge, second))

    assert not compiled.chosen(Mechanism.of(twice))[0].loaded
    once, held = (solve(each, draw_batch(each, [0]), cache=False) for each in (scene, twice))
    np.testing.assert_allclose(held.position, once.position, rtol=0, atol=1e-12)


def test_a_loop_of_welds_falls_with_its_rotor() -> None:
    mass = Inertia(1.0, (0.03, 0.05, 0.04))
    bodies = (Body("a", inertia=mass, position=(0.3, 0.0, 0.0)), Body("b", inertia=mass))
    hinge = Joint("pivot", "hinge", "world", "a", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), armature=0.05)
    weld = Joint("weld", "fixed", "a", "b", (0.4, 0.1, 0.0))
    ball = Joint("closing", "ball", "b", "a", (0.4, 0.2, 0.3))
    tree = Scene("welds", bodies, 1.0, joints=(hinge, weld), clock=Clock(steps=20))
    loop = msgspec.structs.replace(tree, joints=(hinge, weld, ball))

    assert not compiled.chosen(Mechanism.of(loop))[0].loaded
    free, closed = (solve(each, draw_batch(each, [0]), cache=False) for each in (tree, loop))
    np.testing.assert_allclose(closed.position, free.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mass", [1e-6, 1e-10, 1e-14])
def test_a_link_to_a_light_body_holds_the_heavy_one_that_carries_it(mass: float) -> None:
    heavy = Body("heavy", inertia=Inertia(1.0, (0.03, 0.05, 0.04)), position=(0.3, 0.0, 0.0))
    light = Body("light", inertia=Inertia(mass, (mass, mass, mass)), position=(0.5, 0.1, 0.0))
    ball = Joint("pivot", "ball", "world", "heavy", (0.0, 0.0, 0.0))
    weld = Joint("weld", "fixed", "heavy", "light", (0.4, 0.0, 0.0))
    link = DistanceLink("rope", ("world", "light"), ((0.5, 0.1, 1.0), (0.5, 0.1, 0.2)))
    scene = Scene("hung", (heavy, light), 1.0, joints=(ball, weld), distance_links=(link,))
    assert compiled.chosen(Mechanism.of(scene))[0].loaded == 1


def test_a_slider_with_a_spring_may_close_a_loop() -> None:
    mass, ways = Inertia(1.0, (0.1, 0.1, 0.1)), ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 1.0))
    ends = ("world", "carriage"), ("carriage", "block"), ("block", "world")
    joints = tuple(
        Joint(f"slider {k}", "slider", *pair, (0.0, 0.0, 0.0), way, stiffness=8.0, rest=0.2)
        for k, (pair, way) in enumerate(zip(ends, ways, strict=True))
    )
    bodies = Body("carriage", inertia=mass), Body("block", inertia=mass)
    scene = Scene("wedge", bodies, 1.0, joints=joints, clock=Clock(0.02, 25))
    task = problem(Mechanism.of(scene), draw_batch(scene, [0]), 1e-11)
    fast, slow = compiled.march_compiled(task), marching.march(task)
    np.testing.assert_allclose(fast.states, slow.states, rtol=0, atol=1e-9)
    assert np.abs(fast.states[..., 0, :3]).max() > 0.01


def test_the_coefficients_of_the_method_are_those_of_scipy() -> None:
    count = dop853.STAGES
    for own, theirs in (
        (dop853.A, DOP853.A[:count, :count]),
        (dop853.B, DOP853.B),
        (dop853.E5, DOP853.E5[:count]),
        (dop853.E3, DOP853.E3[:count]),
    ):
        assert np.array_equal(own, theirs)


def test_what_cannot_move_writes_nothing_beside_its_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    beyond: list[Array] = []
    lines = compiled.lines

    def guarded(count: int) -> Array:
        whole, kept = lines(count + 64), max(count, 1)
        whole[kept:] = 7.0
        beyond.append(whole[kept:])
        return whole[:kept]

    monkeypatch.setattr(compiled, "lines", guarded)
    joint = Joint(name="weld", kind="fixed", parent="world", child="post", anchor=(0.0, 0.0, 0.0))
    body = Body(name="post", inertia=Inertia(mass=1.0, moments=(1.0, 1.0, 1.0)))
    scene = Scene(name="post", length=1.0, bodies=(body,), joints=(joint,), clock=Clock(steps=3))
    batch = draw_batch(scene, [0])
    motion = solve(scene, batch, cache=False)

    assert all((rows == 7.0).all() for rows in beyond)
    assert (motion.position == batch.position[:, None]).all()
    assert not motion.velocity.any()

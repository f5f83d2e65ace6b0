"""Tree coordinates and body states: there and back, for random trees of all joint kinds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from tests.random_scenes import Kind, random_links, random_tree

_KINDS = st.lists(
    st.sampled_from(["fixed", "hinge", "slider", "ball", "free"]), min_size=1, max_size=6
)


def _equal(actual: Array, expected: Array, size: float = 1.0) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12 * max(1.0, size))


def _equal_turns(actual: Array, expected: Array) -> None:
    """Compare quaternions, whose sign is free."""
    same = np.sign(np.sum(actual * expected, axis=-1, keepdims=True))
    _equal(actual * same, expected)


@settings(max_examples=100, deadline=None)
@given(_KINDS, st.integers(0, 2**32 - 1))
def test_tree_coordinates_come_back(kinds: list[Kind], seed: int) -> None:
    rng = np.random.default_rng(seed)
    mechanism = Mechanism.of(random_tree(rng, kinds))
    links = random_links(rng, mechanism, (2, 3))

    bodies = to_bodies(mechanism, links)
    back = to_links(mechanism, bodies)

    size = float(np.abs(bodies.velocity).max() + np.abs(bodies.position).max())
    for key in ("coordinate", "rate", "position", "velocity"):
        _equal(getattr(back, key), getattr(links, key), size)
    kind = ["free" if link.joint is None else link.joint.kind for link in mechanism.links]
    turning = [k for k, name in enumerate(kind) if name in ("ball", "free")]
    _equal_turns(back.rotation[..., turning, :], links.rotation[..., turning, :])
    _equal(back.angular_velocity[..., turning, :], links.angular_velocity[..., turning, :], size)
    again = to_bodies(mechanism, back)
    _equal(again.position, bodies.position, size)
    _equal(again.velocity, bodies.velocity, size)
    _equal(again.angular_velocity, bodies.angular_velocity, size)
    _equal_turns(again.native, bodies.native)


@settings(max_examples=50, deadline=None)
@given(_KINDS, st.integers(0, 2**32 - 1))
def test_coordinates_are_those_of_the_scene_whichever_way_the_tree_runs(
    kinds: list[Kind], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    mechanism = Mechanism.of(random_tree(rng, kinds))
    links = random_links(rng, mechanism, ())

    bodies = to_bodies(mechanism, links)

    for k, link in enumerate(mechanism.links):
        if link.joint is not None and link.joint.kind in ("hinge", "slider"):
            as_listed = mechanism.joints[link.joint.index]
            coordinate = joint_coordinate(as_listed, bodies.position, bodies.native)
            assert coordinate == pytest.approx(links.coordinate[k], abs=1e-11)


def test_velocities_are_the_rates_of_positions() -> None:
    rng = np.random.default_rng(2)
    mechanism = Mechanism.of(
        random_tree(rng, ("hinge", "slider", "ball", "free", "fixed", "hinge"))
    )
    links, step = random_links(rng, mechanism, ()), 1e-6

    def at(time: float) -> BodyStates:
        turn = rotation.from_vector(time * links.angular_velocity)
        moved = type(links)(
            rotation.multiply(links.rotation, turn),
            links.angular_velocity,
            links.coordinate + time * links.rate,
            links.rate,
            links.position + time * links.velocity,
            links.velocity,
        )
        return to_bodies(mechanism, moved)

    now, ahead, behind = at(0.0), at(step), at(-step)

    np.testing.assert_allclose(
        now.velocity, (ahead.position - behind.position) / (2 * step), atol=1e-8
    )
    turned = rotation.multiply(ahead.native, rotation.conjugate(behind.native))
    np.testing.assert_allclose(
        now.angular_velocity, rotation.to_vector(turned) / (2 * step), atol=1e-8
    )


_QUARTER = rotation.from_vector(np.array([[0.0, 0.0, np.pi / 2]]))
_GROWN: dict[str, Any] = {
    # A joint's kind and axis, its child's centre of mass, the motion, coordinate and rate.
    "a hinge turns right-handed": (
        ("hinge", (0.0, 0.0, 2.0)),
        (1.0, 0.0, 0.0),
        ([0.0, 1.0, 0.0], _QUARTER, [-3.0, 0.0, 0.0], [0.0, 0.0, 3.0]),
        (np.pi / 2, 3.0),
    ),
    "a slider moves along": (
        ("slider", (3.0, 0.0, 4.0)),
        (0.0, 0.5, 0.0),
        ([0.6, 0.5, 0.8], rotation.IDENTITY[None], [1.2, 0.0, 1.6], [0.0, 0.0, 0.0]),
        (1.0, 2.0),
    ),
}


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("name", _GROWN)
def test_coordinates_grow_as_the_child_moves(name: str, swapped: bool) -> None:
    (kind, axis), com, motion, expected = _GROWN[name]
    body = Body("arm", inertia=Inertia(1.0, (1.0, 1.0, 1.0), com=com))
    ends = ("arm", "world") if swapped else ("world", "arm")
    joint = Joint("joint", kind, *ends, (0.0, 0.0, 0.0), axis)
    mechanism = Mechanism.of(Scene("arm", (body,), 1.0, joints=(joint,)))
    moved = BodyStates(*(np.array(part, dtype=float).reshape(1, -1) for part in motion))

    links = to_links(mechanism, moved)

    sign = -1.0 if swapped else 1.0
    assert (links.coordinate[0], links.rate[0]) == pytest.approx([sign * v for v in expected])
    _equal(to_bodies(mechanism, links).position, moved.position)
    _equal(to_bodies(mechanism, links).velocity, moved.velocity)

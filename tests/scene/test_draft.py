"""Draws move joints by the drawn amount, whatever else moves them."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeRate, Pose, Turn
from mbds_xsim.scene.state import STATES
from mbds_xsim.simulate.registry import load_scene
from mbds_xsim.testing import CASES
from tests.random_scenes import Kind, random_tree

_KINDS = st.lists(st.sampled_from(["hinge", "slider"]), min_size=1, max_size=5)


@settings(max_examples=50, deadline=None)
@given(_KINDS, st.integers(0, 2**32 - 1))
def test_a_pose_adds_to_coordinates_and_leaves_rates(kinds: list[Kind], seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, kinds)
    start, rate, more = rng.uniform(-1.2, 1.2, (3, len(kinds)))
    joints = tuple(
        msgspec.structs.replace(joint, start=float(s), rate=float(r))
        for joint, s, r in zip(tree.joints, start, rate, strict=True)
    )
    poses = tuple(
        Pose(joints=(joint.name,), coordinate=(float(m), float(m)))
        for joint, m in zip(joints, more, strict=True)
    )
    scene = msgspec.structs.replace(tree, joints=joints, sampling=poses)

    mechanism = Mechanism.of(scene)
    links = to_links(mechanism, BodyStates.of(mechanism, draw_batch(scene, [0])))
    order = [link.joint.index for link in mechanism.links if link.joint is not None]
    np.testing.assert_allclose(links.coordinate[0], (start + more)[order], atol=1e-11)
    np.testing.assert_allclose(links.rate[0], rate[order], atol=1e-11)


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(4)), st.integers(0, 2**32 - 1))
def test_what_follows_a_joint_is_drawn_along_by_its_ratio(order: list[int], seed: int) -> None:
    """Also through a chain, and in whatever order the couplings are listed."""
    kinds: list[Kind] = ["hinge", "hinge", "hinge", "slider", "slider"]
    tree = random_tree(np.random.default_rng(seed), kinds)
    names = [joint.name for joint in sorted(tree.joints, key=lambda joint: joint.kind)]
    pairs = [(3, 0, 0.3, 0.05), (2, 3, -2.0, 0.1), (1, 0, -1.5, 0.0), (4, 1, 0.2, -0.3)]
    ties = [Coupling(names[a], names[b], *law) for a, b, *law in pairs]
    scene = msgspec.structs.replace(tree, couplings=tuple(ties[k] for k in order))
    draws = (Pose((names[0],), (0.4, 0.4)), HingeRate((names[0],), (0.7, 0.7)))
    drawn = msgspec.structs.replace(scene, sampling=draws)

    mechanism = Mechanism.of(scene)
    still, moved = (
        to_links(mechanism, BodyStates.of(mechanism, draw_batch(each, [0])))
        for each in (scene, drawn)
    )
    share = dict(zip(names, [1.0, -1.5, -0.6, 0.3, -0.3], strict=True))
    ratio = np.array([share[link.joint.name] for link in mechanism.links if link.joint])
    np.testing.assert_allclose((moved.coordinate - still.coordinate)[0], 0.4 * ratio, atol=1e-11)
    np.testing.assert_allclose(moved.rate[0], 0.7 * ratio, atol=1e-11)
    alone = msgspec.structs.replace(scene, sampling=(Pose((names[4],), (0.1, 0.1)),))
    with pytest.raises(SceneError, match=f"{names[4]!r} follows {names[0]!r}; draw that one alone"):
        draw_batch(alone, [0])


def test_poses_of_a_range_are_drawn_anew_for_each_joint_and_trajectory() -> None:
    tree = random_tree(np.random.default_rng(1), ["hinge", "slider"])
    names = tuple(joint.name for joint in tree.joints)
    scene = msgspec.structs.replace(tree, sampling=(Pose(names, (0.2, 0.5)),))

    mechanism = Mechanism.of(scene)
    links = to_links(mechanism, BodyStates.of(mechanism, draw_batch(scene, range(20))))
    drawn = links.coordinate.ravel()
    assert len(np.unique(drawn)) == 40
    assert ((drawn >= 0.2 - 1e-12) & (drawn <= 0.5 + 1e-12)).all()
    assert drawn.min() < 0.26
    assert drawn.max() > 0.44


@pytest.mark.parametrize("term", [Pose, HingeRate])
def test_a_joint_that_closes_a_loop_cannot_be_led(term: type[Pose] | type[HingeRate]) -> None:
    (scene,) = (case.scene for case in CASES if case.name == "parallelogram")
    (loop,) = Mechanism.of(scene).loops

    with pytest.raises(SceneError, match="closes a loop"):
        draw_batch(msgspec.structs.replace(scene, sampling=(term((loop.name,), (0, 1)),)), [0])


def test_a_chain_starts_the_same_whatever_is_drawn_beside_it() -> None:
    """Starts agree in every bit, although swinging chains are drawn all at once."""
    scene = load_scene("6pendulum")
    many = draw_batch(scene, range(7), seed=3)

    for row in range(7):
        alone = draw_batch(scene, [row], seed=3)
        for one, several in zip(vars(alone).values(), vars(many).values(), strict=True):
            assert np.array_equal(one[0], several[row])


@pytest.mark.parametrize("length", [1e-300, 1e-170, 1e170, 1e300])
def test_a_turn_may_have_an_axis_of_any_length(length: float) -> None:
    scene = random_tree(np.random.default_rng(3), ["free"])
    axes = [(k, 2.0 * k, -0.5 * k) for k in (1.0, length)]
    turns = [Turn((0.0, 0.0, 0.0), axis, angle=(1.0, 1.0), rate=(2.0, 2.0)) for axis in axes]
    one, other = (draw_batch(msgspec.structs.replace(scene, sampling=(t,)), [0]) for t in turns)
    for key in STATES:
        np.testing.assert_allclose(getattr(other, key), getattr(one, key), rtol=0, atol=1e-14)

"""Models that are written and read again, for the tests of every format."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import WORLD, Body, Inertia, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import read_model, write_model
from tests.random_scenes import Kind

SUFFIX = {"mjcf": ".xml", "urdf": ".urdf", "sdf": ".sdf", "usda": ".usda"}
FORMATS = sorted(SUFFIX)
KINDS: list[Kind] = ["hinge", "slider", "ball", "free"]
SINGLE = 2e-6  # tolerance of numbers up to 10 in single precision, some of them differences
TREES = st.lists(st.sampled_from(KINDS), min_size=1, max_size=5)
"""Kinds of the joints of a tree."""
SEEDS = st.integers(0, 2**32 - 1)


def again(scene: Scene, kind: str, here: Path) -> Scene:
    path = here / f"again{SUFFIX[kind]}"
    written = write_model(scene, kind)
    path.write_text(written.text)
    return _named_as_before(read_model(path).scene, written.fates)


def _named_as_before(scene: Scene, fates: tuple[Fate, ...]) -> Scene:
    """Restore the names that the report says things had."""
    renames = [(fate.element, *place.split(" is ")) for fate in fates for place in fate.places
               if fate.properties == ("name",)]  # fmt: skip
    if not renames:
        return scene
    had = {(table, name): before for table, before, name in renames}

    def body(name: str) -> str:
        return had.get(("bodies", name), name)

    def joint(name: str) -> str:
        return had.get(("joints", name), name)

    new = msgspec.structs.replace
    return new(
        scene,
        sampling=(),
        bodies=tuple(new(each, name=body(each.name)) for each in scene.bodies),
        joints=tuple(
            new(each, name=joint(each.name), parent=body(each.parent), child=body(each.child))
            for each in scene.joints
        ),
        servos=tuple(new(each, joint=joint(each.joint)) for each in scene.servos),
    )


def same(first: Scene, second: Scene, near: float = 1e-11) -> None:
    """Compare masses, places and joints, body by body and joint by joint."""
    ours, theirs = Mechanism.of(first), Mechanism.of(second)
    order = [[body.name for body in second.bodies].index(body.name) for body in first.bodies]
    np.testing.assert_allclose(theirs.mass[order], ours.mass, rtol=near)
    np.testing.assert_allclose(theirs.com[order], ours.com, atol=near)
    np.testing.assert_allclose(theirs.inertia[order], ours.inertia, atol=near)
    tree = {link.joint.name: link.joint for link in theirs.links if link.joint is not None}
    loops = {joint.name: joint for joint in theirs.loops}
    for joint in [link.joint for link in ours.links if link.joint is not None] + [*ours.loops]:
        again = (tree | loops)[joint.name]
        ends = {again.child: again.in_child, again.parent: again.in_parent}
        for body, place in ((joint.child, joint.in_child), (joint.parent, joint.in_parent)):
            own = order[body] if body >= 0 else body
            np.testing.assert_allclose(ends[own], place, atol=near)
        turn = 1 if again.child == (order[joint.child] if joint.child >= 0 else -1) else -1
        apart = np.cross(again.axis, joint.axis)
        np.testing.assert_allclose(apart, 0, atol=near)
        keys = ("damping", "stiffness", "rest", "armature", "friction")
        assert again.limits == pytest.approx(joint.limits, abs=near)
        laws = [[getattr(j, key) for key in keys] for j in (joint, again)]
        assert laws[0] == pytest.approx(laws[1], abs=near)
        assert joint.name in loops or turn * again.axis @ joint.axis >= 0
    assert len(tree) + len(loops) == len(ours.joints)
    mine, others = (sorted(scene.servos, key=lambda s: s.joint) for scene in (first, second))
    for servo, other in zip(mine, others, strict=True):
        assert other.joint == servo.joint
        assert (other.limit or 0) == pytest.approx(servo.limit or 0, rel=near)
        for key in ("stiffness", "damping", "position", "velocity"):
            assert getattr(other, key) == pytest.approx(getattr(servo, key), abs=near)
    assert second.couplings == first.couplings


def coupled(scene: Scene) -> Scene:
    """Let the last hinge or slider follow the first, if there are two."""
    names = [joint.name for joint in scene.joints if joint.kind in ("hinge", "slider")]
    couplings = (Coupling(names[-1], names[0], -1.5, 0.25),) if len(names) > 1 else ()
    return msgspec.structs.replace(scene, couplings=couplings)


def closes(scene: Scene) -> bool:
    """Return whether links can be closed with the freedom that a coupling leaves."""
    try:
        assemble(Mechanism.of(scene))
    except SceneError:
        return False
    return True


def with_law(scene: Scene, law: dict[str, object]) -> Scene:
    """Give all hinges and sliders the same properties."""
    joints = (
        msgspec.structs.replace(joint, **law) if joint.kind in ("hinge", "slider") else joint
        for joint in scene.joints
    )
    return msgspec.structs.replace(scene, joints=tuple(joints))


def sprung_arm(stiffness: float, *servos: Servo) -> Scene:
    body = Body("rod", inertia=Inertia(2.0, (1.0, 1.0, 0.5)))
    joint = Joint("hip", "hinge", WORLD, "rod", (0, 0, 1), (0, 1, 0), stiffness=stiffness)
    joint = msgspec.structs.replace(joint, rest=0.1, damping=0.3)
    return Scene("arm", (body,), 1.0, joints=(joint,), servos=servos)

"""A scene that is written as a model and read again is the same mechanism."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import WORLD, Scene, SpringDamper
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import load_scene, read_model, write_model
from mbds_xsim.testing import CASES
from tests.command_line import CommandLine
from tests.random_scenes import Kind, random_tree

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("in_process")

_SUFFIX = {"mjcf": ".xml", "urdf": ".urdf"}
_MJCF_KINDS: list[Kind] = ["hinge", "slider", "ball", "free"]


def _again(scene: Scene, kind: str, here: Path) -> Scene:
    path = here / f"again{_SUFFIX[kind]}"
    path.write_text(write_model(scene, kind).text)
    return read_model(path).scene


def _same(first: Scene, second: Scene) -> None:
    """Compare masses, places and joints, body by body and joint by joint."""
    ours, theirs = Mechanism.of(first), Mechanism.of(second)
    order = [[body.name for body in second.bodies].index(body.name) for body in first.bodies]
    np.testing.assert_allclose(theirs.mass[order], ours.mass, rtol=1e-12)
    np.testing.assert_allclose(theirs.com[order], ours.com, atol=1e-12)
    np.testing.assert_allclose(theirs.inertia[order], ours.inertia, atol=1e-11)
    held = {link.joint.name: link.joint for link in theirs.links if link.joint is not None}
    loops = {joint.name: joint for joint in theirs.loops}
    for joint in [link.joint for link in ours.links if link.joint is not None] + [*ours.loops]:
        again = (held | loops)[joint.name]
        ends = {again.child: again.in_child, again.parent: again.in_parent}
        for body, place in ((joint.child, joint.in_child), (joint.parent, joint.in_parent)):
            own = order[body] if body >= 0 else body
            np.testing.assert_allclose(ends[own], place, atol=1e-11)
        turn = 1 if again.child == (order[joint.child] if joint.child >= 0 else -1) else -1
        apart = np.cross(again.axis, joint.axis)
        np.testing.assert_allclose(apart, 0, atol=1e-11)
        keys = ("damping", "stiffness", "rest", "armature", "friction")
        assert again.limits == pytest.approx(joint.limits, abs=1e-12)
        laws = [[getattr(j, key) for key in keys] for j in (joint, again)]
        assert laws[0] == pytest.approx(laws[1], abs=1e-12)
        assert joint.name in loops or turn * again.axis @ joint.axis >= 0
    assert len(held) + len(loops) == len(ours.joints)
    for servo, other in zip(first.servos, second.servos, strict=True):
        assert (other.joint, other.damping) == (servo.joint, servo.damping)
        assert other.limit == servo.limit
        assert other.position == pytest.approx(servo.position, abs=1e-12)
    assert second.couplings == first.couplings


def _coupled(scene: Scene) -> Scene:
    """Let the last hinge or slider follow the first, if there are two."""
    names = [joint.name for joint in scene.joints if joint.kind in ("hinge", "slider")]
    couplings = (Coupling(names[-1], names[0], -1.5, 0.25),) if len(names) > 1 else ()
    return msgspec.structs.replace(scene, couplings=couplings)


def _closes(scene: Scene) -> bool:
    """Whether a link can be closed with what a coupling leaves free."""
    try:
        assemble(Mechanism.of(scene))
    except SceneError:
        return False
    return True


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.sampled_from(_MJCF_KINDS), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
    st.integers(0, 1),
)
def test_any_tree_comes_back_from_mjcf(
    tmp_path: Path, kinds: list[Kind], seed: int, links: int
) -> None:
    rng = np.random.default_rng(seed)
    scene = random_tree(rng, kinds, links=links)
    points = tuple(map(tuple, rng.standard_normal((2, 3)).tolist()))
    spring = SpringDamper("coil", (WORLD, scene.bodies[0].name), points, 30.0, 0.5, 0.7)  # type: ignore[arg-type]
    joints = tuple(
        msgspec.structs.replace(
            joint,
            damping=0.3,
            stiffness=2.0,
            rest=0.1,
            armature=0.2,
            friction=0.4,
            limits=(-1.5, 2.0),
        )
        if joint.kind in ("hinge", "slider")
        else joint
        for joint in scene.joints
    )
    led = [joint.name for joint in joints if joint.kind in ("hinge", "slider")]
    servos = tuple(
        Servo(name, (0.4,), (0.0,), 9.0, 0.7, limit=None if k % 2 else 1.5)
        for k, name in enumerate(led)
    )
    gravity = (1.0, 2.0, -3.0)
    scene = msgspec.structs.replace(
        scene, springs=(spring,), gravity=gravity, joints=joints, servos=servos
    )
    scene = _coupled(scene)
    assume(_closes(scene))

    again = _again(scene, "mjcf", tmp_path)

    _same(scene, again)
    assert again.gravity == scene.gravity
    (coil,) = Mechanism.of(again).springs
    own = dict(zip(coil.bodies, coil.in_body, strict=True))
    np.testing.assert_allclose(own[-1], points[0], atol=1e-12)
    assert (coil.stiffness, coil.damping, coil.length) == (30.0, 0.5, 0.7)
    assert len(again.distance_links) == len(scene.distance_links)


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.sampled_from(["hinge", "slider"]), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
)
def test_any_tree_of_hinges_and_sliders_comes_back_from_urdf(
    tmp_path: Path, kinds: list[Kind], seed: int
) -> None:
    scene = _coupled(random_tree(np.random.default_rng(seed), kinds))
    law = {"damping": 0.3, "friction": 0.4, "limits": (-1.5, 2.0)}
    joints = (msgspec.structs.replace(each, **law) for each in scene.joints)
    scene = msgspec.structs.replace(scene, joints=tuple(joints))

    _same(scene, _again(scene, "urdf", tmp_path))


@pytest.mark.parametrize("name", ["bricard", "andrews", "2ladder"])
def test_a_scene_with_loops_comes_back_with_its_freedom(name: str, here: Path) -> None:
    scene = load_scene(name)

    again = _again(scene, "mjcf", here)

    _same(scene, again)
    assert degrees_of_freedom(Mechanism.of(again)) == degrees_of_freedom(Mechanism.of(scene))


def test_what_a_format_has_no_place_for_is_named_or_refused(run: CommandLine, here: Path) -> None:
    ended = run("export-model", "3pendulum", "--out", "p.xml", "--json", "p.json")
    assert ended.code == 0
    assert "sampling" in ended.out
    assert '"noise"' not in run("show", "p.xml", "--toml").out

    assert "is a ball joint" in run(
        "export-model", "3pendulum", "--format", "urdf", "--out", "p.urdf"
    ).refusal  # fmt: skip
    assert not (here / "p.urdf").exists()
    assert "there are: mjcf, urdf" in run(
        "export-model", "3pendulum", "--format", "step", "--out", "p.step"
    ).refusal  # fmt: skip


def test_losses_of_an_export_are_those_of_the_scene() -> None:
    parallelogram = next(case.scene for case in CASES if case.name == "parallelogram")
    told = {fate.element for fate in write_model(parallelogram, "urdf").fates}
    assert "joints" in told
    led = next(case.scene for case in CASES if case.name == "servo")
    assert {f.element for f in write_model(led, "urdf").fates} >= {"servos"}
    assert "servos" in {f.element for f in write_model(led, "mjcf").fates}
    assert {f.element for f in write_model(load_scene("balldrop"), "urdf").fates} >= {"contacts"}

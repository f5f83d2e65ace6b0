"""A scene that is written as a model and read again is the same mechanism."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import WORLD, Body, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene, write_model
from mbds_xsim.testing import CASES
from mbds_xsim.testing.collision_cases import TWO, balls
from tests.command_line import CommandLine
from tests.models.writing import (
    FORMATS,
    KINDS,
    SEEDS,
    SINGLE,
    TREES,
    again,
    closes,
    coupled,
    same,
    sprung_arm,
    with_law,
)
from tests.random_scenes import Kind, random_tree

for _reader in ("mujoco", "dartpy", "pxr"):
    pytest.importorskip(_reader)
pytestmark = pytest.mark.usefixtures("in_process")


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(TREES, SEEDS, st.integers(0, 1))
def test_any_tree_comes_back_from_mjcf(
    tmp_path: Path, kinds: list[Kind], seed: int, links: int
) -> None:
    rng = np.random.default_rng(seed)
    scene = random_tree(rng, kinds, links=links)
    points = tuple(map(tuple, rng.standard_normal((2, 3)).tolist()))
    spring = SpringDamper("coil", (WORLD, scene.bodies[0].name), points, 30.0, 0.5, 0.7)  # type: ignore[arg-type]
    law = {"damping": 0.3, "stiffness": 2.0, "rest": 0.1, "friction": 0.4, "limits": (-1.5, 2.0)}
    scene = with_law(scene, law | {"armature": 0.2})
    led = [joint.name for joint in scene.joints if joint.kind in ("hinge", "slider")]
    servos = tuple(
        Servo(name, (0.4,), (0.0,), 9.0, 0.7, limit=None if k % 2 else 1.5)
        for k, name in enumerate(led)
    )
    gravity = (1.0, 2.0, -3.0)
    scene = msgspec.structs.replace(scene, springs=(spring,), gravity=gravity, servos=servos)
    scene = coupled(scene)
    assume(closes(scene))

    back = again(scene, "mjcf", tmp_path)

    same(scene, back)
    assert back.gravity == scene.gravity
    (coil,) = Mechanism.of(back).springs
    own = dict(zip(coil.bodies, coil.in_body, strict=True))
    np.testing.assert_allclose(own[-1], points[0], atol=1e-12)
    assert (coil.stiffness, coil.damping, coil.length) == (30.0, 0.5, 0.7)
    assert len(back.distance_links) == len(scene.distance_links)


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from(["hinge", "slider"]), min_size=1, max_size=5), SEEDS)
def test_any_tree_of_hinges_and_sliders_comes_back_from_urdf(
    tmp_path: Path, kinds: list[Kind], seed: int
) -> None:
    scene = coupled(random_tree(np.random.default_rng(seed), kinds))
    scene = with_law(scene, {"damping": 0.3, "friction": 0.4, "limits": (-1.5, 2.0)})

    same(scene, again(scene, "urdf", tmp_path))


def test_a_free_body_of_a_urdf_has_a_joint_of_its_own_name(here: Path) -> None:
    arm = sprung_arm(0.0)
    hip = msgspec.structs.replace(arm.joints[0], name="a floats", rest=0.0)
    a = msgspec.structs.replace(arm.bodies[0], name="a")
    scene = msgspec.structs.replace(arm, bodies=(*arm.bodies, a), joints=(hip,))

    assert 'joint name="a floats_"' in write_model(scene, "urdf").text
    same(scene, again(scene, "urdf", here))


@settings(deadline=None, max_examples=30, suppress_health_check=list(HealthCheck))
@given(TREES, SEEDS)
def test_any_tree_comes_back_from_sdf(tmp_path: Path, kinds: list[Kind], seed: int) -> None:
    law = {"damping": 0.3, "stiffness": 2.0, "rest": 0.1, "friction": 0.4, "limits": (-1.5, 2.0)}
    scene = with_law(random_tree(np.random.default_rng(seed), kinds), law)
    scene = msgspec.structs.replace(scene, gravity=(1.0, 2.0, -3.0))

    back = again(scene, "sdf", tmp_path)

    same(scene, back)
    assert back.gravity == scene.gravity


@pytest.mark.parametrize("kind", ["mjcf", "usda"])
@pytest.mark.parametrize("name", ["bricard", "andrews", "2ladder"])
def test_a_scene_with_loops_comes_back_with_its_freedom(name: str, kind: str, here: Path) -> None:
    scene = load_scene(name)

    back = again(scene, kind, here)

    same(scene, back, SINGLE if kind == "usda" else 1e-11)
    assert degrees_of_freedom(Mechanism.of(back)) == degrees_of_freedom(Mechanism.of(scene))


def test_a_fixed_joint_that_closes_a_loop_is_a_weld_in_mjcf(here: Path) -> None:
    scene = next(case.scene for case in CASES if case.name == "divided shaft")
    scene = msgspec.structs.replace(scene, torques=())

    assert write_model(scene, "mjcf").text.count("<weld ") == 1
    back = again(scene, "mjcf", here)

    same(scene, back)
    assert [joint.kind for joint in Mechanism.of(back).loops] == ["fixed"]


def test_what_a_format_has_no_place_for_is_named_or_refused(run: CommandLine, here: Path) -> None:
    ended = run("export-model", "3pendulum", "--out", "p.xml", "--json", "p.json")
    assert ended.code == 0
    assert "sampling" in ended.out
    assert '"noise"' not in run("show", "p.xml", "--toml").out

    assert "is a ball joint" in run(
        "export-model", "3pendulum", "--format", "urdf", "--out", "p.urdf"
    ).refusal  # fmt: skip
    assert not (here / "p.urdf").exists()
    assert "got p.usda for the format mjcf; add --format usda" in run(
        "export-model", "3pendulum", "--out", "p.usda"
    ).refusal  # fmt: skip
    assert "there are: mjcf, sdf, urdf, usda" in run(
        "export-model", "3pendulum", "--format", "step", "--out", "p.step"
    ).refusal  # fmt: skip


def test_losses_of_an_export_are_those_of_the_scene() -> None:
    parallelogram = next(case.scene for case in CASES if case.name == "parallelogram")
    elements = {fate.element for fate in write_model(parallelogram, "urdf").fates}
    assert "joints" in elements
    led = next(case.scene for case in CASES if case.name == "servo")
    assert {f.element for f in write_model(led, "urdf").fates} >= {"servos"}
    assert "servos" in {f.element for f in write_model(led, "mjcf").fates}
    assert {f.element for f in write_model(load_scene("balldrop"), "urdf").fates} >= {"contacts"}
    elements = {fate.element for fate in write_model(balls(TWO["head on"]), "sdf").fates}
    assert elements >= {"contacts", "collisions"}


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", PAPER_SCENES)
def test_every_scene_comes_back_or_the_report_says_what_does_not(
    name: str, kind: str, here: Path
) -> None:
    scene = load_scene(name)
    if kind == "urdf" and any(joint.kind == "ball" for joint in scene.joints):
        with pytest.raises(InputError, match="is a ball joint; URDF is a tree"):
            write_model(scene, kind)
        return

    back = Mechanism.of(again(scene, kind, here))

    ours = Mechanism.of(scene)
    near = SINGLE if kind == "usda" else 1e-11
    order = [[body.name for body in back.scene.bodies].index(body.name) for body in scene.bodies]
    np.testing.assert_allclose(back.mass[order], ours.mass, rtol=near)
    np.testing.assert_allclose(back.com[order], ours.com, atol=near)
    np.testing.assert_allclose(back.inertia[order], ours.inertia, atol=near)
    lost = {fate.element: fate for fate in write_model(scene, kind).fates if _is_lost(fate)}
    missing = lost["joints"].count if "joints" in lost else 0
    assert len(back.joints) == len(ours.joints) - missing
    assert degrees_of_freedom(back) == degrees_of_freedom(ours) + 3 * missing  # ball joints


def _is_lost(fate: Fate) -> bool:
    return fate.outcome == "dropped" and fate.moves and not fate.properties


@pytest.mark.parametrize("kind", FORMATS)
def test_what_is_fixed_to_a_body_is_one_with_it(kind: str, here: Path) -> None:
    arm = sprung_arm(0.0)
    tip = Body("tip", inertia=Inertia(1.0, (1.0, 1.0, 0.5)), position=(0.3, 0, 0))
    weld = Joint("weld", "fixed", "rod", "tip", (0.1, 0, 0))
    scene = msgspec.structs.replace(arm, bodies=(*arm.bodies, tip), joints=(*arm.joints, weld))

    back = Mechanism.of(again(scene, kind, here))

    assert back.mass == pytest.approx([3.0])
    np.testing.assert_allclose(back.com, [[0.1, 0, 0]], atol=SINGLE)
    across = 2.0 + 2.0 * 0.1**2 + 1.0 * 0.2**2
    np.testing.assert_allclose(back.inertia[0], np.diag([2.0, across, across - 1.0]), atol=SINGLE)
    assert degrees_of_freedom(back) == 1


def test_losses_of_mjcf_are_named_or_refused() -> None:
    """MJCF lacks rebounds, and springs and servos of joints that close loops."""
    bodies = tuple(Body(n, inertia=Inertia(1.0, (1.0, 1.0, 1.0))) for n in ("a", "b"))
    ends = ((WORLD, "a"), ("a", "b"), ("b", WORLD))
    joints = tuple(
        Joint(f"h{k}", "hinge", parent, child, (0, 0, 1), (0, 1, 0), stiffness=3.0)
        for k, (parent, child) in enumerate(ends)
    )
    scene = Scene("loop", bodies, 1.0, joints=joints, servos=(Servo("h2", stiffness=4.0),))
    losses = {(f.element, f.properties) for f in write_model(scene, "mjcf").fates}
    assert {("joints", ("stiffness", "damping")), ("servos", ())} <= losses
    assert 'joint="h2"' not in write_model(scene, "mjcf").text

    limits = msgspec.structs.replace(joints[0], limits=(-1.0, 1.0), restitution=0.5)
    bouncing = msgspec.structs.replace(scene, joints=(limits, joints[1]), servos=())
    assert ("joints", ("restitution",)) in {
        (f.element, f.properties) for f in write_model(bouncing, "mjcf").fates
    }
    slides = tuple(msgspec.structs.replace(j, kind="slider") for j in joints)
    with pytest.raises(InputError, match="a slider that closes a loop"):
        write_model(msgspec.structs.replace(scene, joints=slides, servos=()), "mjcf")


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, module, extra in (("usda", "pxr.UsdPhysics", "usd"), ("mjcf", "mujoco", "mujoco")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(InputError, match=rf"needs {module}.*mbds-xsim\[{extra}\]"):
            write_model(load_scene("3pendulum"), kind)


def test_drake_reads_the_same_sdf(here: Path) -> None:
    """Drake's reader is that of the format's own library."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    law = {"damping": 0.3, "limits": (-1.5, 2.0)}
    scene = with_law(random_tree(np.random.default_rng(3), [*KINDS, "hinge"]), law)
    (here / "tree.sdf").write_text(write_model(scene, "sdf").text)
    plant = MultibodyPlant(1e-3)
    Parser(plant).AddModels(here / "tree.sdf")
    plant.Finalize()
    context, ours = plant.CreateDefaultContext(), Mechanism.of(scene)

    for k, body in enumerate(scene.bodies):
        read = plant.GetBodyByName(body.name)
        inertia = read.CalcSpatialInertiaInBodyFrame(context)
        assert inertia.get_mass() == pytest.approx(ours.mass[k], rel=1e-12)
        moments = inertia.CalcRotationalInertia().CopyToFullMatrix3()
        np.testing.assert_allclose(moments, ours.inertia[k], atol=1e-11)
        place = plant.EvalBodyPoseInWorld(context, read).translation()
        np.testing.assert_allclose(place, ours.com[k], atol=1e-12)
    assert plant.num_velocities() == degrees_of_freedom(ours)
    for link in ours.links:
        if link.joint is not None and link.joint.kind in ("hinge", "slider"):
            read = plant.GetJointByName(link.joint.name)
            assert read.position_lower_limits()[0] == pytest.approx(-1.5)
            assert read.default_damping() == pytest.approx(0.3)


def test_a_flat_body_turned_in_its_frame_comes_back_from_mjcf(here: Path) -> None:
    turned = (0.7440626156639037, 1.5100583687462041, -0.33238221357657016)
    flat = Inertia(1.0, (5.912131057923787, 3.235213578491161, 5.018128761055044), turned)
    hinge = Joint("pivot", "hinge", WORLD, "plate", (0, 0, 1), (0, 1, 0))
    scene = Scene("plate", (Body("plate", inertia=flat),), length=1.0, joints=(hinge,))

    same(scene, again(scene, "mjcf", here))

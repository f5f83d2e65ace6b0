"""A scene that is written as a model and read again is the same mechanism."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError, SceneError
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import WORLD, Body, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import PAPER_SCENES, load_scene, read_model, write_model
from mbds_xsim.testing import CASES
from tests.command_line import CommandLine
from tests.random_scenes import Kind, random_tree

for _reader in ("mujoco", "dartpy", "pxr"):
    pytest.importorskip(_reader)
pytestmark = pytest.mark.usefixtures("in_process")

_SUFFIX = {"mjcf": ".xml", "urdf": ".urdf", "sdf": ".sdf", "usda": ".usda"}
_FORMATS = sorted(_SUFFIX)
_KINDS: list[Kind] = ["hinge", "slider", "ball", "free"]
_SINGLE = 2e-6  # of numbers up to 10 in single precision, some of them differences


def _again(scene: Scene, kind: str, here: Path) -> Scene:
    path = here / f"again{_SUFFIX[kind]}"
    written = write_model(scene, kind)
    path.write_text(written.text)
    return _named_as_before(read_model(path).scene, written.fates)


def _named_as_before(scene: Scene, fates: tuple[Fate, ...]) -> Scene:
    """Give things the names that the report says they had."""
    told = [(fate.element, *place.split(" is ")) for fate in fates for place in fate.places
            if fate.properties == ("name",)]  # fmt: skip
    if not told:
        return scene
    had = {(table, name): before for table, before, name in told}

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


def _same(first: Scene, second: Scene, near: float = 1e-11) -> None:
    """Compare masses, places and joints, body by body and joint by joint."""
    ours, theirs = Mechanism.of(first), Mechanism.of(second)
    order = [[body.name for body in second.bodies].index(body.name) for body in first.bodies]
    np.testing.assert_allclose(theirs.mass[order], ours.mass, rtol=near)
    np.testing.assert_allclose(theirs.com[order], ours.com, atol=near)
    np.testing.assert_allclose(theirs.inertia[order], ours.inertia, atol=near)
    held = {link.joint.name: link.joint for link in theirs.links if link.joint is not None}
    loops = {joint.name: joint for joint in theirs.loops}
    for joint in [link.joint for link in ours.links if link.joint is not None] + [*ours.loops]:
        again = (held | loops)[joint.name]
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
    assert len(held) + len(loops) == len(ours.joints)
    mine, others = (sorted(scene.servos, key=lambda s: s.joint) for scene in (first, second))
    for servo, other in zip(mine, others, strict=True):
        assert other.joint == servo.joint
        assert (other.limit or 0) == pytest.approx(servo.limit or 0, rel=near)
        for key in ("stiffness", "damping", "position", "velocity"):
            assert getattr(other, key) == pytest.approx(getattr(servo, key), abs=near)
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
    st.lists(st.sampled_from(_KINDS), min_size=1, max_size=5),
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


@settings(deadline=None, max_examples=30, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from(_KINDS), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_any_tree_comes_back_from_sdf(tmp_path: Path, kinds: list[Kind], seed: int) -> None:
    law = {"damping": 0.3, "stiffness": 2.0, "rest": 0.1, "friction": 0.4, "limits": (-1.5, 2.0)}
    scene = _with_law(random_tree(np.random.default_rng(seed), kinds), law)
    scene = msgspec.structs.replace(scene, gravity=(1.0, 2.0, -3.0))

    again = _again(scene, "sdf", tmp_path)

    _same(scene, again)
    assert again.gravity == scene.gravity


@settings(deadline=None, max_examples=30, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.sampled_from(_KINDS), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
    st.integers(0, 1),
)
def test_any_mechanism_comes_back_from_usd(
    tmp_path: Path, kinds: list[Kind], seed: int, links: int
) -> None:
    """To single precision; springs and dampers of joints as servos that exert the same."""
    scene = random_tree(np.random.default_rng(seed), kinds, links=links)
    scene = msgspec.structs.replace(scene, gravity=(1.0, 2.0, -3.0))
    limited = _with_law(scene, {"limits": (-1.5, 2.0)})
    sprung = _with_law(limited, {"damping": 0.3, "stiffness": 2.0, "rest": 0.1})
    assume(_closes(scene))

    again = _again(sprung, "usda", tmp_path)

    servos = tuple(
        Servo(joint.name, (0.1,), (0.0,), 2.0, 0.3) for joint in limited.joints if joint.limits
    )
    _same(msgspec.structs.replace(limited, servos=servos), again, _SINGLE)
    assert again.gravity == pytest.approx(scene.gravity, abs=_SINGLE)
    lengths = [
        sorted(pair.length for pair in Mechanism.of(each).distances) for each in (scene, again)
    ]
    assert lengths[1] == pytest.approx(lengths[0], abs=_SINGLE)
    assert degrees_of_freedom(Mechanism.of(again)) == degrees_of_freedom(Mechanism.of(scene))


def _with_law(scene: Scene, law: dict[str, object]) -> Scene:
    """Give all hinges and sliders the same properties."""
    joints = (
        msgspec.structs.replace(joint, **law) if joint.kind in ("hinge", "slider") else joint
        for joint in scene.joints
    )
    return msgspec.structs.replace(scene, joints=tuple(joints))


@pytest.mark.parametrize("kind", ["mjcf", "usda"])
@pytest.mark.parametrize("name", ["bricard", "andrews", "2ladder"])
def test_a_scene_with_loops_comes_back_with_its_freedom(name: str, kind: str, here: Path) -> None:
    scene = load_scene(name)

    again = _again(scene, kind, here)

    _same(scene, again, _SINGLE if kind == "usda" else 1e-11)
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
    assert "there are: mjcf, sdf, urdf, usda" in run(
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


@pytest.mark.parametrize("kind", _FORMATS)
@pytest.mark.parametrize("name", PAPER_SCENES)
def test_every_scene_comes_back_or_the_report_says_what_does_not(
    name: str, kind: str, here: Path
) -> None:
    scene = load_scene(name)
    if kind == "urdf" and any(joint.kind == "ball" for joint in scene.joints):
        with pytest.raises(InputError, match="is a ball joint; URDF is a tree"):
            write_model(scene, kind)
        return

    again = Mechanism.of(_again(scene, kind, here))

    ours = Mechanism.of(scene)
    near = _SINGLE if kind == "usda" else 1e-11
    order = [[body.name for body in again.scene.bodies].index(body.name) for body in scene.bodies]
    np.testing.assert_allclose(again.mass[order], ours.mass, rtol=near)
    np.testing.assert_allclose(again.com[order], ours.com, atol=near)
    np.testing.assert_allclose(again.inertia[order], ours.inertia, atol=near)
    lost = {fate.element: fate for fate in write_model(scene, kind).fates if _is_lost(fate)}
    opened = lost["joints"].count if "joints" in lost else 0
    assert len(again.joints) == len(ours.joints) - opened
    assert degrees_of_freedom(again) == degrees_of_freedom(ours) + 3 * opened  # ball joints


def _is_lost(fate: Fate) -> bool:
    return fate.outcome == "dropped" and fate.moves and not fate.properties


@pytest.mark.parametrize("kind", _FORMATS)
def test_what_is_fixed_to_a_body_is_one_with_it(kind: str, here: Path) -> None:
    arm = _arm(0.0)
    tip = Body("tip", inertia=Inertia(1.0, (1.0, 1.0, 0.5)), position=(0.3, 0, 0))
    weld = Joint("weld", "fixed", "rod", "tip", (0.1, 0, 0))
    scene = msgspec.structs.replace(arm, bodies=(*arm.bodies, tip), joints=(*arm.joints, weld))

    again = Mechanism.of(_again(scene, kind, here))

    assert again.mass == pytest.approx([3.0])
    np.testing.assert_allclose(again.com, [[0.1, 0, 0]], atol=_SINGLE)
    across = 2.0 + 2.0 * 0.1**2 + 1.0 * 0.2**2
    np.testing.assert_allclose(again.inertia[0], np.diag([2.0, across, across - 1.0]), atol=_SINGLE)
    assert degrees_of_freedom(again) == 1


def test_a_flat_body_is_one_in_single_precision(here: Path) -> None:
    """Its largest moment is the sum of the others, which rounding must not make it exceed."""
    rng = np.random.default_rng(8)
    bodies = tuple(
        Body(f"plate{k}", inertia=Inertia(1.0, (a, b, a + b)))
        for k, (a, b) in enumerate(rng.uniform(0.1, 3.0, (40, 2)).tolist())
    )
    path = here / "plates.usda"
    path.write_text(write_model(Scene("plates", bodies, 1.0), "usda").text)

    assert not [fate for fate in read_model(path).fates if fate.outcome == "approximated"]


def test_a_body_too_light_for_single_precision_is_refused() -> None:
    speck = Body("speck", inertia=Inertia(1e-20, (1e-50, 1e-50, 1e-50)))
    with pytest.raises(InputError, match=r"'speck' has a moment .* takes 1.2e-38 or more"):
        write_model(Scene("dust", (speck,), 1.0), "usda")


def _arm(stiffness: float, *servos: Servo) -> Scene:
    body = Body("rod", inertia=Inertia(2.0, (1.0, 1.0, 0.5)))
    joint = Joint("hip", "hinge", WORLD, "rod", (0, 0, 1), (0, 1, 0), stiffness=stiffness)
    joint = msgspec.structs.replace(joint, rest=0.1, damping=0.3)
    return Scene("arm", (body,), 1.0, joints=(joint,), servos=servos)


def test_the_drive_of_usd_exerts_what_spring_and_servos_do(here: Path) -> None:
    scene = _arm(2.0, Servo("hip", (0.4, 1.0), (0.2,), 9.0, 0.7))

    (servo,) = _again(scene, "usda", here).servos

    assert (servo.stiffness, servo.damping) == pytest.approx((11.0, 1.0), rel=_SINGLE)
    assert servo.position == pytest.approx([(2 * 0.1 + 9 * 0.4) / 11], rel=_SINGLE)
    assert servo.velocity == pytest.approx([0.7 * 0.2 / 1.0], rel=_SINGLE)
    told = {fate.properties for fate in write_model(scene, "usda").fates}
    assert {("series",), ("stiffness", "damping", "rest")} <= told


def test_a_servo_with_a_limit_has_the_drive_of_usd_alone(here: Path) -> None:
    scene = _arm(2.0, Servo("hip", (0.4,), stiffness=9.0, limit=1.5))

    (servo,) = _again(scene, "usda", here).servos

    assert (servo.stiffness, servo.limit) == pytest.approx((9.0, 1.5), rel=_SINGLE)
    assert ("dropped", ("drives",)) in {
        (fate.outcome, fate.properties) for fate in write_model(scene, "usda").fates
    }


def test_a_joint_that_closes_no_loop_keeps_its_limits(here: Path) -> None:
    """The reader of USD cuts the loop where the scene does, not at the joint that it meets last."""
    places = {"a": (0.0, 0.0, 1.0), "b": (1.0, 0.0, 1.0)}
    bodies = tuple(
        Body(name, inertia=Inertia(1.0, (1.0, 1.0, 1.0)), position=place)
        for name, place in places.items()
    )
    joints = (
        Joint("first", "hinge", WORLD, "a", (0, 0, 0), (0, 1, 0)),
        Joint("middle", "hinge", "a", "b", (0.5, 0, 1), (0, 1, 0)),
        Joint("last", "hinge", "b", WORLD, (1, 0, 0), (0, 1, 0), limits=(-0.5, 0.5)),
    )
    scene = Scene("bar", bodies, 1.0, joints=joints)

    _same(scene, _again(scene, "usda", here), _SINGLE)


def test_losses_of_mjcf_are_named_or_refused() -> None:
    """Of rebounds, and of what acts on joints that close loops."""
    bodies = tuple(Body(n, inertia=Inertia(1.0, (1.0, 1.0, 1.0))) for n in ("a", "b"))
    ends = ((WORLD, "a"), ("a", "b"), ("b", WORLD))
    joints = tuple(
        Joint(f"h{k}", "hinge", parent, child, (0, 0, 1), (0, 1, 0), stiffness=3.0)
        for k, (parent, child) in enumerate(ends)
    )
    scene = Scene("loop", bodies, 1.0, joints=joints, servos=(Servo("h2", stiffness=4.0),))
    told = {(f.element, f.properties) for f in write_model(scene, "mjcf").fates}
    assert {("joints", ("stiffness", "damping")), ("servos", ())} <= told
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


def test_the_schema_has_nothing_against_the_stage(here: Path) -> None:
    """All validators that come with OpenUSD, those of physics and of types among them."""
    from pxr import Usd, UsdValidation

    registry = UsdValidation.ValidationRegistry()
    names = [each.name for each in registry.GetAllValidatorMetadata()]
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names))
    for name in ("andrews", "particlecar"):
        path = here / f"{name}.usda"
        path.write_text(write_model(load_scene(name), "usda").text)
        assert not context.Validate(Usd.Stage.Open(str(path)))
    assert {"usdPhysicsValidators:PhysicsJointChecker"} <= set(names)


def test_drake_reads_the_same_sdf(here: Path) -> None:
    """Drake's reader is that of the format's own library."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    law = {"damping": 0.3, "limits": (-1.5, 2.0)}
    scene = _with_law(random_tree(np.random.default_rng(3), [*_KINDS, "hinge"]), law)
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

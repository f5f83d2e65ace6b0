"""A scene written as USD is the same mechanism, in the single precision of the schema."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import WORLD, Body, Inertia, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.simulate.registry import load_scene, read_model, write_model
from tests.models.writing import SEEDS, SINGLE, TREES, again, closes, same, sprung_arm, with_law
from tests.random_scenes import Kind, random_tree

for _reader in ("mujoco", "dartpy", "pxr"):
    pytest.importorskip(_reader)
pytestmark = pytest.mark.usefixtures("in_process")


@settings(deadline=None, max_examples=30, suppress_health_check=list(HealthCheck))
@given(TREES, SEEDS, st.integers(0, 1))
def test_any_mechanism_comes_back_from_usd(
    tmp_path: Path, kinds: list[Kind], seed: int, links: int
) -> None:
    """Trees come back to single precision, springs and dampers as servos that exert the same."""
    scene = random_tree(np.random.default_rng(seed), kinds, links=links)
    scene = msgspec.structs.replace(scene, gravity=(1.0, 2.0, -3.0))
    limited = with_law(scene, {"limits": (-1.5, 2.0)})
    sprung = with_law(limited, {"damping": 0.3, "stiffness": 2.0, "rest": 0.1})
    assume(closes(scene))

    back = again(sprung, "usda", tmp_path)

    servos = tuple(
        Servo(joint.name, (0.1,), (0.0,), 2.0, 0.3) for joint in limited.joints if joint.limits
    )
    same(msgspec.structs.replace(limited, servos=servos), back, SINGLE)
    assert back.gravity == pytest.approx(scene.gravity, abs=SINGLE)
    lengths = [
        sorted(pair.length for pair in Mechanism.of(each).distances) for each in (scene, back)
    ]
    assert lengths[1] == pytest.approx(lengths[0], abs=SINGLE)
    assert degrees_of_freedom(Mechanism.of(back)) == degrees_of_freedom(Mechanism.of(scene))


def test_a_flat_body_is_one_in_single_precision(here: Path) -> None:
    """A plate's largest moment is the sum of the others, and rounding must not raise it."""
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


def test_the_drive_of_usd_exerts_what_spring_and_servos_do(here: Path) -> None:
    scene = sprung_arm(2.0, Servo("hip", (0.4, 1.0), (0.2,), 9.0, 0.7))

    (servo,) = again(scene, "usda", here).servos

    assert (servo.stiffness, servo.damping) == pytest.approx((11.0, 1.0), rel=SINGLE)
    assert servo.position == pytest.approx([(2 * 0.1 + 9 * 0.4) / 11], rel=SINGLE)
    assert servo.velocity == pytest.approx([0.7 * 0.2 / 1.0], rel=SINGLE)
    properties = {fate.properties for fate in write_model(scene, "usda").fates}
    assert {("series",), ("stiffness", "damping", "rest")} <= properties


def test_a_servo_with_a_limit_has_the_drive_of_usd_alone(here: Path) -> None:
    scene = sprung_arm(2.0, Servo("hip", (0.4,), stiffness=9.0, limit=1.5))

    (servo,) = again(scene, "usda", here).servos

    assert (servo.stiffness, servo.limit) == pytest.approx((9.0, 1.5), rel=SINGLE)
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

    same(scene, again(scene, "usda", here), SINGLE)


def test_the_schema_has_nothing_against_the_stage(here: Path) -> None:
    """All validators of OpenUSD pass the stage, those of physics and types among them."""
    from pxr import Usd, UsdValidation

    registry = UsdValidation.ValidationRegistry()
    names = [each.name for each in registry.GetAllValidatorMetadata()]
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names))
    for name in ("andrews", "particlecar"):
        path = here / f"{name}.usda"
        path.write_text(write_model(load_scene(name), "usda").text)
        assert not context.Validate(Usd.Stage.Open(str(path)))
    assert {"usdPhysicsValidators:PhysicsJointChecker"} <= set(names)


def test_a_body_with_the_name_of_its_scene_keeps_it(here: Path) -> None:
    arm = sprung_arm(0.0)
    scene = msgspec.structs.replace(arm, name=arm.bodies[0].name)

    assert [body.name for body in again(scene, "usda", here).bodies] == ["rod"]

"""Names of bodies and joints that MuJoCo and XML are particular about."""

from __future__ import annotations

import msgspec
import pytest

from mbds_xsim.scene.coupling import Coupling
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter
from tests.adapters.exact import gimbal_followed

pytest.importorskip("mujoco")
ENGINE = load_adapter("mujoco")


def failures(scene: Scene, settings: Settings) -> tuple[Failure | None, ...]:
    with ENGINE.open(scene, settings) as run:
        return run.rollout(draw_batch(scene, [0])).failures


def test_a_joint_may_have_an_empty_name() -> None:
    """A motor, a servo and a coupling find it, and so does what reads the model back."""
    bodies = tuple(Body(name, inertia=Inertia(1.0, (1.0, 1.0, 1.0))) for name in "ab")
    joints = tuple(
        Joint(name, "hinge", "world", body, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), damping=0.1)
        for name, body in zip(("", "b"), "ab", strict=True)
    )
    servo, gear = Servo("", (0.3,), stiffness=4.0, limit=9.0), Coupling("b", "", 2.0)
    scene = Scene("names", bodies, 1.0, joints=joints, servos=(servo,), couplings=(gear,))
    scene = msgspec.structs.replace(scene, clock=Clock(0.01, 5))

    batch, settings = draw_batch(scene, [0]), ENGINE.settings(scene, "native")
    with ENGINE.open(scene, settings) as run:
        native = run.readback(batch)
        assert run.rollout(batch).failures == (None,)
    assert readback.compare(Mechanism.of(scene), batch, settings, native) == []


@pytest.mark.parametrize("off", [0.0, 1e-3])
def test_a_hinge_closes_a_loop_of_bodies_whose_centres_hardly_move(off: float) -> None:
    scene = gimbal_followed(ENGINE, off)
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        text = run.native(draw_batch(scene, [0]))
    comment = text[text.index("<!--") + 4 : text.index("-->")]
    assert "'cross- -piece': 0.97" in comment
    assert "--" not in comment


def test_names_that_mujoco_needs() -> None:
    """Two hinges stand for the ball joint of a rod without spin; their names may be taken."""
    rod = Inertia(1.0, (0.02, 0.02, 1e-5), com=(0.0, 0.0, -0.3))
    names, ends = ("p", "p 0", ""), ("world", "p", "p 0", "q")
    places = [(0.0, 0.0, -0.6 * k) for k in range(3)]
    bodies = tuple(
        Body(n, inertia=rod, position=at) for n, at in zip(ends[1:], places, strict=True)
    )
    joints = [Joint(names[k], "ball", ends[k], ends[k + 1], places[k]) for k in range(3)]
    scene = Scene("rods", bodies, 1.0, joints=tuple(joints), clock=Clock(0.01, 5))
    assert failures(scene, Settings("RK4", 0.005, {"spin": False})) == (None,)
    joints[2] = msgspec.structs.replace(joints[2], kind="hinge", axis=(1.0, 0.0, 0.0))
    scene = msgspec.structs.replace(scene, joints=tuple(joints))
    assert failures(scene, Settings("RK4", 0.005)) == (None,)

"""Contact in MuJoCo beside joints: their stops, what is welded, and lines to slip along."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, ContactSphere, Ground, Inertia, Joint, Scene
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter
from mbds_xsim.testing.contact_cases import RADIUS as R
from mbds_xsim.testing.contact_cases import ball
from tests.adapters.exact import Runs

ENGINE = load_adapter("mujoco")
G, MU = 9.81, 0.43
alone = Runs(ENGINE, {}).alone


@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("gap", [1.4, 1e-3], ids=["in the air", "near the ground"])
def test_stops_near_and_far_from_the_ground(gap: float, restitution: float) -> None:
    """An arm with a sphere at its tip falls onto its stop, above the ground."""
    stop = -0.50014
    height = R + gap - 0.4 * math.sin(stop)
    scene = Scene(
        "arm",
        (Body("arm", inertia=Inertia(1.0, (0.02,) * 3), position=(0.3, 0.0, height)),),
        0.5,
        joints=(
            Joint(
                "pin", "hinge", "world", "arm", (0.0, 0.0, height), (0.0, -1.0, 0.0), start=0.0,
                rate=0.0, limits=(stop, 1.0), restitution=restitution,
            ),
        ),
        contacts=(ContactSphere("arm", (0.4, 0.0, height), R),),
        ground=Ground(0.0, restitution),
        clock=Clock(0.02, 14),
    )  # fmt: skip
    batch = draw_batch(scene, [0])
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)
        assert "solreflimit" in run.native(batch)
    exact = reference.solve(scene, batch, cache=False)
    assert np.abs(motion.position - exact.position).max() < 1e-3
    assert np.abs(motion.angular_velocity - exact.angular_velocity).max() < 0.02


def test_friction_is_refused_by_all_that_is_welded_to_a_sphere() -> None:
    """A heavy block slides on four spheres of a light plate."""
    block = Body(
        "block", inertia=Inertia(1e4, (1e4 / 6,) * 3), position=(0.0, 0.0, 0.3),
        velocity=(2.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0),
    )  # fmt: skip
    plate = Body("plate", inertia=Inertia(10.0, (1.0, 1.0, 1.9)), position=(0.0, 0.0, 0.06))
    corners = [(x, y, R) for x in (-0.4, 0.4) for y in (-0.4, 0.4)]
    scene = Scene(
        "sledge", (block, plate), 1.0,
        joints=(Joint("weld", "fixed", "block", "plate", (0.0, 0.0, 0.06)),),
        contacts=tuple(ContactSphere("plate", corner, R) for corner in corners),
        ground=Ground(0.1, 0.0), clock=Clock(0.02, 5),
    )  # fmt: skip
    with pytest.raises(Unsupported, match=r"at least 0\.2\d+ for bodies this heavy"):
        ENGINE.open(scene, ENGINE.settings(scene, "matched"))
    rough = msgspec.structs.replace(scene, ground=Ground(0.25, 0.0))
    with ENGINE.open(rough, ENGINE.settings(rough, "matched")) as run:
        speed = run.rollout(draw_batch(rough, [0])).velocity[0, :, 0, 0]
    assert np.diff(speed) == pytest.approx(-0.25 * G * 0.02, rel=0.02)


def test_friction_along_a_line_is_refused() -> None:
    """A cart on a rail drags an arm; the solver would find a sixth of the friction."""
    bodies = [("cart", (0.0, 0.0, 0.3)), ("arm", (-0.2, 0.0, 0.175))]
    scene = Scene(
        "trailer",
        tuple(Body(name, inertia=Inertia(1.0, (0.02,) * 3), position=at) for name, at in bodies),
        1.0,
        joints=(
            Joint("rail", "slider", "world", "cart", (0.0, 0.0, 0.3), (1.0, 0.0, 0.0), rate=1.0),
            Joint("pin", "hinge", "cart", "arm", (0.0, 0.0, 0.3), (0.0, 1.0, 0.0)),
        ),
        contacts=(ContactSphere("arm", (-0.4, 0.0, R), R),),
        ground=Ground(0.3, 0.0),
        clock=Clock(0.02, 5),
    )
    settings = ENGINE.settings(scene, "matched")
    with pytest.raises(
        Unsupported, match=r"allowed is 0 for the sphere of 'arm', .* only one line"
    ):
        ENGINE.open(scene, settings)
    ENGINE.open(msgspec.structs.replace(scene, ground=Ground(0.0, 0.0)), settings).close()
    # On a ball joint the point has one line only where it is level with the joint.
    level = tuple(msgspec.structs.replace(b, position=(-0.2, 0.0, 0.3)) for b in scene.bodies[1:])
    hook = Joint("hook", "ball", "world", "arm", (0.0, 0.0, 0.3))
    tip = ContactSphere("arm", (-0.4, 0.0, 0.3 + R), R)
    hung = msgspec.structs.replace(scene, bodies=level, joints=(hook,), contacts=(tip,))
    ENGINE.open(hung, settings).close()


@pytest.mark.parametrize("height", [1.0, 0.3])
def test_a_touch_with_friction_along_a_line_ends_the_trajectory(height: float) -> None:
    """An arm swings down in a plane, high above the ground or down to it."""
    scene = Scene(
        "arm",
        (Body("arm", inertia=Inertia(1.0, (0.02,) * 3), position=(0.3, 0.0, height)),),
        0.5,
        joints=(Joint("pin", "hinge", "world", "arm", (0.0, 0.0, height), (0.0, 1.0, 0.0)),),
        contacts=(ContactSphere("arm", (0.4, 0.0, height), R),),
        ground=Ground(MU, 0.0),
        clock=Clock(0.02, 25),
    )
    batch = draw_batch(scene, [0, 0])
    exact = reference.solve(scene, batch, cache=False)
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)
    known = exact.known
    assert (motion.known == known).all()
    assert known.all() == (height > 0.5)
    assert np.abs(motion.position - exact.position)[known].max() < 1e-6
    for failure in motion.failures:
        assert failure is None or "'arm' meets the ground, and joints leave" in failure.reason
        assert (failure is None) == known.all()


@pytest.mark.parametrize("height", [2.0, R], ids=["in the air", "on the ground"])
def test_what_comes_no_nearer_to_the_ground_may_slip_along_one_line(height: float) -> None:
    """As the first link of an arm on a vertical joint, which only turns."""
    at = (0.0, 0.0, height)
    shoulder = Body("shoulder", inertia=Inertia(1.0, (0.1,) * 3), position=(0.3, 0.0, height))
    turn = Joint("turn", "hinge", "world", "shoulder", at, (0.0, 0.0, 1.0), rate=2.0)
    scene = Scene(
        "arm",
        (shoulder,),
        1.0,
        joints=(turn,),
        contacts=(ContactSphere("shoulder", (0.5, 0.0, height), R),),
        ground=Ground(MU, 0.5),
        clock=Clock(0.02, 10),
    )
    motion = alone(scene, ENGINE.settings(scene, "matched"))
    assert motion.angular_velocity[0, :, 0, 2] == pytest.approx(2.0, abs=1e-9)


def test_a_ball_bounces_alike_beside_an_arm_on_its_stop() -> None:
    """Velocities of what hangs together with the stop alone are not led."""
    scene = ball(0.2, ground=Ground(MU, 1.0), steps=100)
    arm = Body("arm", inertia=Inertia(1.0, (0.02,) * 3), position=(5.3, 0.0, 2.0))
    pin = Joint("pin", "hinge", "world", "arm", (5.0, 0.0, 2.0), (0.0, -1.0, 0.0))
    settings = Settings("RK4", 0.005, {"contact_substeps": 20, "impact_steps": 12})
    heights = []
    for limits in (None, (0.0, 1.0)):
        joint = msgspec.structs.replace(pin, limits=limits)
        both = msgspec.structs.replace(scene, bodies=(*scene.bodies, arm), joints=(joint,))
        heights.append(alone(both, settings).position[0, :, 0, 2])

    np.testing.assert_allclose(heights[1], heights[0], atol=1e-9)


def test_a_ball_flies_alike_while_another_lands() -> None:
    """Velocities of what flies are led, whatever else touches the ground."""
    low, high = ball(0.1, ground=Ground(MU, 0.0), steps=25), ball(3.0)
    flier = msgspec.structs.replace(high.bodies[0], name="flier")
    place = msgspec.structs.replace(high.contacts[0], body="flier")
    scene = msgspec.structs.replace(
        low, bodies=(*low.bodies, flier), contacts=(*low.contacts, place)
    )
    motion = alone(scene, ENGINE.settings(scene, "matched"))
    assert motion.velocity[0, :, 1, 2] == pytest.approx(-G * motion.time, abs=1e-9)

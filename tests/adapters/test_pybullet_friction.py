"""The direction of friction in Bullet, on the smallest case that shows it: one wheel that slips."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.constraints import constraint_rows, dense_jacobian
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Clock, Ground, Scene
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene
from mbds_xsim.studies.contact import wheel
from mbds_xsim.studies.contact.friction import sliding

pytest.importorskip("pybullet")
axes: Any = importlib.import_module("mbds_xsim_adapters.pybullet.contact")

ENGINE = load_adapter("pybullet")
HEADINGS = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0])
ALONG = np.stack([np.cos(HEADINGS), np.sin(HEADINGS), np.zeros(7)], axis=1)
STEP, FRAMES, SPEED = 5e-4, 10, 20.0


def sliding_wheel() -> tuple[Scene, Batch]:
    return wheel(Ground(0.43, 0.0), Clock(STEP, FRAMES), velocity=SPEED * ALONG)


def aside(sweeps: int, steps: int = 1, *, turned: bool) -> Array:
    """Angle of friction from the slip [°], shape (heading,)."""
    scene, batch = sliding_wheel()
    options = {"solver_iterations": sweeps, "friction_axes": turned}
    with ENGINE.open(scene, Settings("semi-implicit-euler", STEP / steps, options)) as run:
        motion = run.rollout(batch)
    assert motion.failures == (None,) * len(HEADINGS)
    coefficient, angle = sliding(motion, ALONG, (0.0, STEP * FRAMES))
    if turned:
        np.testing.assert_allclose(coefficient, 0.43, rtol=1e-5)
    return angle


@pytest.mark.parametrize(("sweeps", "steps"), [(1, 1), (100, 1), (10, 8)])
def test_friction_is_aside_as_bullets_rows_say_whatever_the_step_and_sweeps(
    sweeps: int, steps: int
) -> None:
    """The wheel's moment about x is ten times that about y: W is 3.5 along x, 1.25 along y."""
    leaning = np.arctan2(np.sin(HEADINGS) / 1.25, np.cos(HEADINGS) / 3.5)
    angle = aside(sweeps, steps, turned=False)

    np.testing.assert_allclose(angle, np.degrees(leaning - HEADINGS), atol=0.1)
    assert angle.max() > 28.0


def test_friction_opposes_the_slip_along_axes_where_a_wheel_yields_alike() -> None:
    """The tolerance allows for the wheel's small yaw within a frame."""
    assert aside(20, turned=True).max() < 0.1


@pytest.mark.parametrize("name", ["particlecar", "simplecubli"])
def test_axes_are_where_both_rows_yield_alike(name: str) -> None:
    """The test takes W from the constraints of all joints, not from the tree's rates."""
    scene = load_scene(name)
    mechanism, batch = Mechanism.of(scene), draw_batch(scene, [1])
    native = mechanism.native_rotation(batch.orientation[0])
    state = (batch.position[0], native, batch.velocity[0], batch.angular_velocity[0])
    spheres = np.arange(len(mechanism.sphere_body))
    angles = axes.Yielding(mechanism).alike(BodyStates(*state), spheres)

    for sphere, angle in zip(spheres.tolist(), angles.tolist(), strict=True):
        w = _yielding(mechanism, state, sphere)
        sine, cosine = np.sin(angle), np.cos(angle)
        along = np.array([[cosine, sine], [-sine, cosine]])
        turned = along @ w @ along.T
        assert turned[0, 0] == pytest.approx(turned[1, 1], rel=1e-9)


def test_every_wheel_of_a_car_has_a_ground_that_is_turned_and_the_listing_says_so() -> None:
    scene = load_scene("particlecar")
    with ENGINE.open(scene, Settings("semi-implicit-euler", 1e-3)) as run:
        text = run.native(draw_batch(scene, [0]))
    assert text.count("anisotropicFriction=[1.0, -1.0, 1.0]") == 4
    assert "# is turned once a frame, by half the angle" in text
    assert text.index("createMultiBody") < text.index("resetBasePositionAndOrientation")


def test_the_switch_is_true_or_false() -> None:
    scene, _ = sliding_wheel()
    with pytest.raises(InputError, match="friction_axes of pybullet: got 2"):
        ENGINE.open(scene, Settings("semi-implicit-euler", STEP, {"friction_axes": 2}))


def _yielding(mechanism: Mechanism, state: tuple[Array, ...], sphere: int) -> Array:
    count, body = mechanism.body_count, int(mechanism.sphere_body[sphere])
    turn = rotation.matrix(state[1])
    inverse = np.zeros((6 * count, 6 * count))
    for k in range(count):
        place = slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)
        inverse[place[0], place[0]] = np.eye(3) / mechanism.mass[k]
        inverse[place[1], place[1]] = turn[k] @ np.linalg.inv(mechanism.inertia[k]) @ turn[k].T
    x, y, z = turn[body] @ mechanism.sphere_offset[sphere]
    z -= mechanism.sphere_radius[sphere]
    push = np.zeros((2, 6 * count))
    push[:, 6 * body : 6 * body + 6] = [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x]]
    jacobian = dense_jacobian(constraint_rows(mechanism, BodyStates(*state)), count)
    borne = np.linalg.pinv(jacobian @ inverse @ jacobian.T)
    mobility = inverse - inverse @ jacobian.T @ borne @ jacobian @ inverse
    return np.asarray(push @ mobility @ push.T)

"""The check scene: every feature, no chaos, and every slip of a translation moves it visibly."""

from __future__ import annotations

import functools
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.agreement import particle_error
from mbds_xsim.reference import sensitivity, solve
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.solution import start_states
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.joint_space import joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Inertia, Joint, Scene
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import registry
from mbds_xsim.simulate.adapter import Adapter
from mbds_xsim.simulate.claims import Feature, features_of

Slip = Callable[[Scene, Batch], tuple[Scene, Batch]]

SCENE = registry.load_scene("workbench")
VISIBLE = 2.0 * SCENE.budget.error_1s * SCENE.length
"""Least motion of the particles within a second by which a slip shows [m]."""

_STEPS = 50


def test_has_all_that_the_other_scenes_lack() -> None:
    expected = {
        Feature.HINGE,
        Feature.SLIDER,
        Feature.FIXED,
        Feature.LOOP_HINGE,
        Feature.SPRING_DAMPER,
        Feature.FORCE,
        Feature.HINGE_TORQUE,
        Feature.FULL_INERTIA,
    }

    assert features_of(SCENE) == expected
    assert degrees_of_freedom(Mechanism.of(SCENE)) == 6


def test_a_body_has_three_principal_moments_along_no_axis_of_its_own() -> None:
    inertia = next(body.inertia for body in SCENE.bodies if body.name == "forearm")
    assert inertia is not None
    (xx, yy, zz), (xy, xz, yz) = inertia.moments, inertia.products

    moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    assert np.all(np.diff(moments) > 0.2 * moments.min())
    assert np.abs(axes).max() < np.cos(0.2)


def test_some_joints_point_inwards() -> None:
    mechanism = Mechanism.of(SCENE)
    turned = {
        link.joint.name
        for link in mechanism.links
        if link.joint is not None and link.joint.parent != mechanism.joints[link.joint.index].parent
    }

    assert turned == {"knee", "elbow"}


def test_every_engine_can_represent_it(adapter: Adapter) -> None:
    adapter.check(SCENE, adapter.settings(SCENE, "matched"))


@pytest.mark.slow
def test_is_predictable_in_low_and_medium() -> None:
    rows = [0, 1, 3, 4, 6, 7]
    growth = sensitivity(SCENE, draw_batch(SCENE, rows), cache=False)

    assert growth.max() < 30.0


def test_the_redundant_rows_of_the_loop_are_told_in_a_batch_as_alone() -> None:
    """A planar loop of hinges depends on three rows; near it they must not count as new ones."""
    mechanism = Mechanism.of(SCENE)
    dynamics = dynamics_of(mechanism)
    batch = draw_batch(SCENE, [3])
    state = start_states(mechanism, batch)
    near = state + 1e-8 * np.random.default_rng(0).standard_normal((40, *state.shape[1:]))
    loads = batch.force[:, 0], batch.torque[:, 0]
    repeated = [np.repeat(load, len(near), axis=0) for load in loads]

    together = dynamics.derivative(near, repeated[0], repeated[1])

    alone = [dynamics.derivative(one[None], *loads)[0] for one in near]
    assert np.abs(together - np.array(alone)).max() < 1e-9
    assert np.abs(together - dynamics.derivative(state, *loads)).max() < 1e-4


def test_every_joint_moves() -> None:
    _, motion = _right()
    mechanism = Mechanism.of(SCENE)
    native = mechanism.native_rotation(motion.orientation)
    for joint in mechanism.joints:
        if joint.kind != "fixed":
            value = np.unwrap(joint_coordinate(joint, motion.position, native)[0])
            assert np.ptp(value) > 0.03, joint.name


def _bodies(**changed: Callable[[Body], Body]) -> Slip:
    def slip(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
        bodies = tuple(
            changed[body.name](body) if body.name in changed else body for body in scene.bodies
        )
        return msgspec.structs.replace(scene, bodies=bodies), batch

    return slip


def _inertia(change: Callable[[Inertia], Inertia]) -> Callable[[Body], Body]:
    def changed(body: Body) -> Body:
        assert body.inertia is not None
        return msgspec.structs.replace(body, inertia=change(body.inertia))

    return changed


def _axes_swapped(inertia: Inertia) -> Inertia:
    xx, yy, zz = inertia.moments
    xy, xz, yz = inertia.products
    return msgspec.structs.replace(inertia, moments=(yy, xx, zz), products=(xy, yz, xz))


def _no_products(inertia: Inertia) -> Inertia:
    return msgspec.structs.replace(inertia, products=(0.0, 0.0, 0.0))


def _quaternion_order_swapped(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
    """Read wxyz as xyzw: only the inertia turns, the rest is given in W."""

    def turned(body: Body) -> Body:
        w, x, y, z = body.orientation
        return msgspec.structs.replace(body, orientation=(z, w, x, y))

    return _bodies(forearm=turned)(scene, batch)


def _axis_flipped(name: str) -> Slip:
    """Flip a joint's axis; the start is the same motion, so that only the torque shows."""

    def slip(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
        def flipped(joint: Joint) -> Joint:
            if joint.name != name:
                return joint
            assert joint.axis is not None
            x, y, z = joint.axis
            return msgspec.structs.replace(joint, axis=(-x, -y, -z))

        return msgspec.structs.replace(scene, joints=tuple(map(flipped, scene.joints))), batch

    return slip


def _motor_left_on(name: str) -> Slip:
    """A velocity motor with target 0 damps its hinge (here by 0.2 N·m·s/rad)."""

    def slip(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
        mechanism = Mechanism.of(scene)
        hinge = next(k for k, joint in enumerate(mechanism.hinges) if joint.name == name)
        _, motion = _right()
        native = mechanism.native_rotation(motion.orientation)
        angle = np.unwrap(joint_coordinate(mechanism.hinges[hinge], motion.position, native))
        torque = batch.torque.copy()
        torque[:, :, hinge] -= 0.2 * np.diff(angle, axis=1) / scene.clock.frame
        return scene, _with(batch, torque=torque)

    return slip


def _torque_on_another(first: str, second: str) -> Slip:
    def slip(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
        names = [joint.name for joint in Mechanism.of(scene).hinges]
        a, b = names.index(first), names.index(second)
        torque = batch.torque.copy()
        torque[:, :, [a, b]] = torque[:, :, [b, a]]
        return scene, _with(batch, torque=torque)

    return slip


def _force_on_another(scene: Scene, batch: Batch) -> tuple[Scene, Batch]:
    return scene, _with(batch, force=np.roll(batch.force, 1, axis=2))


def _with(batch: Batch, **changed: Array) -> Batch:
    fields = {key: getattr(batch, key) for key in batch.__dataclass_fields__}
    return Batch(**{**fields, **changed})


@functools.cache
def _right() -> tuple[Batch, Trajectory]:
    batch = draw_batch(SCENE, [0, 1]).truncated(_STEPS)
    return batch, _solved(SCENE, batch)


def _solved(scene: Scene, batch: Batch) -> Trajectory:
    return solve(scene, batch, rtol=1e-8)


_SLIPS: dict[str, Slip] = {
    **{
        f"axis of {name} flipped": _axis_flipped(name)
        for name in ("spindle", "shoulder", "elbow", "crank pin", "rotor axle")
    },
    **{
        f"motor of {name} left on": _motor_left_on(name)
        for name in ("spindle", "crank pin", "knee", "shoulder", "elbow", "rotor axle")
    },
    "inertia axes of forearm swapped": _bodies(forearm=_inertia(_axes_swapped)),
    "inertia axes of rotor swapped": _bodies(rotor=_inertia(_axes_swapped)),
    "inertia axes of rocker swapped": _bodies(rocker=_inertia(_axes_swapped)),
    "products left out": _bodies(forearm=_inertia(_no_products)),
    "quaternion order swapped": _quaternion_order_swapped,
    "torque of shoulder on elbow": _torque_on_another("shoulder", "elbow"),
    "torque of spindle on shoulder": _torque_on_another("spindle", "shoulder"),
    "torque of crank pin on rotor": _torque_on_another("crank pin", "rotor axle"),
    "force on the next body": _force_on_another,
}


@pytest.mark.parametrize("slip", _SLIPS.values(), ids=_SLIPS.keys())
def test_a_slip_of_a_translation_shows(slip: Slip) -> None:
    batch, right = _right()
    scene, changed = slip(SCENE, batch)
    mechanism = Mechanism.of(SCENE)

    error = particle_error(mechanism, _solved(scene, changed), right)

    assert error[:, -1].max() > VISIBLE

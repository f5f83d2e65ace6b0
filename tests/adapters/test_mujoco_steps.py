"""MuJoCo's savings: more steps only where joints turn fast, no spin if nothing turns a rod."""

from __future__ import annotations

import re

import msgspec
import numpy as np
import pytest

from mbds_xsim import reference
from mbds_xsim.base import rotation
from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene
from mbds_xsim.scene.servo import Servo
from mbds_xsim.scene.spin import idle_axes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import readback
from mbds_xsim.simulate.adapter import Settings
from mbds_xsim.simulate.registry import load_adapter, load_scene

pytest.importorskip("mujoco")

ENGINE = load_adapter("mujoco")


def rollout(scene: Scene, batch: Batch, count: int, **options: float | bool | str) -> Trajectory:
    with ENGINE.open(scene, Settings("RK4", scene.clock.frame / count, options)) as run:
        return run.rollout(batch)


def swinging(speed: float) -> tuple[Scene, Batch, Trajectory]:
    """A double pendulum whose rods start at a given rate [rad/s], and its exact motion."""
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, [0], noise=False).truncated(25)
    spin = np.zeros_like(batch.angular_velocity)
    spin[..., 0] = speed
    down = np.array([0.0, 0.0, -0.5])
    place = np.array([[down, 2 * down]])
    upright = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), batch.orientation.shape)
    velocity = np.cross(spin, place)
    start = Batch(
        **{
            **{key: getattr(batch, key) for key in batch.__dataclass_fields__},
            "position": place,
            "orientation": upright,
            "velocity": velocity,
            "angular_velocity": spin,
        }
    )
    return scene, start, reference.solve(scene, start, cache=False)


def error(motion: Trajectory, exact: Trajectory) -> float:
    return float(np.abs(motion.position - exact.position).max())


def test_frames_with_fast_joints_take_more_steps() -> None:
    scene, batch, exact = swinging(12.0)
    equal, finer = (rollout(scene, batch, 1, turn=turn) for turn in (0.0, 0.125))
    assert error(finer, exact) < 0.1 * error(equal, exact)


def test_more_steps_where_joints_are_fast_keep_the_order() -> None:
    scene, batch, exact = swinging(8.0)
    errors = [error(rollout(scene, batch, count), exact) for count in (1, 2, 4)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.4), (orders, errors)


def test_slow_frames_take_the_steps_that_were_asked_for() -> None:
    scene, batch, _ = swinging(0.1)
    batch = batch.truncated(5)
    assert np.array_equal(
        rollout(scene, batch, 4).position, rollout(scene, batch, 4, turn=0.0).position
    )


def test_a_ladder_without_the_spin_of_its_rods_moves_as_the_reference_does() -> None:
    scene = load_scene("2ladder")
    batch = draw_batch(scene, [0, 2]).truncated(50)
    exact = reference.solve(scene, batch, cache=False)
    whole, slim = (rollout(scene, batch, 4, spin=spin) for spin in (True, False))
    for key in ("position", "orientation", "velocity", "angular_velocity"):
        off, usual = (
            np.abs(getattr(motion, key) - getattr(exact, key)).max() for motion in (slim, whole)
        )
        assert off < max(1.2 * usual, 1e-9), key


def test_a_model_without_spin_is_smaller_and_stands_for_the_scene() -> None:
    scene = load_scene("3ladder")
    batch = draw_batch(scene, [0])
    sizes = []
    for spin in (True, False):
        with ENGINE.open(scene, Settings("RK4", 0.01, {"spin": spin})) as run:
            sizes.append(run.size.coordinates)
            native = run.readback(batch)
            settings = Settings("RK4", 0.01)
            assert readback.compare(Mechanism.of(scene), batch, settings, native) == []
    assert sizes == [117, 81]


@pytest.mark.parametrize("what", ["spins", "bends"])
def test_what_spins_or_bends_too_far_is_simulated_with_spin(what: str) -> None:
    """The other trajectory of the batch keeps the model without spin."""
    scene = load_scene("2pendulum")
    batch = draw_batch(scene, [0, 3], noise=False).truncated(10)
    if what == "spins":
        axis = batch.position[1, 0] / np.linalg.norm(batch.position[1, 0])
        batch.angular_velocity[1, 0] += 2.0 * axis
    else:  # the lower rod lies along the first axis of its Cardan joint, which locks
        down = np.array([0.0, 0.0, -0.5])
        aside = 0.5 * rotation.normal_to(idle_axes(scene)[1])[0]
        batch.position[1] = [down, down + aside]
        batch.orientation[1] = [rotation.IDENTITY, rotation.between(down, aside)]
        batch.velocity[1] = batch.angular_velocity[1] = 0.0
    whole, slim = (rollout(scene, batch, 4, spin=spin) for spin in (True, False))
    assert np.array_equal(whole.position[1], slim.position[1])
    assert not np.array_equal(whole.position[0], slim.position[0])
    assert np.allclose(whole.position[0], slim.position[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("turn", -1.0),
        ("turn", "far"),
        ("turn", 1e200),
        ("turn", 1e-300),
        ("spin", "no"),
        ("loop_time_constant", 1e-200),
        ("link_time_constant", 1e-200),
        ("impact_steps", 2500),
    ],
)
def test_wrong_values_are_refused(name: str, value: float | str) -> None:
    scene = load_scene("2pendulum")
    words = re.escape(f"option {name} of mujoco: got {value!r}, allowed is")
    with pytest.raises(InputError, match=words):
        ENGINE.open(scene, Settings("RK4", 0.01, {name: value}))


def test_the_native_text_tells_what_it_leaves_out_and_when_steps_change() -> None:
    scene = load_scene("2ladder")
    with ENGINE.open(scene, Settings("RK4", 0.01, {"spin": False})) as run:
        text = run.native(draw_batch(scene, [0]))
    assert "rad/s" in text
    assert text.count('type="hinge"') == 2 * 24


def test_ladders_leave_spin_out_at_matched() -> None:
    def leaves_out(scene: Scene) -> bool:
        return ENGINE.settings(scene, "matched").options.get("spin") is False

    assert leaves_out(load_scene("1ladder"))
    assert not leaves_out(load_scene("2pendulum"))
    assert not leaves_out(msgspec.structs.replace(load_scene("balldrop"), name="other"))


@pytest.mark.parametrize("share", [1e-4, 1e-6, 1e-9])
def test_rods_too_small_to_be_slim_move_as_large_ones(share: float) -> None:
    """Masses have no effect on a ladder that only gravity moves."""
    scene = load_scene("1ladder")
    light = tuple(
        msgspec.structs.replace(
            body,
            particles=tuple(
                msgspec.structs.replace(p, mass=share * p.mass, inertia=share * p.inertia)
                for p in body.particles
            ),
        )
        for body in scene.bodies
    )
    own = msgspec.structs.replace(scene, name="light ladder", bodies=light)
    batch = draw_batch(scene, [0]).truncated(10)
    batch.force[...] = 0.0
    settings = ENGINE.settings(own, "matched")
    with ENGINE.open(own, settings) as run:
        motion = run.rollout(batch)
        assert readback.compare(Mechanism.of(own), batch, settings, run.readback(batch)) == []
    with ENGINE.open(scene, settings) as run:
        assert np.abs(motion.position - run.rollout(batch).position).max() < 1e-6


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_stiff_servos_shorten_matched_steps_beside_any_stop(restitution: float) -> None:
    """A servo turns a link of 5e-5 kg·m² by a damping of 2 N·m·s/rad."""
    pin = Joint(
        "pin", "hinge", "world", "link", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), start=0.0, rate=0.0,
        limits=(-0.5, 0.5), restitution=restitution,
    )  # fmt: skip
    scene = Scene(
        "link",
        (Body("link", inertia=Inertia(0.05, (5e-5,) * 3)),),
        0.1,
        gravity=(0.0, 0.0, 0.0),
        joints=(pin,),
        servos=(Servo("pin", (0.2,), (0.0,), 20.0, 2.0, 1, 3.0),),
        clock=Clock(0.02, 5),
    )
    batch = draw_batch(scene, [0])
    with ENGINE.open(scene, ENGINE.settings(scene, "matched")) as run:
        motion = run.rollout(batch)
    exact = reference.solve(scene, batch, cache=False)
    assert np.abs(motion.angular_velocity - exact.angular_velocity).max() < 1e-3

"""Small scenes, and integrators of known order that record them with or without a defect."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.reference import accelerations
from mbds_xsim.scene.joint_space import BodyStates, LinkStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.sampling_terms import HingeTorque, Throw
from mbds_xsim.scene.scene import Body, Clock, Inertia, Joint, Scene, SpringDamper
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.registry import load_scene

State = tuple[Array, Array, Array, Array]
Stepper = Callable[["Model", State, float, Array, Array], State]


class Model:
    """Accelerations of a scene at states of shape (trajectory, body, …)."""

    def __init__(self, scene: Scene) -> None:
        self.mechanism = Mechanism.of(scene)

    def acceleration(self, state: State, force: Array, torque: Array) -> tuple[Array, Array]:
        return accelerations(self.mechanism, BodyStates(*state), force, torque)


def _moved(state: State, linear: Array, angular: Array) -> State:
    """Move the poses by displacements and rotation vectors."""
    turned = rotation.multiply(rotation.from_vector(angular), state[1])
    return state[0] + linear, turned / np.linalg.norm(turned, axis=-1, keepdims=True), *state[2:]


def rk4(model: Model, state: State, h: float, force: Array, torque: Array) -> State:
    """Runge–Kutta of order 4 on positions, quaternions and velocities."""

    def rate(s: State) -> State:
        linear, angular = model.acceleration(s, force, torque)
        spin = np.concatenate([np.zeros((*s[3].shape[:-1], 1)), s[3]], axis=-1)
        return s[2], 0.5 * rotation.multiply(spin, s[1]), linear, angular

    def plus(s: State, scale: float, r: State) -> State:
        x, q, v, w = (a + scale * b for a, b in zip(s, r, strict=True))
        return x, q, v, w

    a = rate(state)
    b = rate(plus(state, h / 2, a))
    c = rate(plus(state, h / 2, b))
    d = rate(plus(state, h, c))
    for scale, part in ((h / 6, a), (h / 3, b), (h / 3, c), (h / 6, d)):
        state = plus(state, scale, part)
    x, q, v, w = state
    return x, q / np.linalg.norm(q, axis=-1, keepdims=True), v, w


def midpoint(model: Model, state: State, h: float, force: Array, torque: Array) -> State:
    """Explicit midpoint rule, order 2."""
    linear, angular = model.acceleration(state, force, torque)
    half = _moved(state, h / 2 * state[2], h / 2 * state[3])
    half = (*half[:2], state[2] + h / 2 * linear, state[3] + h / 2 * angular)
    linear, angular = model.acceleration(half, force, torque)
    end = _moved(state, h * half[2], h * half[3])
    return *end[:2], state[2] + h * linear, state[3] + h * angular


def euler_reduced(model: Model, state: State, h: float, force: Array, torque: Array) -> State:
    """Semi-implicit Euler on the relative rotations of a tree of ball joints, as engines do."""
    mechanism = model.mechanism
    links = to_links(mechanism, BodyStates(*state))
    _, angular = model.acceleration(state, force, torque)
    spin = np.array(links.angular_velocity)
    for k, link in enumerate(mechanism.links):
        assert link.joint is not None
        assert link.joint.kind == "ball"
        own, pull = state[3][:, link.body], angular[:, link.body]
        base = np.zeros_like(own) if link.parent == WORLD_INDEX else state[3][:, link.parent]
        if link.parent != WORLD_INDEX:
            pull = pull - angular[:, link.parent]
        back = rotation.conjugate(state[1][:, link.body])
        spin[:, k] += h * rotation.rotate(back, pull - np.cross(own, own - base))
    turn = rotation.multiply(links.rotation, rotation.from_vector(h * spin))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    end = to_bodies(
        mechanism,
        LinkStates(turn, spin, links.coordinate, links.rate, links.position, links.velocity),
    )
    return end.position, end.native, end.velocity, end.angular_velocity


STEPPERS: dict[str, Stepper] = {
    "rk4": rk4,
    "midpoint": midpoint,
    "euler_reduced": euler_reduced,
}


@functools.cache
def simulate(
    scene: Scene,
    batch: Batch,
    substeps: int,
    stepper: str = "rk4",
    *,
    late: float = 0.0,
) -> Trajectory:
    """Record a scene's motion, `late` seconds before each frame."""
    model, step = Model(scene), STEPPERS[stepper]
    h = scene.clock.frame / substeps
    state: State = (
        batch.position,
        model.mechanism.native_rotation(batch.orientation),
        batch.velocity,
        batch.angular_velocity,
    )
    back = round(late / h)
    recorded = [state]
    for frame in range(batch.steps):
        force, torque = batch.force[:, frame], batch.torque[:, frame]
        for k in range(substeps):
            if k == substeps - back:
                recorded.append(state)
            state = step(model, state, h, force, torque)
        if back == 0:
            recorded.append(state)
    x, q, v, w = (np.stack(parts, axis=1) for parts in zip(*recorded, strict=True))
    time = np.asarray(scene.clock.frame * np.arange(batch.steps + 1))
    published = model.mechanism.body_orientation(q)
    return Trajectory(time, x, published, v, w, (None,) * len(batch))


def drawn(scene: Scene, steps: int, rows: int = 3) -> tuple[Scene, Batch]:
    """Shorten a scene's clock and draw its first trajectories."""
    scene = msgspec.structs.replace(scene, clock=Clock(scene.clock.frame, steps))
    return scene, draw_batch(scene, range(rows))


def tumbler() -> Scene:
    """Two bodies on a driven hinge, thrown and spinning, with noise: free of the world."""
    return Scene(
        name="tumbler",
        bodies=(
            Body("hull", inertia=Inertia(2.0, (0.02, 0.03, 0.04), products=(0.002, 0.0, 0.001))),
            Body("arm", inertia=Inertia(0.5, (0.004, 0.005, 0.002)), position=(0.2, 0.0, 0.1)),
        ),
        joints=(Joint("elbow", "hinge", "hull", "arm", (0.1, 0.0, 0.05), (0.0, 1.0, 1.0)),),
        length=0.3,
        noise=0.2,
        sampling=(
            Throw(
                body="hull",
                displacement=((-0.1, 0.1),) * 3,
                orientation="uniform",
                velocity=((-1.0, 1.0),) * 3,
                angular_velocity=((-3.0, 3.0),) * 3,
            ),
            HingeTorque(joints=("elbow",), torque=(0.02, 0.05), hold=5, random_sign=True),
        ),
    )


def four_bar() -> Scene:
    """A driven four-bar linkage in the x–z plane with a damped spring: one closed loop, 2D."""
    return Scene(
        name="four-bar",
        dimension=2,
        bodies=(
            Body("crank", inertia=Inertia(1.0, (0.01, 0.01, 0.01)), position=(0.0, 0.0, 0.1)),
            Body("rod", inertia=Inertia(1.5, (0.03, 0.03, 0.03)), position=(0.2, 0.0, 0.3)),
            Body("rocker", inertia=Inertia(1.0, (0.02, 0.02, 0.02)), position=(0.45, 0.0, 0.2)),
        ),
        joints=(
            Joint("drive", "hinge", "world", "crank", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
            Joint("pin", "hinge", "crank", "rod", (0.0, 0.0, 0.2), (0.0, 1.0, 0.0)),
            Joint("top", "hinge", "rod", "rocker", (0.4, 0.0, 0.4), (0.0, 1.0, 0.0)),
            Joint("foot", "hinge", "world", "rocker", (0.5, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ),
        springs=(
            SpringDamper(
                "stay",
                ("world", "rod"),
                ((0.2, 0.0, 0.6), (0.2, 0.0, 0.3)),
                stiffness=20.0,
                damping=0.5,
                rest_length=0.2,
            ),
        ),
        length=0.5,
        sampling=(HingeTorque(joints=("drive",), torque=(-0.5, 0.5), hold=5),),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A scene with a batch and its nearly exact motion."""

    scene: Scene
    batch: Batch
    exact: Trajectory


@pytest.fixture(scope="session")
def pendulum() -> Case:
    scene, batch = drawn(load_scene("3pendulum"), 40)
    return Case(scene, batch, simulate(scene, batch, 10))


@pytest.fixture(scope="session")
def tumbling() -> Case:
    scene, batch = drawn(tumbler(), 40)
    return Case(scene, batch, simulate(scene, batch, 10))


@pytest.fixture(scope="session")
def linkage() -> Case:
    scene, batch = drawn(four_bar(), 40)
    return Case(scene, batch, simulate(scene, batch, 10))


@pytest.fixture(scope="session", name="simulate")
def simulate_fixture() -> Callable[..., Trajectory]:
    return simulate


@pytest.fixture(scope="session", name="drawn")
def drawn_fixture() -> Callable[..., tuple[Scene, Batch]]:
    return drawn

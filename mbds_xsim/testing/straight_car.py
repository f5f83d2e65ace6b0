"""A car driving straight on, both wheels of an axle alike: rolling and slip in closed form.

With the car upright the normal forces follow from the balance of moments in its plane, and all
accelerations are constant until a wheel's slip ends or its torque changes. Rigid contact at four
points has no unique solution, but here only the sum over each axle matters, and that is unique.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling import draw_batch
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch, Trajectory

_STILL = 1e-12  # largest slip that counts as none [m/s]
_ENDS = np.array([1.0, -1.0])  # front, rear
_AXLE = np.array([0.0, 1.0, 0.0])


def straight_run(
    scene: Scene, *, speed: float, rates: tuple[float, float], torque: Array | None = None
) -> tuple[Batch, Trajectory]:
    """Return a start of a car, and the exact motion from there.

    Args:
        scene: A body on four equal wheels, hinged about y, symmetric about its middle.
        speed: Speed along x at the start [m/s].
        rates: Rates of the front and rear wheels [rad/s]; positive rolls forwards.
        torque: Torque on each front and each rear wheel, shape (step, 2) [N·m]; None: coasting.

    Raises:
        SceneError: The scene is no such car, or an axle lifts off.
    """
    car = _Car.of(scene)
    steps = scene.clock.steps
    drive = np.zeros((steps, 2)) if torque is None else 2.0 * torque
    state = np.array([0.0, 0.0, 0.0, speed, *rates])
    states = [state]
    for k in range(steps):
        state = car.through_frame(state, drive[k], scene.clock.frame)
        states.append(state)
    return _batch(car, scene, states[0], drive), _trajectory(car, scene, np.array(states))


@dataclass(frozen=True, eq=False)
class _Car:
    """Car whose state is (x, angles of the front and rear wheels) and the rates of these."""

    mass: float
    inertia: float
    """Moment of inertia of an axle's two wheels about their hinges [kg·m²]."""
    radius: float
    weight: float
    friction: float
    lever: float
    """Height of the car's centre of mass above the hubs [m]."""
    wheelbase: float
    axle: NDArray[np.intp]
    """Axle of each body: 0 turns with the front wheels, 1 with the rear ones, 2 is the chassis."""

    @staticmethod
    def of(scene: Scene) -> _Car:
        mechanism = Mechanism.of(scene)
        wheels = np.array([hinge.child for hinge in mechanism.hinges], dtype=np.intp)
        if scene.ground is None or len(wheels) != 4 or mechanism.body_count != 5:
            msg = f"{scene.name}: got {len(wheels)} hinges, a car has a chassis on 4 wheels"
            raise SceneError(msg)
        hubs = mechanism.com[wheels]
        centre = mechanism.mass @ mechanism.com / mechanism.mass.sum()
        moments = mechanism.inertia[wheels, 1, 1]
        if np.ptp(moments) > 1e-12 or abs(centre[0] - hubs[:, 0].mean()) > 1e-12:
            msg = f"{scene.name}: a straight run needs equal wheels, evenly around the centre"
            raise SceneError(msg)
        axle = np.full(5, 2, dtype=np.intp)
        axle[wheels] = hubs[:, 0] < centre[0]
        mass = float(mechanism.mass.sum())
        return _Car(
            mass=mass,
            inertia=2.0 * float(moments[0]),
            radius=float(mechanism.sphere_radius[0]),
            weight=-mass * scene.gravity[2],
            friction=scene.ground.friction,
            lever=float(centre[2] - hubs[0, 2]),
            wheelbase=float(np.ptp(hubs[:, 0])),
            axle=axle,
        )

    def through_frame(self, state: Array, drive: Array, remaining: float) -> Array:
        while remaining > 0.0:
            slip = state[3] - self.radius * state[4:]
            change = self._accelerations(np.where(np.abs(slip) <= _STILL, 0.0, slip), drive)
            growth = change[0] - self.radius * change[1:]
            stops = [-s / g for s, g in zip(slip, growth, strict=True) if abs(s) > _STILL > s * g]
            t = min([remaining, *(stop for stop in stops if stop > 0.0)])
            state = np.concatenate(
                [state[:3] + t * (state[3:] + 0.5 * t * change), state[3:] + t * change]
            )
            remaining -= t
        return state

    def _accelerations(self, slip: Array, drive: Array) -> Array:
        """Return the accelerations of x and the wheels: the only ones Coulomb's law allows."""
        for ways in product(*((np.sign(s),) if s else (0.0, 1.0, -1.0) for s in slip)):
            way = np.array(ways)
            force, load = self._forces(way, drive)
            change = np.append(
                force.sum() / self.mass, (drive - self.radius * force) / self.inertia
            )
            growth = (change[0] - self.radius * change[1:]) * way
            grips = np.abs(force) <= self.friction * load * (1.0 + 1e-12)
            lawful = (slip != 0.0) | ((way == 0.0) & grips) | (growth > 0.0)
            if (lawful & (load > 0.0)).all():
                return change
        msg = "an axle lifts off the ground: a straight run does not know what happens then"
        raise SceneError(msg)

    def _forces(self, way: Array, drive: Array) -> tuple[Array, Array]:
        """Return friction and loads of the axles, which slip one way or the other, or roll (0)."""
        shift = _ENDS / self.wheelbase
        # Loads are base + tilt · (sum of the friction forces).
        base = 0.5 * self.weight - shift * drive.sum()
        tilt = -shift * self.lever
        rows, goal = np.empty((2, 2)), np.empty(2)
        for k in range(2):
            own = np.eye(2)[k]
            if way[k]:
                rows[k] = own + self.friction * way[k] * tilt[k]
                goal[k] = -self.friction * way[k] * base[k]
            else:
                rows[k] = 1.0 / self.mass + self.radius**2 / self.inertia * own
                goal[k] = self.radius / self.inertia * drive[k]
        force = np.asarray(np.linalg.solve(rows, goal), dtype=np.float64)
        return force, base + tilt * force.sum()


def _batch(car: _Car, scene: Scene, start: Array, drive: Array) -> Batch:
    rest = draw_batch(scene, [0], noise=False, inputs=False)
    spin = np.append(start[4:], 0.0)[car.axle]
    hinges = np.array([hinge.child for hinge in Mechanism.of(scene).hinges])
    return dataclasses.replace(
        rest,
        velocity=np.broadcast_to([start[3], 0.0, 0.0], rest.velocity.shape).copy(),
        angular_velocity=(spin[:, None] * _AXLE)[None],
        torque=0.5 * drive[None][:, :, car.axle[hinges]],
    )


def _trajectory(car: _Car, scene: Scene, states: Array) -> Trajectory:
    mechanism = Mechanism.of(scene)
    time = scene.clock.frame * np.arange(len(states), dtype=float)
    result = Trajectory.empty(time, 1, mechanism.body_count)
    along = np.array([1.0, 0.0, 0.0])
    still = np.zeros((len(states), 1))
    angle = np.hstack([states[:, 1:3], still])[:, car.axle]
    spin = np.hstack([states[:, 4:], still])[:, car.axle]
    result.position[0] = mechanism.com + states[:, :1, None] * along
    result.velocity[0] = states[:, 3, None, None] * along
    result.angular_velocity[0] = spin[..., None] * _AXLE
    turn = rotation.from_vector(angle[..., None] * _AXLE)
    result.orientation[0] = mechanism.body_orientation(turn)
    return result

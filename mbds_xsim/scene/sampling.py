"""Draw starts and inputs: trajectory i depends on the scene, the seed and i alone.

Everything of trajectory i comes from `default_rng(SeedSequence([seed, i]))` in this order: the
scene's `sampling` entries as listed, each in the order its docstring gives, then the noise, frame
by frame, body by body, component by component. Inputs are drawn even when switched off, and noise
comes last, so that switching either off leaves the start unchanged.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene import sampling_terms as terms
from mbds_xsim.scene.assembly import assemble, check_joints, check_limits
from mbds_xsim.scene.draft import Draft, Drafts, carried_by, hinge_rate, lift, pose
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import by_joint, zero_order_hold
from mbds_xsim.scene.state import Batch

# σ holds for frames of this length; other intervals keep the noise's spectral density.
_NOISE_FRAME = 0.02
_CENTRED = 1e-9  # tolerance of a sphere centred at a centre of mass [m]
_MOVING = {1: slice(1), 2: slice(0, 3, 2), 3: slice(3)}  # components of W by dimension
_ALL_ROUND = (0.0, 2.0 * np.pi)  # [rad]


def draw_batch(
    scene: Scene, indices: Iterable[int], *, seed: int = 0, noise: bool = True, inputs: bool = True
) -> Batch:
    """Draw trajectories by index; index i takes interval i mod 3 of low, medium, high.

    Args:
        scene: Scene to sample.
        indices: Numbers of the trajectories, 0 or more.
        seed: Seed of the whole set.
        noise: Whether the noise forces act.
        inputs: Whether drawn forces and torques (wind, drives) act. Forces and torques that the
            scene itself lists always do.

    Raises:
        SceneError: A draw does not fit the scene's joints.
    """
    mechanism = Mechanism.of(scene)
    index = np.array([operator.index(number) for number in indices], dtype=np.int64)
    drafts = _begun(mechanism, len(index), inputs)
    each = [Draft(drafts, row, number, seed) for row, number in enumerate(index.tolist())]
    for term in scene.sampling:
        if isinstance(term, terms.Swing):
            _swing(term, drafts, each)
            continue
        for drawing in each:
            _DRAWS[type(term)](term, drawing)
    if noise and scene.noise > 0:
        for drawing in each:
            _add_noise(drawing)
    starts = drafts.states
    check_joints(mechanism, starts)
    check_limits(mechanism, starts)
    return Batch(
        index=index,
        position=starts.position,
        orientation=mechanism.body_orientation(starts.native),
        velocity=starts.velocity,
        angular_velocity=starts.angular_velocity,
        force=drafts.force,
        torque=drafts.torque,
    )


def distinct_starts(scene: Scene, count: int, *, noise: bool = True, inputs: bool = True) -> int:
    """Return the number of trajectories worth drawing: one if nothing is drawn, else `count`.

    Args:
        scene: Scene to sample.
        count: Number of trajectories.
        noise: Whether the noise forces act.
        inputs: Whether drawn forces and torques act.
    """
    starts = any(
        inputs or not isinstance(term, terms.HingeTorque | terms.Wind) for term in scene.sampling
    )
    return count if starts or (noise and scene.noise > 0) else 1


@dataclass(frozen=True)
class Starts:
    """Trajectories of a scene to draw, equally many for each interval."""

    trajectories: int = 1
    """Number per interval; if nothing is drawn, there is one in total."""
    seed: int = 0
    noise: bool = True
    """Whether the noise forces act."""
    inputs: bool = True
    """Whether drawn forces and torques act."""

    def draw(self, scene: Scene) -> Batch:
        """Draw the trajectories; raise SceneError as `draw_batch` does."""
        total = len(terms.INTERVALS) * self.trajectories
        count = distinct_starts(scene, total, noise=self.noise, inputs=self.inputs)
        return draw_batch(scene, range(count), seed=self.seed, noise=self.noise, inputs=self.inputs)


def has_known_forces(scene: Scene) -> bool:
    """Whether forces other than the noise act: the scene's own, wind, or servos of sliders."""
    windy = any(isinstance(term, terms.Wind) for term in scene.sampling)
    return windy or bool(scene.forces) or bool(_scene_inputs(Mechanism.of(scene))[0].any())


def noise_components(scene: Scene) -> list[int]:
    """Return the components of W in which the scene moves and the noise acts."""
    return [0, 1, 2][_MOVING[scene.dimension]]


def _begun(mechanism: Mechanism, count: int, inputs: bool) -> Drafts:
    """Begin every trajectory with the scene's own start and inputs."""

    def for_all(values: Array) -> Array:
        return np.repeat(values[None], count, axis=0)

    force, torque = map(for_all, _scene_inputs(mechanism))
    return Drafts(mechanism, assemble(mechanism).each(for_all), force, torque, inputs)


@functools.lru_cache(maxsize=16)
def _scene_inputs(mechanism: Mechanism) -> tuple[Array, Array]:
    """Return forces (step, body, 3) and torques (step, hinge) that the scene itself lists."""
    scene = mechanism.scene
    force = np.zeros((scene.clock.steps, mechanism.body_count, 3))
    torque = np.zeros((scene.clock.steps, len(mechanism.hinges)))
    bodies = {body.name: k for k, body in enumerate(scene.bodies)}
    hinges = {joint.name: k for k, joint in enumerate(mechanism.hinges)}

    def held(series: Any, hold: int) -> Array:
        return zero_order_hold(np.array(series), hold, scene.clock.steps)

    for item in scene.forces:
        force[:, bodies[item.body]] += held(item.series, item.hold)
    servos_of = by_joint(scene.servos)
    for joint in mechanism.joints:
        own = scene.joints[joint.index]
        servos = [servo for servo in servos_of[joint.name] if not servo.is_drive(own)]
        push = np.zeros(scene.clock.steps)
        for servo in servos:
            for part in servo.push(joint.rest):
                push += held(part, servo.hold)
        if joint.name in hinges:
            torque[:, hinges[joint.name]] += push
        elif any(servo.needs_input for servo in servos):
            # One end is the world, so that the axis stays and the child does not turn.
            body, sign = (joint.child, 1.0) if joint.parent == WORLD_INDEX else (joint.parent, -1.0)
            force[:, body] += sign * push[:, None] * joint.axis
    for load in scene.torques:
        torque[:, hinges[load.joint]] += held(load.series, load.hold)
    return force, torque


def _add_noise(drawing: Draft) -> None:
    scene, per_body = drawing.mechanism.scene, drawing.mechanism.particles_per_body
    sigma = scene.noise * np.sqrt(per_body * (_NOISE_FRAME / scene.clock.frame))
    force = drawing.force[..., _MOVING[scene.dimension]]
    force += sigma[:, None] * drawing.rng.standard_normal(force.shape)


def _swing(term: terms.Swing, drafts: Drafts, each: list[Draft]) -> None:
    states, hung = drafts.states, _hung(drafts.mechanism, term.bodies)
    spans = (term.polar, _ALL_ROUND, term.speed, _ALL_ROUND)
    draws = np.array([drawing.uniforms(spans, len(hung.body)) for drawing in each])
    polar, azimuth, speed, heading = np.moveaxis(draws, -1, 0).copy()[..., None]
    # Turning by `polar` about a horizontal axis leaves the body without spin about its arm.
    axis = np.concatenate([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(polar)], axis=-1)
    turn = rotation.from_vector(polar * axis)
    down = rotation.rotate(turn, hung.arm)
    first, second = rotation.normal_to(down)
    relative = speed * (np.cos(heading) * first + np.sin(heading) * second)
    rate = rotation.cross(down, relative) / rotation.squares(down)
    offsets, velocities = _pivots(hung, states, turn, rate)
    states.native[:, hung.body], states.angular_velocity[:, hung.body] = turn, rate
    for k, (body, parent) in enumerate(zip(hung.body, hung.parent, strict=True)):
        pivot, pivot_velocity = offsets[:, k], velocities[:, k]
        if parent != WORLD_INDEX:
            pivot = states.position[:, parent] + pivot
            pivot_velocity = states.velocity[:, parent] + pivot_velocity
        states.position[:, body] = pivot + down[:, k]
        states.velocity[:, body] = pivot_velocity + relative[:, k]


class _Hung:
    """Bodies that hang straight down from ball joints, as arrays; others are refused."""

    def __init__(self, mechanism: Mechanism, bodies: tuple[str, ...]) -> None:
        names = [body.name for body in mechanism.scene.bodies]
        links = {link.body: link for link in mechanism.links}
        joints = []
        for name in bodies:
            joint = links[names.index(name)].joint
            if joint is None or joint.kind != "ball":
                raise SceneError(f"sampling: {name!r} hangs on no ball joint and cannot swing")
            arm = -joint.in_child
            if not np.hypot(arm[0], arm[1]) < -1e-9 * arm[2]:
                raise SceneError(
                    f"sampling: {name!r} must hang straight down (−z) from its joint at the "
                    f"reference pose to swing, got the arm {arm.tolist()}"
                )
            joints.append(joint)
        self.body = [names.index(name) for name in bodies]
        self.parent = [joint.parent for joint in joints]
        place = {own: k for k, own in enumerate(self.body)}
        self.above = np.array(
            [place[up] if place.get(up, k) < k else -1 for k, up in enumerate(self.parent)]
        )
        """Place of the parent in this list; −1 unless it is one of those before."""
        self.arm = np.array([-joint.in_child for joint in joints])
        """Arm from the joint to the centre of mass [m], shape (hung, 3)."""
        self.in_parent = np.array([joint.in_parent for joint in joints])
        """Joint relative to the parent's centre of mass [m], shape (hung, 3)."""


_hung = functools.lru_cache(maxsize=64)(_Hung)


def _pivots(hung: _Hung, states: BodyStates, turn: Array, rate: Array) -> tuple[Array, Array]:
    """Return joints relative to their parents' centres of mass, and velocities due to spin."""
    swung = hung.above[:, None] >= 0
    native = np.where(swung, turn[:, hung.above], states.native[:, hung.parent])
    spin = np.where(swung, rate[:, hung.above], states.angular_velocity[:, hung.parent])
    arm = rotation.rotate(native, hung.in_parent)
    swing = rotation.cross(spin, arm)
    on_world = np.array(hung.parent)[:, None] == WORLD_INDEX
    return np.where(on_world, hung.in_parent, arm), np.where(on_world, 0.0, swing)


def _turn(term: terms.Turn, drawing: Draft) -> None:
    axis = np.array(term.axis)
    axis = np.ldexp(axis, -np.frexp(np.abs(axis).max())[1])  # squares neither under- nor overflow
    axis /= np.linalg.norm(axis)
    everything = list(range(drawing.mechanism.body_count))
    angle, rate = drawing.uniform(term.angle), drawing.uniform(term.rate)
    point = np.array(term.point)
    drawing.move_rigidly(everything, point, rotation.from_vector(angle * axis))
    drawing.add_twist(everything, point, rate * axis)


def _throw(term: terms.Throw, drawing: Draft) -> None:
    body = drawing.body(term.body)
    bodies = carried_by(drawing.mechanism, body)
    drawing.position[bodies] += [drawing.uniform(span) for span in term.displacement]
    center = drawing.position[body].copy()
    turn = rotation.IDENTITY
    if term.orientation == "about_y":
        turn = rotation.from_vector(np.array([0.0, drawing.rng.uniform(0.0, 2.0 * np.pi), 0.0]))
    elif term.orientation == "uniform":
        gauss = drawing.rng.standard_normal(4)
        turn = gauss / np.linalg.norm(gauss)
    drawing.move_rigidly(bodies, center, turn)
    drawing.velocity[bodies] += [drawing.uniform(span) for span in term.velocity]
    rate = np.array([drawing.uniform(span) for span in term.angular_velocity])
    drawing.add_twist(bodies, center, rate)


def _roll(term: terms.Roll, drawing: Draft) -> None:
    mechanism = drawing.mechanism
    body = drawing.body(term.body)
    bodies = carried_by(mechanism, body)
    own = mechanism.sphere_body == body
    if own.sum() != 1 or np.abs(mechanism.sphere_offset[own]).max() > _CENTRED:
        raise SceneError(
            f"sampling: {term.body!r} has {own.sum()} contact spheres; to roll it needs one, "
            "centred at its centre of mass"
        )
    rolling = np.cross([0.0, 0.0, 1.0], drawing.velocity[body]) / mechanism.sphere_radius[own]
    drawing.add_twist(bodies, drawing.position[body], drawing.uniform(term.share) * rolling)


def _hinge_torque(term: terms.HingeTorque, drawing: Draft) -> None:
    hinges = [joint.name for joint in drawing.mechanism.hinges]
    columns = [hinges.index(name) for name in term.joints]
    steps = drawing.mechanism.scene.clock.steps
    for first in range(0, steps, term.hold):
        for column in columns:
            value = drawing.uniform(term.torque)
            if term.random_sign:
                value *= 1.0 if drawing.rng.random() < 0.5 else -1.0
            if drawing.inputs:
                drawing.torque[first : first + term.hold, column] += value


def _wind(term: terms.Wind, drawing: Draft) -> None:
    mechanism = drawing.mechanism
    clock = mechanism.scene.clock
    azimuth, mean = drawing.rng.uniform(0.0, 2.0 * np.pi), drawing.uniform(term.mean)
    normal = drawing.rng.standard_normal(clock.steps)
    # The exact transition of the process over one frame (Gillespie 1996, Phys. Rev. E 54, 2084).
    decay = np.exp(-clock.frame / term.correlation_time)
    offset = np.empty(clock.steps)
    offset[0] = normal[0]
    for k in range(1, clock.steps):
        offset[k] = decay * offset[k - 1] + np.sqrt(1.0 - decay**2) * normal[k]
    strength = mean * (1.0 + term.deviation * offset)
    if drawing.inputs:
        direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        per_body = mechanism.particles_per_body[:, None] * direction
        drawing.force += strength[:, None, None] * per_body


_DRAWS: dict[type, Callable[[Any, Draft], None]] = {
    terms.Turn: _turn,
    terms.Throw: _throw,
    terms.Roll: _roll,
    terms.Lift: lift,
    terms.Pose: pose,
    terms.HingeRate: hinge_rate,
    terms.HingeTorque: _hinge_torque,
    terms.Wind: _wind,
}
"""Draws of single trajectories; `Swing` is drawn for all together."""

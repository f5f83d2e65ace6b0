"""A scene loaded into Drake: its rollouts, and the readback of its native model."""

from __future__ import annotations

import inspect
import re
from typing import Any

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Readback, Run, Settings, until_blow_up
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from . import stepping
from .model import DrakeCoordinates, listing
from .stepping import DrakeStepper


class DrakeRun(Run):
    """A run in one system that steps trajectories one after the other.

    Args:
        scene: The scene to simulate.
        settings: Method, step and options.
        scheme: Name of Drake's integrator; "" if the plant steps itself.
        impact_steps: Number of steps that an impact takes; 0 for Drake's own contact.
    """

    def __init__(self, scene: Scene, settings: Settings, scheme: str, impact_steps: float) -> None:
        self._mechanism = mechanism = Mechanism.of(scene)
        self._count = settings.substeps(scene.clock.frame)
        self._step, self._scheme = scene.clock.frame / self._count, scheme
        self._listing = listing(mechanism, 0.0 if scheme else self._step, impact_steps)
        names: dict[str, Any] = {}
        # The listing that users are shown is the program that builds the model.
        exec(compile(self._listing, "<Drake model>", "exec"), names)
        self._plant = plant = names["plant"]
        self._joints, self._bodies = names["joints"], names["bodies"]
        self._spheres = names.get("spheres", [])
        self._geometry = names["scene_graph"].model_inspector()
        self._laws, self._rotors, self._springs = (names[k] for k in ("laws", "rotors", "springs"))
        size = plant.num_positions(), plant.num_velocities()
        self._coordinates = DrakeCoordinates(mechanism, self._joints, size)
        balls = self._coordinates.balls
        self._stepper = DrakeStepper(names["system"], plant, balls, scheme, self._step)
        self._context = self._stepper.context
        self._native = mechanism.carried
        native = self._native
        hinges = list(enumerate(mechanism.hinges))
        driven = [(k, native[j.index]) for k, j in hinges if j.index in native]
        self._driven = [k for k, _ in driven]
        self._driven_at = [self._joints[body].velocity_start() for _, body in driven]
        self._servos = names["servos"]
        self._pushes = with_pushes(mechanism.drives, np.zeros((scene.clock.steps, 0)))
        self._looped = [(k, hinge) for k, hinge in hinges if hinge.index not in native]
        self.size = ModelSize(plant.num_velocities(), _rows(mechanism), count_pairs(mechanism))

    def rollout(self, batch: Batch) -> Trajectory:
        q, v, turns = (
            np.full((len(batch), batch.steps + 1, *part.shape[1:]), np.nan)
            for part in self._start(batch)
        )
        # A motion that blows up may overflow before it is cut off.
        with np.errstate(over="ignore", invalid="ignore"):
            failures = [
                self._simulate(batch, row, q[row], v[row], turns[row]) for row in range(len(batch))
            ]
            bodies = to_bodies(self._mechanism, self._coordinates.to_links(q, v, turns))
            return until_blow_up(self._mechanism, bodies, failures)

    def _simulate(self, batch: Batch, row: int, q: Array, v: Array, turns: Array) -> Failure | None:
        """Fill in a trajectory; return the failure that ended it, if any."""
        self._put(batch[[row]])
        for frame in range(batch.steps + 1):
            q[frame] = self._plant.GetPositions(self._context)
            v[frame] = self._plant.GetVelocities(self._context)
            turns[frame] = self._stepper.turns
            if frame == batch.steps:
                break
            try:
                self._stepper.actuate(self._actuation(self._pushes[frame]))
                self._advance(batch.force[row, frame], batch.torque[row, frame])
            except (RuntimeError, ValueError) as error:
                return Failure(frame + 1, str(error).partition(". ")[0])
        return None

    def _actuation(self, push: Array) -> Array:
        """Return the efforts of servos' targets at coordinates and rates of 0, by actuator."""
        actuation = np.zeros(self._plant.num_actuators())
        actuation[[servo.input_start() for servo in self._servos]] = push
        return actuation

    def _advance(self, force: Array, torque: Array) -> None:
        """Take the steps of a frame."""
        efforts = np.zeros(self._plant.num_velocities())
        efforts[self._driven_at] = torque[self._driven]
        self._plant.get_applied_generalized_force_input_port().FixValue(self._context, efforts)
        # The axis of a hinge that closes a loop turns with its bodies within the frame.
        twisted = any(torque[k] for k, _ in self._looped)
        for count in [1] * self._count if twisted else [self._count]:
            self._push(force, torque)
            self._stepper.advance(count)

    def _push(self, force: Array, torque: Array) -> None:
        """Apply forces at centres of mass and the torques of hinges that close loops."""
        moment = np.zeros_like(force)
        for k, hinge in self._looped:
            if torque[k]:
                axis = self._to_world(hinge.child, hinge.axis)
                for body, sign in ((hinge.child, 1.0), (hinge.parent, -1.0)):
                    if body != WORLD_INDEX:
                        moment[body] += sign * torque[k] * axis
        loads = []
        for body in np.flatnonzero(force.any(axis=1) | moment.any(axis=1)).tolist():
            load = ExternallyAppliedSpatialForce()
            load.body_index = self._bodies[body].index()
            load.F_Bq_W = SpatialForce(moment[body], force[body])
            loads.append(load)
        self._plant.get_applied_spatial_force_input_port().FixValue(self._context, loads)

    def _to_world(self, body: int, axis: Array) -> Array:
        """Turn an axis that is fixed in a body into W."""
        if body == WORLD_INDEX:
            return axis
        return np.asarray(self._pose(body).rotation() @ axis)

    def _pose(self, body: int) -> Any:
        return self._plant.EvalBodyPoseInWorld(self._context, self._bodies[body])

    def readback(self, batch: Batch) -> Readback:
        self._put(batch[:1])
        bodies = range(self._mechanism.body_count)
        inertias = [self._bodies[k].CalcSpatialInertiaInBodyFrame(self._context) for k in bodies]
        poses = [self._pose(k) for k in bodies]
        speeds = [
            self._plant.EvalBodySpatialVelocityInWorld(self._context, self._bodies[k])
            for k in bodies
        ]
        native = rotation.from_matrix(np.array([pose.rotation().matrix() for pose in poses]))
        return Readback(
            mass=np.array([each.get_mass() for each in inertias]),
            inertia=np.array([_central(each) for each in inertias]),
            com=np.array([p @ i.get_com() for p, i in zip(poses, inertias, strict=True)]),
            orientation=self._mechanism.body_orientation(native),
            velocity=np.array([speed.translational() for speed in speeds]),
            angular_velocity=np.array([speed.rotational() for speed in speeds]),
            gravity=np.array(self._plant.gravity_field().gravity_vector()),
            step=self._plant.time_step() or self._step,
            joint_axis=joint_axes(self._mechanism, self._axis),
            damping=np.concatenate([np.zeros(0), *map(self._undue_damping, self._mechanism.links)]),
            anchor=joint_anchors(self._mechanism, self._anchors),
            spring=np.array([self._spring(each) for each in self._springs]).reshape(-1, 4),
            law=joint_laws(self._mechanism, self._law),
            drive=np.array([_gains(servo) for servo in self._servos]),
            armature=np.array([self._armature(j) for j in self._mechanism.rotors]),
            contact=np.array([self._contact(each) for each in self._spheres]).reshape(-1, 3),
            sphere=np.array([self._centre(each) for each in self._spheres]).reshape(-1, 3),
            limits=np.array([self._limits(j) for j in self._mechanism.limited]).reshape(-1, 2),
        )

    def _undue_damping(self, link: Link) -> Array:
        damping = link.joint.damping if link.joint else 0.0
        return np.asarray(self._joints[link.body].GetDampingVector(self._context) - damping)

    def _axis(self, link: Link) -> Array:
        joint = self._joints[link.body]
        hinge = link.joint is not None and link.joint.kind == "hinge"
        axis = joint.revolute_axis() if hinge else joint.translation_axis()
        return np.asarray(self._at(joint.frame_on_parent()).rotation() @ axis)

    def _anchors(self, link: Link) -> tuple[Array, Array]:
        joint = self._joints[link.body]
        first, second = self._at(joint.frame_on_parent()), self._at(joint.frame_on_child())
        return first.translation(), second.translation()

    def _at(self, frame: Any) -> Any:
        return frame.CalcPoseInWorld(self._context)

    def _spring(self, spring: Any) -> tuple[float, float, float, float]:
        ends = (spring.bodyA(), spring.p_AP()), (spring.bodyB(), spring.p_BQ())
        first, second = (self._at(body.body_frame()) @ point for body, point in ends)
        length = float(np.linalg.norm(second - first))
        return spring.stiffness(), spring.damping(), spring.free_length(), length

    def _law(self, link: Link, joint: PlacedJoint) -> tuple[float, float, float]:
        damping, law = self._joints[link.body].default_damping(), self._laws.get(link.body)
        if law is None:
            return 0.0, damping, joint.rest
        if joint.kind == "hinge":
            return law.default_stiffness(), damping, law.default_nominal_angle()
        return law.stiffness(), damping, law.nominal_position()

    def _armature(self, joint: PlacedJoint) -> float:
        return float(self._rotors[self._native[joint.index]].default_reflected_inertia())

    def _limits(self, joint: PlacedJoint) -> tuple[float, float]:
        native = self._joints[self._native[joint.index]]
        return native.position_lower_limit(), native.position_upper_limit()

    def _contact(self, sphere: Any) -> tuple[float, float, float]:
        """Return a sphere's radius and friction; Drake has no coefficient of restitution."""
        surface = self._geometry.GetProximityProperties(sphere)
        friction = surface.GetProperty("material", "coulomb_friction").dynamic_friction()
        return self._geometry.GetShape(sphere).radius(), friction, np.nan

    def _centre(self, sphere: Any) -> Array:
        body = self._plant.GetBodyFromFrameId(self._geometry.GetFrameId(sphere))
        here = self._geometry.GetPoseInFrame(sphere).translation()
        return np.asarray(self._at(body.body_frame()) @ here)

    def native(self, batch: Batch) -> str:
        q, v, turns = self._start(batch[:1])
        return _SCRIPT.format(
            listing=self._listing,
            turning="\n\n".join(inspect.getsource(each) for each in _TURNING),
            stepping=_bare(inspect.getsource(stepping)),
            balls=[self._mechanism.links[k].body for k in self._coordinates.ball],
            scheme=self._scheme,
            step=self._step,
            q=q[0].tolist(),
            v=v[0].tolist(),
            turns=turns[0].tolist(),
            push=self._actuation(self._pushes[0]).tolist(),
            count=self._count * self._mechanism.scene.clock.steps,
        )

    def _put(self, batch: Batch) -> None:
        """Set the system to the start of a batch of one trajectory."""
        self._stepper.start(*(part[0] for part in self._start(batch)))

    def _start(self, batch: Batch) -> tuple[Array, Array, Array]:
        links = to_links(self._mechanism, BodyStates.of(self._mechanism, batch))
        return self._coordinates.of_links(links)

    def close(self) -> None:
        vars(self).clear()


def _gains(servo: Any) -> tuple[float, float, float]:
    gains, limit = servo.get_controller_gains(), servo.effort_limit()
    return gains.p, gains.d, limit if np.isfinite(limit) else 0.0


def _central(inertia: Any) -> Array:
    """Return a spatial inertia's tensor about the centre of mass."""
    tensor = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    return np.asarray(tensor.CopyToFullMatrix3())


def _rows(mechanism: Mechanism) -> int:
    """Count the constraint rows, contacts excluded."""
    rows = {"ball": 3, "hinge": 6, "fixed": 6}
    closing = sum(rows[joint.kind] for joint in mechanism.loops)
    return closing + len(mechanism.distances) + len(mechanism.couplings)


def _bare(source: str) -> str:
    """Strip a module's docstring and its imports from the toolkit."""
    return re.sub(r"^from mbds_xsim.*\n", "", source.partition('"""\n\n')[2], flags=re.M)


_TURNING = (
    rotation.norm,
    rotation.multiply,
    rotation.conjugate,
    rotation.rotate,
    rotation.from_vector,
)
_SCRIPT = """\
{stepping}

{turning}

Array = np.ndarray
{listing}

stepper = DrakeStepper(system, plant, [joints[k] for k in {balls}], {scheme!r}, {step!r})
stepper.start(np.array({q}), np.array({v}), np.array({turns}).reshape(-1, 4))
stepper.actuate(np.array({push}))
# Other inputs are left out: the plant has ports for generalised and spatial forces.
stepper.advance({count})
for k in sorted(bodies):
    pose = plant.EvalBodyPoseInWorld(stepper.context, bodies[k])
    speed = plant.EvalBodySpatialVelocityInWorld(stepper.context, bodies[k])
    parts = pose.translation(), pose.rotation().matrix(), speed.translational(), speed.rotational()
    print(bodies[k].name(), *(part.tolist() for part in parts))
"""

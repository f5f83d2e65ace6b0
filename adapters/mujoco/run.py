"""A scene loaded into MuJoCo: its rollouts, and the readback of its native model."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.xml import indented
from mbds_xsim.scene.collisions import passed
from mbds_xsim.scene.joint_space import BodyStates, to_links
from mbds_xsim.scene.mechanism import Link, Mechanism, PlacedJoint
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.spin import carried
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import (
    ModelSize,
    Readback,
    blow_up,
    first_failures,
    recorded,
    too_fast,
)
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from .contact import SphereGeoms
from .friction import lost_friction
from .loops import soften_loops
from .model import CLOSING_POINTS, StepOptions, closing_point, mjcf, open_loops, with_start
from .spinless import Bending
from .state import Coordinates, Frames, Hanger, joint_name
from .steps import FinerNearGround, FinerWhereFast, OneCall, turning_rates

_UNWANTED = ("dof_dampingpoly", "tendon_dampingpoly", "tendon_frictionloss", "actuator_damping",
             "actuator_dampingpoly")  # fmt: skip
"""Arrays of a model with losses that no scene has."""
_STATES = 16_000  # body states that are simulated at a time


class ModelRun(Bending):
    """A run of one native model; other steppers of MuJoCo's models read its model and data, too."""

    model: Any
    """MjModel."""
    data: Any
    """MjData."""
    coordinates: Coordinates
    bodies: Index
    """MuJoCo's numbers of the scene's bodies."""

    def __init__(
        self,
        mechanism: Mechanism,
        stepping: StepOptions,
        method: str,
        count: int,
        division: int,
        turn: float,
        idle: Array | None = None,
    ) -> None:
        self._mechanism = mechanism
        self._idle = np.zeros((mechanism.body_count, 3)) if idle is None else idle
        self._division = division
        self._xml = indented(mjcf(mechanism, stepping, self._idle))
        self.model = mujoco.MjModel.from_xml_string(self._xml)
        self.data = mujoco.MjData(self.model)
        self._hanger = Hanger(mechanism, self._idle)
        self.coordinates = Coordinates(self.model, mechanism, self._idle)
        # MuJoCo numbers bodies depth first, so only names match.
        names = [body.name for body in mechanism.scene.bodies]
        self.bodies = np.array([self.model.body(name).id for name in names])
        self._order = np.argsort(self.bodies)
        self._spheres = SphereGeoms(self.model, mechanism)
        self._stepper: OneCall | FinerNearGround | FinerWhereFast = OneCall(count)
        if division:
            more = count, division, lost_friction(mechanism)
            self._stepper = FinerNearGround(self.model, self._spheres, method, *more)
        elif turn and (turning := turning_rates(self.model)).size:
            self._stepper = FinerWhereFast(self.model, turning, count, turn)
        mujoco.mj_forward(self.model, self.data)
        self._remark = soften_loops(self.model, self.data)
        self.size = ModelSize(
            coordinates=self.model.nv,
            constraints=self.data.ne,
            contact_pairs=self.model.npair,
        )

    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        # A few at a time: fresh memory for many costs more time than the computation.
        size = max(1, _STATES // ((batch.steps + 1) * self._mechanism.body_count))
        rows = range(0, max(1, len(batch)), size)
        parts = [self._simulate(batch[row : row + size]) for row in rows]
        return Trajectory.joined([part for part, _ in parts]), np.concatenate([b for _, b in parts])

    def _simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        qpos, qvel = self.start(batch)
        frames = Frames(self.model, self.data, self.bodies, len(batch), batch.steps + 1)
        bends = np.zeros((len(batch), batch.steps + 1, len(self.coordinates.second)))
        reasons = []
        with _capture_warnings() as warnings:
            for row in range(len(batch)):
                self._put(qpos[row], qvel[row])
                self._record(batch[[row]], frames, row, bends[row], warnings)
                reasons.append(warnings[0] if warnings else None)
                warnings.clear()
        bend = np.abs(bends).max(axis=(1, 2), initial=0.0)
        return self.truncate(batch, frames.states(), reasons), bend

    def start(self, batch: Batch) -> tuple[Array, Array]:
        """Return qpos and qvel of the batch's starts, shapes (trajectory, nq) and (…, nv)."""
        bodies = BodyStates.of(self._mechanism, batch)
        if self._idle.any():
            bodies = self._hanger.turn_rods(bodies)
        return self.coordinates.from_links(to_links(self._mechanism, bodies))

    def _put(self, qpos: Array, qvel: Array) -> None:
        """Set a start without the solver's memory of an earlier trajectory."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel

    def _record(
        self, one: Batch, frames: Frames, row: int, bends: Array, warnings: list[str]
    ) -> None:
        """Step through one trajectory; frames from a warning on stay NaN."""
        model, data = self.model, self.data
        frame, placed = self._stepper.frame, self._stepper.placed
        # Forces act at centres of mass, in W, in every stage of a step. MuJoCo's first body is W.
        push, force = data.xfrc_applied[1:, :3], one.force[0][:, self._order]
        drive, torque = data.ctrl, with_pushes(self._mechanism.drives, one.torque[0])
        self._spheres.set_load(model, force)
        qpos, second = data.qpos, self.coordinates.second
        frames.keep(row, 0)
        for k in range(one.steps):
            push[...] = force[k]
            drive[...] = torque[k]
            if reason := frame(model, data):
                warnings.append(reason)
            if warnings:
                return
            frames.keep(row, k + 1, placed=placed)
            if len(second):
                bends[k + 1] = qpos[second]

    def truncate(
        self, batch: Batch, bodies: BodyStates, reasons: Sequence[str | None]
    ) -> Trajectory:
        """Cut every trajectory off at its first frame with NaN, a blow-up or a sunk sphere.

        Args:
            batch: The batch that was simulated.
            bodies: Its frames; rods without spin are turned as their axes carry them along.
            reasons: Reason by trajectory why it ended before that; None if it did not.
        """
        mechanism = self._mechanism
        if self._idle.any():
            start = mechanism.native_rotation(batch.orientation)
            bodies = carried(self._idle, start, bodies, mechanism.scene.clock.frame)
        blown = too_fast(mechanism, bodies.velocity)
        sunk = passed(mechanism, bodies.position, bodies.native)

        def reason(row: int, frame: int) -> str:
            if warning := reasons[row]:
                return warning
            message = "a contact sphere is in the ground, or in another, with its centre"
            return blow_up(mechanism) if blown[row, frame] else message

        return recorded(mechanism, bodies, first_failures(blown | sunk, reason))

    def readback(self, batch: Batch) -> Readback:
        qpos, qvel = self.start(batch[:1])
        self._put(qpos[0], qvel[0])
        mujoco.mj_forward(self.model, self.data)
        return self.read()

    def read(self) -> Readback:
        """Read back the model, and the bodies in its present state."""
        model, data = self.model, self.data
        principal = rotation.matrix(model.body_iquat[self.bodies])
        twists = np.array([self._twist(body) for body in self.bodies])
        return Readback(
            mass=model.body_mass[self.bodies].copy(),
            inertia=np.einsum(
                "kij,kj,klj->kil", principal, model.body_inertia[self.bodies], principal
            ),
            com=data.xipos[self.bodies].copy(),
            orientation=self._mechanism.body_orientation(data.xquat[self.bodies]),
            velocity=twists[:, 3:],
            angular_velocity=twists[:, :3],
            gravity=model.opt.gravity.copy(),
            step=float(model.opt.timestep) * (self._division or 1),
            joint_axis=joint_axes(self._mechanism, self._axis, self._loop_axis),
            damping=self._undue_damping(),
            **self._spheres.readback(model, data),
            anchor=self._anchors(),
            spring=self._springs(),
            law=joint_laws(self._mechanism, self._law),
            coupling=self._couplings(),
            armature=model.dof_armature[self._dofs(self._mechanism.rotors)],
            friction=model.dof_frictionloss[self._dofs(self._mechanism.frictional)],
            limits=self._limits(),
            drive=self._drives(),
        )

    def _twist(self, body: int) -> Array:
        """Return the angular velocity, then the velocity of the centre of mass, in W."""
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, body, twist, 0)
        return twist

    def _axis(self, link: Link) -> Array:
        assert link.joint is not None
        return np.asarray(self.data.joint(joint_name(link.joint.name)).xaxis)

    def _loop_axis(self, hinge: PlacedJoint) -> Array:
        """Return the direction through the two points that close a hinge; NaN if nothing does."""
        if hinge not in open_loops(self._mechanism):
            return np.full(3, np.nan)
        ends = [self.data.site(f"{closing_point(hinge, k)} parent").xpos for k in (0, 1)]
        return np.asarray((ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]))

    def _link_anchor(self, link: Link) -> tuple[Array, Array] | None:
        """Return the anchor of a link's first native joint; None if it is welded to its parent."""
        model, body = self.model, self.bodies[link.body]
        if not model.body_jntnum[body]:
            return None
        point = model.jnt_pos[model.body_jntadr[body]]
        above = self._place(model.body_parentid[body], model.body_pos[body] + point)
        return above, self._place(body, point)

    def _anchors(self) -> Array:
        """Return the joints' anchors as fixed in the parent and in the child, in W."""
        data, anchors = self.data, joint_anchors(self._mechanism, self._link_anchor)
        for loop in open_loops(self._mechanism):
            points = range(len(CLOSING_POINTS[loop.kind]))
            for end, side in enumerate(("parent", "child")):
                sites = [data.site(f"{closing_point(loop, k)} {side}").xpos for k in points]
                anchors[loop.index, end] = np.mean(sites, axis=0)
        return anchors

    def _springs(self) -> Array:
        """Read back the spring tendons, which follow the links'; a slack range has rest NaN."""
        model = self.model
        shortest, longest = model.tendon_lengthspring.T
        rest = np.where(shortest == longest, longest, np.nan)
        constants = (model.tendon_stiffness, model.tendon_damping, rest, self.data.ten_length)
        return np.stack(constants, axis=1)[len(self._mechanism.distances) :]

    def _couplings(self) -> Array:
        model, kind = self.model, mujoco.mjtEq.mjEQ_JOINT
        laws = [model.eq_data[e, :5] for e in range(model.neq) if model.eq_type[e] == kind]
        return np.array(laws).reshape(-1, 5)[:, [1, 0]]

    def _law(self, _link: Link, joint: PlacedJoint) -> tuple[float, float, float]:
        model, number = self.model, self.model.joint(joint_name(joint.name)).id
        damping = model.dof_damping[model.jnt_dofadr[number]]
        return model.jnt_stiffness[number], damping, model.qpos_spring[model.jnt_qposadr[number]]

    def _limits(self) -> Array:
        numbers = self._numbers(self._mechanism.limited)
        limited = self.model.jnt_limited[numbers].astype(bool)
        return np.where(limited[:, None], self.model.jnt_range[numbers], np.inf)

    def _drives(self) -> Array:
        model, first = self.model, len(self._mechanism.hinges)
        limited = model.actuator_forcelimited[first:].astype(bool)
        limit = np.where(limited, model.actuator_forcerange[first:, 1], 0.0)
        return np.column_stack([-model.actuator_biasprm[first:, 1:3], limit])

    def _numbers(self, joints: tuple[PlacedJoint, ...]) -> list[int]:
        return [self.model.joint(joint_name(joint.name)).id for joint in joints]

    def _dofs(self, joints: tuple[PlacedJoint, ...]) -> Index:
        return np.asarray(self.model.jnt_dofadr[self._numbers(joints)])

    def _place(self, body: int, point: Array) -> Array:
        """Return a point of a body of MuJoCo in W."""
        turn = self.data.xmat[body].reshape(3, 3)
        return np.asarray(self.data.xpos[body] + turn @ point)

    def _undue_damping(self) -> Array:
        model = self.model
        nominal = [0.0] * len(self._mechanism.distances)
        nominal += [spring.damping for spring in self._mechanism.springs]
        damping, compliant = model.dof_damping.copy(), self._mechanism.compliant
        damping[self._dofs(compliant)] -= [joint.damping for joint in compliant]
        friction = model.dof_frictionloss.copy()
        friction[self._dofs(self._mechanism.frictional)] = 0.0
        unwanted = [getattr(model, name).ravel() for name in _UNWANTED]
        fluid = [model.opt.density, model.opt.viscosity]
        limits = [model.jnt_limited.sum() - len(self._mechanism.limited)]
        tendons = model.tendon_damping - nominal
        return np.concatenate([tendons, damping, friction, *unwanted, fluid, limits])

    def native(self, batch: Batch) -> str:
        qpos, qvel = self.start(batch)
        inputs = np.zeros((1, len(self._mechanism.hinges)))
        command = with_pushes(self._mechanism.drives, inputs)[0]
        remark = f"{self._stepper.remark}{self._remark}"
        return with_start(self._xml, qpos[0], qvel[0], command, remark)

    def close(self) -> None:
        self.model = self.data = None


@contextlib.contextmanager
def _capture_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would print and write to a file."""
    texts: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(texts.append)
    try:
        yield texts
    finally:
        mujoco.set_mju_user_warning(before)

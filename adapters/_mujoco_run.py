"""A loaded model: trajectories out of it, and what it holds."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.engine import ModelSize, Readback, Run
from mbds_xsim.joint_space import BodyStates, LinkStates, to_links
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.spin import carried
from mbds_xsim.state import Batch, Failure, Trajectory

from ._mujoco_bodies import Frames
from ._mujoco_cardan import Hanger
from ._mujoco_contact import Spheres, sunk_spheres
from ._mujoco_model import CLOSING_POINTS, Stepping, closing_point, mjcf, text, with_start
from ._mujoco_state import Coordinates
from ._mujoco_steps import FinerNearGround, FinerWhereFast, OneCall, Stepper, turning_rates

__all__ = ["ModelRun"]

Array = NDArray[np.float64]

# A body that crosses so many scene lengths in a frame has blown up.
_LENGTHS_PER_FRAME = 1e3
_STATES = 16_000  # of bodies that are worked on at a time


class ModelRun(Run):
    """One native model and its state."""

    def __init__(
        self,
        mechanism: Mechanism,
        stepping: Stepping,
        method: str,
        count: int,
        division: int,
        turn: float,
        idle: Array | None = None,
    ) -> None:
        self._mechanism = mechanism
        self._idle = np.zeros((mechanism.body_count, 3)) if idle is None else idle
        self._division = division
        self._xml = text(mjcf(mechanism, stepping, self._idle))
        self._model: Any = mujoco.MjModel.from_xml_string(self._xml)
        self._data: Any = mujoco.MjData(self._model)
        self._hanger = Hanger(mechanism, self._idle)
        self._coordinates = Coordinates(self._model, mechanism, self._idle)
        # MuJoCo numbers bodies depth first, so only names tell.
        names = [body.name for body in mechanism.scene.bodies]
        self._bodies = np.array([self._model.body(name).id for name in names])
        self._order = np.argsort(self._bodies)
        self._spheres = Spheres(self._model, mechanism)
        self._stepper: Stepper = OneCall(count)
        if division:
            self._stepper = FinerNearGround(self._model, self._spheres, method, count, division)
        elif turn and (turning := turning_rates(self._model)).size:
            self._stepper = FinerWhereFast(self._model, turning, count, turn)
        mujoco.mj_forward(self._model, self._data)
        self.size = ModelSize(
            coordinates=self._model.nv,
            constraints=self._data.ne,
            contact_pairs=self._model.npair,
        )

    def rollout(self, batch: Batch) -> Trajectory:
        return self.simulate(batch)[0]

    def simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        """Roll out; tell too how far Cardan joints were bent at frames [rad], (trajectory,)."""
        # A few at a time: fresh memory for many costs more than their numbers.
        size = max(1, _STATES // ((batch.steps + 1) * self._mechanism.body_count))
        rows = range(0, max(1, len(batch)), size)
        parts = [self._simulate(batch[row : row + size]) for row in rows]
        return Trajectory.joined([part for part, _ in parts]), np.concatenate([b for _, b in parts])

    def _simulate(self, batch: Batch) -> tuple[Trajectory, Array]:
        qpos, qvel = self._start(batch)
        frames = self.frames(len(batch), batch.steps + 1)
        bends = np.zeros((len(batch), batch.steps + 1, len(self._coordinates.second)))
        reasons = []
        with _captured_warnings() as warnings:
            for row in range(len(batch)):
                self._put(qpos[row], qvel[row])
                self._record(batch[[row]], frames, row, bends[row], warnings)
                reasons.append(warnings[0] if warnings else None)
                warnings.clear()
        bodies = frames.states()
        if self._idle.any():
            start = self._mechanism.native_rotation(batch.orientation)
            bodies = carried(self._idle, start, bodies, self._mechanism.scene.clock.frame)
        bend = np.abs(bends).max(axis=(1, 2), initial=0.0)
        return self._trajectory(bodies, reasons), bend

    def frames(self, count: int, length: int) -> Frames:
        """Make room for trajectories of some length."""
        return Frames(self._model, self._data, self._bodies, count, length)

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        bodies = BodyStates(
            batch.position,
            self._mechanism.native_rotation(batch.orientation),
            batch.velocity,
            batch.angular_velocity,
        )
        return self._coordinates.from_links(self._to_links(bodies))

    def _to_links(self, bodies: BodyStates) -> LinkStates:
        if self._idle.any():
            bodies = self._hanger.hung(bodies)
        return to_links(self._mechanism, bodies)

    def _put(self, qpos: Array, qvel: Array) -> None:
        """Start afresh, without the solver's memory of an earlier trajectory."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = qpos, qvel

    def _record(
        self, one: Batch, frames: Frames, row: int, bends: Array, warnings: list[str]
    ) -> None:
        """Step through one trajectory; frames from a warning on stay as they are."""
        model, data = self._model, self._data
        frame, placed = self._stepper.frame, self._stepper.placed
        # At the centre of mass and along W in every stage of a step. MuJoCo's first body is W.
        push, force = data.xfrc_applied[1:, :3], one.force[0][:, self._order]
        drive, torque = data.ctrl, one.torque[0]
        qpos, second = data.qpos, self._coordinates.second
        frames.keep(row, 0)
        for k in range(one.steps):
            push[...] = force[k]
            drive[...] = torque[k]
            frame(model, data)
            if warnings:
                return
            frames.keep(row, k + 1, placed=placed)
            if len(second):
                bends[k + 1] = qpos[second]

    def _trajectory(self, bodies: BodyStates, reasons: list[str | None]) -> Trajectory:
        """Cut every trajectory off at its first frame that is not a number or a blow-up."""
        scene = self._mechanism.scene
        fastest = rotation.norm(bodies.velocity).max(axis=-1)
        limit = _LENGTHS_PER_FRAME * scene.length / scene.clock.frame
        sunk = sunk_spheres(self._mechanism, bodies)
        failures: list[Failure | None] = []
        for row, reason in enumerate(reasons):
            # Written so that NaN counts as bad.
            blown = ~(fastest[row] < limit)
            bad = np.flatnonzero(blown | sunk[row])
            if not len(bad):
                failures.append(None)
                continue
            what = (
                f"a body's speed passes {limit:.3g} m/s or is not a number"
                if blown[bad[0]]
                else "a contact sphere is in the ground with its centre"
            )
            failures.append(Failure(int(bad[0]), reason or what))
            for values in (
                bodies.position,
                bodies.native,
                bodies.velocity,
                bodies.angular_velocity,
            ):
                values[row, bad[0] :] = np.nan
        return Trajectory(
            scene.clock.frame * np.arange(fastest.shape[1]),
            bodies.position,
            self._mechanism.body_orientation(bodies.native),
            bodies.velocity,
            bodies.angular_velocity,
            tuple(failures),
        )

    def readback(self, batch: Batch) -> Readback:
        model, data = self._model, self._data
        qpos, qvel = self._start(batch[:1])
        self._put(qpos[0], qvel[0])
        mujoco.mj_forward(model, data)
        principal = rotation.matrix(model.body_iquat[self._bodies])
        twists = np.array([self._twist(body) for body in self._bodies])
        return Readback(
            mass=model.body_mass[self._bodies].copy(),
            inertia=np.einsum(
                "kij,kj,klj->kil", principal, model.body_inertia[self._bodies], principal
            ),
            com=data.xipos[self._bodies].copy(),
            orientation=self._mechanism.body_orientation(data.xquat[self._bodies]),
            velocity=twists[:, 3:],
            angular_velocity=twists[:, :3],
            gravity=model.opt.gravity.copy(),
            step=float(model.opt.timestep) * (self._division or 1),
            joint_axis=self._joint_axes(),
            damping=self._unasked_damping(),
            contact=self._spheres.coefficients(model),
            sphere=self._spheres.centers(data),
            anchor=self._anchors(),
            spring=self._springs(),
        )

    def _twist(self, body: int) -> Array:
        """Angular velocity, then velocity of the centre of mass, in W."""
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_BODY, body, twist, 0)
        return twist

    def _joint_axes(self) -> Array:
        """Of a loop's hinge, the line through the two points that close it."""
        data = self._data
        in_tree = {link.joint.index: link.joint for link in self._mechanism.links if link.joint}
        axes = []
        for joint in self._mechanism.joints:
            if joint.kind not in ("hinge", "slider"):
                continue
            if joint.index in in_tree:
                turned = 1.0 if in_tree[joint.index].parent == joint.parent else -1.0
                axes.append(turned * data.joint(joint.name).xaxis)
            else:
                ends = [data.site(f"{closing_point(joint, k)} parent").xpos for k in (0, 1)]
                axes.append((ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]))
        return np.array(axes).reshape(-1, 3)

    def _anchors(self) -> Array:
        """As fixed in the parent and in the child, in W; a fixed joint has no place in MuJoCo."""
        data, anchors = self._data, np.full((len(self._mechanism.joints), 2, 3), np.nan)
        for link in self._mechanism.links:
            if link.joint is None:
                continue
            body = self._bodies[link.body]
            forwards = self._mechanism.joints[link.joint.index].child == link.body
            for joint in self._model.body(body).jntadr[: self._model.body(body).jntnum[0]]:
                above = self._model.body_pos[body] + self._model.jnt_pos[joint]
                ends = (
                    self._place(self._model.body_parentid[body], above),
                    self._place(body, self._model.jnt_pos[joint]),
                )
                anchors[link.joint.index] = ends if forwards else ends[::-1]
        for loop in self._mechanism.loops:
            points = range(len(CLOSING_POINTS[loop.kind]))
            for end, side in enumerate(("parent", "child") if points else ()):
                sites = [data.site(f"{closing_point(loop, k)} {side}").xpos for k in points]
                anchors[loop.index, end] = np.mean(sites, axis=0)
        return anchors

    def _springs(self) -> Array:
        """Of the tendons behind those of the distance links; a slack range is no rest length."""
        model, first = self._model, len(self._mechanism.distances)
        shortest, longest = model.tendon_lengthspring[first:].T
        rest = np.where(shortest == longest, longest, np.nan)
        length = self._data.ten_length[first:]
        constants = (model.tendon_stiffness[first:], model.tendon_damping[first:], rest, length)
        return np.stack(constants, axis=1)

    def _place(self, body: int, point: Array) -> Array:
        """Place a point of MuJoCo's body in W."""
        turn = self._data.xmat[body].reshape(3, 3)
        return np.asarray(self._data.xpos[body] + turn @ point)

    def _unasked_damping(self) -> Array:
        model = self._model
        asked = [0.0] * len(self._mechanism.distances)
        asked += [spring.damping for spring in self._mechanism.springs]
        return np.concatenate(
            [
                model.tendon_damping - asked,
                *(
                    getattr(model, name).ravel()
                    for name in (
                        "dof_damping",
                        "dof_dampingpoly",
                        "dof_frictionloss",
                        "tendon_dampingpoly",
                        "tendon_frictionloss",
                        "actuator_damping",
                        "actuator_dampingpoly",
                    )
                ),
                [model.opt.density, model.opt.viscosity],
            ]
        )

    def native(self, batch: Batch) -> str:
        qpos, qvel = self._start(batch)
        return with_start(self._xml, qpos[0], qvel[0], self._stepper.remark)

    def close(self) -> None:
        self._model = self._data = None


@contextlib.contextmanager
def _captured_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would print and write to a file."""
    texts: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(texts.append)
    try:
        yield texts
    finally:
        mujoco.set_mju_user_warning(before)

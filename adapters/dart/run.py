"""A scene loaded into DART: its rollouts, and the readback of its native model."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator
from typing import Any

import dartpy
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.process import redirected
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import ModelSize, Readback, Run, Settings, earlier, recorded
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from .contact import ContactSolver, contact_failures, contact_readback
from .model import SkeletonModel
from .script import build_listing, script
from .stepping import DartStepper, FrameLoads

# A joint rate [rad/s or m/s] that only a blow-up reaches.
_BLOW_UP = 1e5
_INPUTS = """
# Inputs are left out. Of a frame: joints[k].setForce(0, torque) of each driven hinge; of a step:
# bodies[k].setExtForce(force) of each pushed body, as DART turns forces with bodies.
"""


class DartRun(Run):
    """A run in a DART world of its own, stepped frame by frame.

    Args:
        scene: The scene to simulate.
        settings: Method, step and options.
        stepper: Stepper of the method.
        error_reduction: Share of a loop's gap that is closed in a step.
        contact: Statements that put spheres and the ground into the model.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        stepper: type[DartStepper],
        error_reduction: float,
        contact: Iterable[str],
    ) -> None:
        self._mechanism = Mechanism.of(scene)
        self._step_count = settings.substeps(scene.clock.frame)
        self._step = scene.clock.frame / self._step_count
        self._frame = scene.clock.frame
        self._error_reduction = error_reduction
        self._listing = build_listing(self._mechanism, self._step, error_reduction, contact)
        with _error_reduction(error_reduction):
            self._model = SkeletonModel(self._mechanism, self._listing)
        self._loads = FrameLoads(self._model, self._step)
        self._contact = ContactSolver(self._model.world)
        self._stepper = stepper(self._model, self._loads, self._step)
        rows = {"ball": 3, "hinge": 6, "fixed": 6}
        self.size = ModelSize(
            self._model.coordinate_count,
            sum(rows[joint.kind] for joint in self._mechanism.loops),
            count_pairs(self._mechanism),
        )

    def rollout(self, batch: Batch) -> Trajectory:
        model = self._model
        start_q, start_u = self._start(batch)
        q = np.full((len(batch), batch.steps + 1, model.coordinate_count), np.nan)
        u = np.full_like(q, np.nan)
        inputs = with_pushes(self._mechanism.drives, batch.torque)
        with _error_reduction(self._error_reduction), _capture_warnings() as warnings:
            failures = tuple(
                self._roll((batch.force[row], inputs[row]), *start, warnings)
                for row, start in enumerate(zip(start_q, start_u, q, u, strict=True))
            )
        bodies = model.body_states(q, u)
        if self._mechanism.scene.contacts:
            violations = contact_failures(self._mechanism, bodies, self._frame)
            failures = earlier(failures, violations)
        motion = recorded(self._mechanism, bodies, failures)
        orientation = rotation.continuous(motion.orientation, batch.orientation)
        return dataclasses.replace(motion, orientation=orientation)

    def _roll(
        self,
        inputs: tuple[Array, Array],
        start_q: Array,
        start_u: Array,
        q: Array,
        u: Array,
        warnings: int,
    ) -> Failure | None:
        """Fill q and u (frame, coordinate) with one trajectory; return its failure, if any."""
        skeleton, size = self._model.skeleton, os.fstat(warnings).st_size
        self._model.set_state(start_q, start_u)
        self._contact.restart()
        q[0], u[0] = start_q, start_u
        for k, loads in enumerate(zip(*inputs, strict=True)):
            self._loads.hold(*loads)
            self._stepper.advance(self._step_count)
            here, rate = skeleton.getPositions(), skeleton.getVelocities()
            if os.fstat(warnings).st_size > size:
                return Failure(k + 1, f"DART: {_first_line(warnings, size)}")
            fastest = float(np.abs(rate).max(initial=0.0))  # none if all bodies are fixed
            if not (fastest < _BLOW_UP and np.isfinite(here).all()):
                return Failure(k + 1, f"blow-up: a joint rate of {fastest:.3g} rad/s or m/s")
            if trouble := self._contact.trouble():
                return Failure(k + 1, trouble)
            q[k + 1], u[k + 1] = here, rate
        return None

    def readback(self, batch: Batch) -> Readback:
        model = self._model
        q, u = self._start(batch[:1])
        self._loads.stops.release()
        model.set_state(q[0], u[0])
        places = [body.getWorldTransform() for body in model.bodies]
        native = rotation.from_matrix(np.array([place.rotation() for place in places]))
        inertia = [body.getInertia() for body in model.bodies]
        return Readback(
            mass=np.array([item.getMass() for item in inertia]),
            inertia=np.array([item.getMoment() for item in inertia]),
            com=np.array([body.getCOM() for body in model.bodies]),
            orientation=self._mechanism.body_orientation(native),
            velocity=np.array([body.getCOMLinearVelocity() for body in model.bodies]),
            angular_velocity=np.array([body.getAngularVelocity() for body in model.bodies]),
            gravity=np.array(model.world.getGravity()),
            step=float(model.world.getTimeStep()),
            joint_axis=joint_axes(self._mechanism, self._axis),
            damping=self._damping(),
            **contact_readback(model.shapes, model.floor, self._mechanism),
            anchor=joint_anchors(self._mechanism, self._link_anchor),
            spring=self._loads.springs(),
            law=joint_laws(self._mechanism, self._law),
            drive=np.array([drive.as_read() for drive in self._mechanism.drives]),
            armature=np.array([*map(self._rotor, self._mechanism.rotors, self._joints("rotors"))]),
            friction=np.array([j.getCoulombFriction(0) for j in self._joints("frictional")]),
            limits=np.array([self._limits(j) for j in self._joints("limited")]).reshape(-1, 2),
        )

    def _axis(self, link: Link) -> Array:
        turn = self._model.bodies[link.body].getWorldTransform().rotation()
        return np.asarray(turn @ self._model.joints[link.body].getAxis())

    def _link_anchor(self, link: Link) -> tuple[Array, Array]:
        joint, body = self._model.joints[link.body], self._model.bodies[link.body]
        above = joint.getTransformFromParentBodyNode().translation()
        if link.parent != WORLD_INDEX:
            above = self._model.bodies[link.parent].getWorldTransform().multiply(above)
        below = joint.getTransformFromChildBodyNode().translation()
        return above, body.getWorldTransform().multiply(below)

    def _law(self, link: Link, placed: PlacedJoint) -> tuple[float, float, float]:
        joint = self._model.joints[link.body]
        damping = joint.getDampingCoefficient(0) - placed.armature / self._step
        return joint.getSpringStiffness(0), damping, joint.getRestPosition(0)

    def _rotor(self, placed: PlacedJoint, joint: Any) -> float:
        return float(self._step * (joint.getDampingCoefficient(0) - placed.damping))

    def _joints(self, name: str) -> list[Any]:
        """Return DART's joints for a property of the mechanism such as "rotors"."""
        bodies = self._mechanism.carried
        return [self._model.joints[bodies[j.index]] for j in getattr(self._mechanism, name)]

    def _limits(self, joint: Any) -> tuple[float, float]:
        if not (joint.areLimitsEnforced() or self._mechanism.rotors):
            return -np.inf, np.inf
        return joint.getPositionLowerLimit(0), joint.getPositionUpperLimit(0)

    def _damping(self) -> Array:
        carried = {link.body: link.joint for link in self._mechanism.links}
        excess = []
        for body, joint in enumerate(self._model.joints):
            placed = carried[body]
            for k in range(joint.getNumDofs()):
                stiffness, damping = joint.getSpringStiffness(k), joint.getDampingCoefficient(k)
                friction = joint.getCoulombFriction(k)
                if placed is not None:
                    stiffness, friction = stiffness - placed.stiffness, friction - placed.friction
                    damping -= placed.damping + placed.armature / self._step
                excess += [damping, friction, stiffness]
        return np.array(excess)

    def native(self, batch: Batch) -> str:
        q, u = self._start(batch)
        count = self._step_count * self._mechanism.scene.clock.steps
        lines = script(self._mechanism, q[0], u[0], self._stepper.call, count)
        return self._listing + _INPUTS + "\n".join(lines)

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        return self._model.coordinates(BodyStates.of(self._mechanism, batch))

    def close(self) -> None:
        vars(self).clear()


@contextlib.contextmanager
def _capture_warnings() -> Iterator[int]:
    """Collect DART's printed warnings in a file, whose descriptor is the value."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file, redirected((2,), file.fileno()):
        yield file.fileno()


def _first_line(warnings: int, start: int) -> str:
    """Return the first line printed after the first `start` bytes, without its colours."""
    line = os.pread(warnings, 400, start).decode(errors="replace").partition("\n")[0]
    return re.sub(r"\x1b\[[0-9;]*m", "", line).strip()


@contextlib.contextmanager
def _error_reduction(value: float) -> Iterator[None]:
    """Set DART's process-wide error reduction parameter, and restore it afterwards."""
    kinds = (dartpy.constraint.BallJointConstraint, dartpy.constraint.WeldJointConstraint)
    before = [kind.getErrorReductionParameter() for kind in kinds]
    try:
        for kind in kinds:
            kind.setErrorReductionParameter(value)
        yield
    finally:
        for kind, old in zip(kinds, before, strict=True):
            kind.setErrorReductionParameter(old)

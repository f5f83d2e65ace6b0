"""Loads on bodies: inputs, springs, dry friction, torques about hinges that close loops."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

from .client import Client, Constant
from .model import Multibodies


class StepLoads:
    """Loads for the next call of the engine's step, which forgets them afterwards."""

    def __init__(self, client: Client, model: Multibodies, mechanism: Mechanism) -> None:
        self._model = model
        self._springs = mechanism.springs
        self._ends = [body for spring in self._springs for body in spring.bodies]
        self._in_body = np.array([point for spring in self._springs for point in spring.in_body])
        self._hinges = mechanism.hinges
        self._compliant = mechanism.compliant
        self._closures = {joint.index for joint in model.closures}
        self._address = model.address
        self._apply_force = client.function("applyExternalForce")
        self._apply_torque = client.function("applyExternalTorque")
        self._drive = client.function("setJointMotorControl2")
        self._in_world = int(Constant("WORLD_FRAME"))
        self._as_torque = int(Constant("TORQUE_CONTROL"))
        self._driven = mechanism.carried
        self._joint_state = client.function("getJointState")
        self._joint_springs = joint_springs(model)
        self._servos = [
            (drive, *model.address(self._driven[drive.joint.index])) for drive in mechanism.drives
        ]

    def change_within_frame(self, torque: Array) -> bool:
        """Return whether a load follows the motion, so that each step needs it anew.

        Forces on centres of mass and torques in tree joints stay as they are over the sub-steps
        of one call.
        """
        loops = [joint.index in self._closures for joint in self._hinges]
        follows = self._springs or self._compliant or self._servos
        return bool(follows) or bool(torque[..., : len(loops)][..., loops].any())

    def apply(self, force: Array, torque: Array, reading: Array) -> None:
        """Apply a frame's inputs, shapes (body, 3) and (hinge + drive,), and the springs.

        Args:
            force: Forces in W on centres of mass [N].
            torque: Torques about the hinges [N·m], then pushes of drives [N·m or N].
            reading: The present state, from `Multibodies.read`.
        """
        for body in np.flatnonzero(force.any(axis=-1)).tolist():
            self._push(body, force[body], reading[body, :3])
        loop_torques, count = [], len(self._hinges)
        for k in np.flatnonzero(torque[:count]).tolist():
            joint = self._hinges[k]
            if joint.index in self._closures:
                loop_torques.append((joint, float(torque[k])))
            else:
                # A tree joint that points the other way has its axis negated and its bodies
                # exchanged, which leaves the torque as it is.
                number, link = self._address(self._driven[joint.index])
                self._drive(number, link, self._as_torque, force=float(torque[k]))
        for number, link, stiffness, rest in self._joint_springs:
            effort = -stiffness * (self._joint_state(number, link)[0] - rest)
            self._drive(number, link, self._as_torque, force=effort)
        for push, (drive, number, link) in zip(torque[count:].tolist(), self._servos, strict=True):
            effort = drive.at(push, *self._joint_state(number, link)[:2])
            self._drive(number, link, self._as_torque, force=effort)
        if loop_torques or self._springs:
            world = self._model.states(reading).with_world()
            for joint, moment in loop_torques:
                self._twist(joint, moment, world)
            if self._springs:
                self._pull(world)

    def springs(self, state: BodyStates) -> Array:
        """Return `Readback.spring`."""
        if not self._springs:
            return np.zeros((0, 4))
        lines = np.diff(self._spring_ends(state.with_world())[0], axis=1)[:, 0]
        return np.array([s.as_read(line) for s, line in zip(self._springs, lines, strict=True)])

    def _push(self, body: int, force: Array, point: Array) -> None:
        if body != WORLD_INDEX:
            self._apply_force(*self._address(body), force.tolist(), point.tolist(), self._in_world)

    def _twist(self, joint: PlacedJoint, torque: float, world: BodyStates) -> None:
        vector = torque * world.arms(joint.parent, joint.axis)
        for body, sign in ((joint.child, 1.0), (joint.parent, -1.0)):
            if body != WORLD_INDEX:
                self._apply_torque(*self._address(body), (sign * vector).tolist(), self._in_world)

    def _pull(self, world: BodyStates) -> None:
        places, rates = self._spring_ends(world)
        for spring, (first, second), rate in zip(self._springs, places, rates, strict=True):
            force = spring.pull(second - first, rate[1] - rate[0])
            self._push(spring.bodies[0], force, first)
            self._push(spring.bodies[1], -force, second)

    def _spring_ends(self, world: BodyStates) -> tuple[Array, Array]:
        """Return places in W [m] and velocities [m/s] of the springs' ends, (spring, end, 3).

        The last of the bodies is the world.
        """
        places = world.points(self._ends, self._in_body).reshape(-1, 2, 3)
        return places, world.speeds(self._ends, self._in_body).reshape(-1, 2, 3)


def set_friction(model: Multibodies, substeps: int) -> None:
    """Brake joints with dry friction by motors with a target rate of 0.

    In each of the sub-steps of a call, Bullet allows the impulse of the whole call.
    """
    mechanism = model.mechanism
    bodies = mechanism.carried
    for joint in mechanism.frictional:
        model.client.build(
            "setJointMotorControl2", *model.address(bodies[joint.index]),
            Constant("VELOCITY_CONTROL"), force=joint.friction / substeps,
        )  # fmt: skip


def joint_springs(model: Multibodies) -> list[tuple[int, int, float, float]]:
    """Return number, link, stiffness and rest of joints with springs, which Bullet lacks."""
    joints = [(link.joint, link.body) for part in model.parts for link in part.links]
    return [
        (*model.address(body), joint.stiffness, joint.rest)
        for joint, body in joints
        if joint is not None and joint.stiffness
    ]


def spring_calls(model: Multibodies) -> list[str]:
    """Write the calls of `StepLoads.apply` in each step for joint springs and servos."""
    calls = [
        f"p.setJointMotorControl2({number}, {link}, p.TORQUE_CONTROL, "
        f"force=-{stiffness!r} * (p.getJointState({number}, {link})[0] - {rest!r}))"
        for number, link, stiffness, rest in joint_springs(model)
    ]
    bodies = model.mechanism.carried
    for drive in model.mechanism.drives:
        at = "{}, {}".format(*model.address(bodies[drive.joint.index]))
        calls += [
            f"angle, rate, *_ = p.getJointState({at})",
            f"p.setJointMotorControl2({at}, p.TORQUE_CONTROL, force={drive.formula()})",
        ]
    return calls

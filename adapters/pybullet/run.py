"""A scene loaded into Bullet: its rollouts, and the readback of its native model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.collisions import passed
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PointPair
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.shapes import TENSION, pull_call
from mbds_xsim.scene.state import Batch, Failure, Trajectory
from mbds_xsim.simulate.adapter import Readback, Run, Settings, first_failures, recorded

from .client import Client
from .contact import BulletContact
from .loads import StepLoads, set_friction, spring_calls
from .model import RATES, SPEED_CAP, Multibodies

_BLOW_UP = 0.5 * SPEED_CAP
# A free body or ball joint turns by at most this in a step (btMultiBody::stepPositionsMultiDof).
_TURN_CAP = math.pi / 4
_SPRINGS = f"""
import numpy as np


def motion(address, point):
    if address is None:
        return np.array(point), np.zeros(3)
    if address[1] == -1:
        state = p.getBasePositionAndOrientation(address[0]) + p.getBaseVelocity(address[0])
    else:
        state = [p.getLinkState(*address, 1, 1)[k] for k in (0, 1, 6, 7)]
    arm = np.reshape(p.getMatrixFromQuaternion(state[1]), (3, 3)) @ point
    return state[0] + arm, state[2] + np.cross(state[3], arm)
{TENSION}    for end, place, sign in zip(ends, (first, second), (1, -1)):
        if end is not None:
            p.applyExternalForce(*end, list(sign * tension * along), list(place), p.WORLD_FRAME)

"""
_RESULT = """\
for body in range(p.getNumBodies()):
    print(body, "base", p.getBasePositionAndOrientation(body), p.getBaseVelocity(body))
    for link in range(p.getNumJoints(body)):
        position, turn, *_, velocity, rate = p.getLinkState(body, link, 1, 1)
        print(body, link, position, turn, velocity, rate)
"""


class PyBulletRun(Run):
    """A run in a connection and a world of its own.

    Args:
        scene: The scene to simulate.
        settings: Method, step and options.
        options: All options of the adapter by name.
    """

    def __init__(self, scene: Scene, settings: Settings, options: Mapping[str, Any]) -> None:
        self._client = Client()
        try:
            self._load(scene, settings, options)
        except BaseException:
            self._client.close()  # a refused scene leaves no world behind
            raise

    def _load(self, scene: Scene, settings: Settings, options: Mapping[str, Any]) -> None:
        self._mechanism = mechanism = Mechanism.of(scene)
        self._frame = scene.clock.frame
        self._substeps = settings.substeps(self._frame)
        self._step = _divisible_step(self._frame, self._substeps)
        self._client.build("setGravity", *scene.gravity)
        self._client.build(
            "setPhysicsEngineParameter",
            numSolverIterations=int(options["solver_iterations"]),
            solverResidualThreshold=float(options["residual_threshold"]),
            erp=float(options["erp"]),
            deterministicOverlappingPairs=1,
        )
        drag = {
            f"{kind}Damping": float(options[f"{kind}_damping"]) for kind in ("linear", "angular")
        }
        self._contact = (
            BulletContact(self._client, mechanism, options, self._step) if scene.contacts else None
        )
        self._model = Multibodies(self._client, mechanism, drag, self._contact)
        self._loads = StepLoads(self._client, self._model, mechanism)
        self._advance = self._client.function("stepSimulation")
        self._set_stepping(self._substeps)
        self.size = self._model.size
        # Only ball joints and free bodies are integrated as rotations.
        turning = [link for link in mechanism.links if not link.joint or link.joint.kind == "ball"]
        self._turning = np.array([link.body for link in turning], dtype=np.int64)
        self._carrier = np.array([link.parent for link in turning], dtype=np.int64)

    def rollout(self, batch: Batch) -> Trajectory:
        shape = (len(batch), batch.steps + 1, self._mechanism.body_count, 13)
        reading = np.full(shape, np.nan)
        inputs = with_pushes(self._mechanism.drives, batch.torque)
        each_step = self._loads.change_within_frame(inputs)
        self._set_stepping(1 if each_step else self._substeps)
        for row in range(len(batch)):
            calls = self._substeps if each_step else 1
            self._roll(batch, row, inputs[row], reading[row], calls)
        states = self._model.states(reading)
        failures = self._failures(reading, states)
        return recorded(self._mechanism, states.each(np.copy), failures)

    def _roll(self, batch: Batch, row: int, inputs: Array, reading: Array, calls: int) -> None:
        """Fill in the reading of every frame (frame, body, 13), up to a blow-up."""
        read, apply, advance = self._model.read, self._loads.apply, self._advance
        self._start(batch, row)
        here = reading[0] = read()
        for k in range(batch.steps):
            force, torque = batch.force[row, k], inputs[k]
            if self._contact:
                self._contact.turn(self._model.states(here), self._frame)
            for _ in range(calls):
                apply(force, torque, here)
                advance()
                here = read()
            reading[k + 1] = here
            # Written so that NaN counts as bad.
            if not np.abs(here[:, RATES]).max() <= _BLOW_UP:
                return

    def _start(self, batch: Batch, row: int) -> None:
        if self._contact:
            self._contact.forget()
        self._model.put(BodyStates.of(self._mechanism, batch[[row]])[0])

    def _failures(self, reading: Array, state: BodyStates) -> tuple[Failure | None, ...]:
        """Find failures, which Bullet itself never reports."""
        finite = np.asarray(np.isfinite(reading).all(axis=(2, 3)))
        fastest = np.abs(reading[..., RATES]).max(axis=(2, 3))
        turn = self._turn(state)
        fine = finite & (fastest <= _BLOW_UP) & (turn <= _TURN_CAP)
        if self._contact:
            fine &= ~passed(self._mechanism, state.position, state.native)

        def reason(*at: int) -> str:
            if not finite[at]:
                return "the state is not finite"
            if fastest[at] > _BLOW_UP:
                return f"blow-up: {fastest[at]:.3g} m/s or rad/s, the engine cuts at {SPEED_CAP:g}"
            if turn[at] > _TURN_CAP:
                return f"a body turns by {turn[at]:.3g} rad in a step, the engine cuts that at π/4"
            assert self._contact is not None
            return self._contact.trouble(self._model.states(reading[at]))

        return first_failures(~fine, reason, earliest=1)

    def _turn(self, state: BodyStates) -> Array:
        """Return the largest turn of a body against its carrier in a step [rad], shape (…)."""
        rate = state.angular_velocity
        rates = np.concatenate(
            [rate, np.zeros_like(rate[..., :1, :])], axis=-2
        )  # of the world, too
        relative = rates[..., self._turning, :] - rates[..., self._carrier, :]
        return np.asarray(self._step * np.linalg.norm(relative, axis=-1).max(axis=-1, initial=0.0))

    def _set_stepping(self, substeps: int) -> None:
        # Loads stay as they are over the sub-steps of one call.
        self._client.build(
            "setPhysicsEngineParameter", fixedTimeStep=self._step * substeps, numSubSteps=substeps
        )
        set_friction(self._model, substeps)

    def readback(self, batch: Batch) -> Readback:
        inertia = self._model.inertia()  # puts the model at its reference pose
        self._start(batch, 0)
        reading = self._model.read()
        state = self._model.states(reading)
        parameters = self._client.function("getPhysicsEngineParameters")()
        return Readback(
            **self._model.fields(reading),
            inertia=inertia,
            com=state.position,
            orientation=self._mechanism.body_orientation(state.native),
            velocity=state.velocity,
            angular_velocity=state.angular_velocity,
            gravity=np.array([parameters[f"gravityAcceleration{axis}"] for axis in "XYZ"]),
            step=parameters["fixedTimeStep"] / max(1, parameters["numSubSteps"]),
            **(self._contact.readback(self._model.addresses, reading) if self._contact else {}),
            spring=self._loads.springs(state),
            drive=np.array([drive.as_read() for drive in self._mechanism.drives]),
        )

    def native(self, batch: Batch) -> str:
        self._start(batch, 0)
        if self._contact:
            self._contact.turn(self._model.states(self._model.read()), self._frame)
        follows = self._loads.change_within_frame(batch.torque[:0])
        calls = self._substeps if follows else 1
        self._set_stepping(self._substeps // calls)
        count = calls * self._mechanism.scene.clock.steps
        return self._client.listing() + _script(self._model, count)

    def close(self) -> None:
        self._client.close()


def _script(model: Multibodies, count: int) -> str:
    """Return the end of a script: springs, calls of the engine's step, and the printed result."""
    pulls = [_pull(spring, model) for spring in model.mechanism.springs]
    springs = [_SPRINGS] if pulls else [""]
    pulls += [f"    {call}" for call in spring_calls(model)]
    loop = [f"for _ in range({count}):", *pulls, "    p.stepSimulation()"]
    return "\n".join([*springs, *loop, _RESULT])


def _pull(spring: PointPair, model: Multibodies) -> str:
    principal = [
        rotation.IDENTITY if body == WORLD_INDEX else model.principal[body]
        for body in spring.bodies
    ]
    points = map(rotation.rotate, map(rotation.conjugate, principal), spring.in_body)
    return pull_call(spring, lambda body: repr(model.address(body)), points)


def _divisible_step(frame: float, substeps: int) -> float:
    """Return the step without its last bits, so that `substeps` of them add up without rounding.

    Bullet takes the whole part of frame / step as the steps of a frame and carries the rest over:
    if that rounds down, it sometimes takes one step too few.
    """
    mantissa, exponent = math.frexp(frame / substeps)
    bits = 53 - substeps.bit_length()
    return math.ldexp(round(math.ldexp(mantissa, bits)), exponent - bits)

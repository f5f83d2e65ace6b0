"""Loops by hand on the native models of the adapters: what an engine costs at the least.

A loop applies recorded inputs, takes the adapter's steps and keeps what the engine tells of its
state, frame by frame: no checks, no conversion. Where steps depend on how near the ground is, it
has them from a rollout of the adapter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import dartpy
import exudyn
import mujoco
import numpy as np
import pybullet
from numpy.typing import NDArray

from mbds_xsim.engine import Run
from mbds_xsim.joint_space import BodyStates, to_bodies
from mbds_xsim.mechanism import Mechanism
from mbds_xsim.state import Batch

__all__ = ["LEAN", "Lean", "apart"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lean:
    """A loop by hand on an adapter's native model."""

    roll: Callable[[], object]
    """Make the trajectory."""
    bodies: Callable[[], BodyStates]
    """What it was, shape (frame, body, …), without the start."""


def lean_mujoco(run: Any, batch: Batch) -> Lean:
    model, data, rows = run._model, run._data, np.array(run._bodies)
    (start,), (rate,) = run._start(batch)
    force, torque = batch.force[0], batch.torque[0]
    q, u = np.empty((batch.steps, model.nq)), np.empty((batch.steps, model.nv))
    frame = _mujoco_frame(run, batch)

    def roll() -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = start, rate
        push, drive, position, velocity = data.xfrc_applied, data.ctrl, data.qpos, data.qvel
        for k in range(len(q)):
            push[rows, :3] = force[k]
            drive[:] = torque[k]
            frame(k)
            q[k], u[k] = position, velocity

    return Lean(roll, lambda: to_bodies(run._mechanism, run._coordinates.to_links(q, u)))


def _mujoco_frame(run: Any, batch: Batch) -> Callable[[int], None]:
    """The steps of a frame: all in one call, or as recorded where some of them are finer."""
    model, data, stepper, step = run._model, run._data, run._stepper, mujoco.mj_step
    if not hasattr(stepper, "_flies"):
        count = stepper._count
        return lambda _: step(model, data, count)
    tape = _taped(run, batch)
    options, division = model.opt, stepper._division
    finer, euler, air = stepper._finer, options.integrator, stepper._integrator

    def frame(k: int) -> None:
        for flies, before, after in tape[k]:
            if flies:
                options.integrator, options.timestep = air, division * finer
                step(model, data)
                options.integrator, options.timestep = euler, finer
                continue
            if before:
                mujoco.mj_forward(model, data)
                data.qvel -= 0.5 * finer * data.qacc
            step(model, data, division)
            if after:
                mujoco.mj_forward(model, data)
                data.qvel += 0.5 * finer * data.qacc

    return frame


def _taped(run: Any, batch: Batch) -> list[list[tuple[bool, bool, bool]]]:
    """Whether each step flies, and whether its velocities are moved before and after it."""
    stepper = run._stepper
    flies, lead = stepper._flies, stepper._lead
    tape: list[list[Any]] = []

    def taped_flies(*given: Any) -> bool:
        tape.append([bool(flies(*given))])
        return tape[-1][0]

    def taped_lead(model: Any, data: Any, steps: float) -> None:
        velocity = data.qvel.copy()
        lead(model, data, steps)
        tape[-1].append(bool(np.any(velocity != data.qvel)))

    stepper._flies, stepper._lead = taped_flies, taped_lead
    run.rollout(batch)
    del stepper._flies, stepper._lead
    steps = [(flown, *(moved or (False, False))) for flown, *moved in tape]
    return [steps[k : k + stepper._count] for k in range(0, len(steps), stepper._count)]


def lean_pybullet(run: Any, batch: Batch) -> Lean:
    model, mechanism, loads = run._model, run._mechanism, run._loads
    client, torque = run._client._number, batch.torque[0]
    forces = [[(k, force[k].tolist()) for k in _pushed(force)] for force in batch.force[0]]
    state = np.empty((batch.steps + 1, mechanism.body_count, 13))
    address = [model.address(body) for body in range(mechanism.body_count)]
    parts = list(zip(model._ids, model.parts, strict=True))
    bases = [(part.base, number) for number, part in parts if part.base >= 0]
    trees = [
        (number, range(len(part.links)), [link.body for link in part.links])
        for number, part in parts
        if part.links
    ]
    driven = [model.address(loads._driven[hinge.index]) for hinge in mechanism.hinges]

    def read(k: int) -> None:
        for body, number in bases:
            place = pybullet.getBasePositionAndOrientation(number, client)
            rate = pybullet.getBaseVelocity(number, client)
            state[k, body] = (*place[0], *place[1], *rate[0], *rate[1])
        for number, links, bodies in trees:
            told = pybullet.getLinkStates(number, links, 1, 1, client)
            state[k, bodies] = [(*link[0], *link[1], *link[6], *link[7]) for link in told]

    def roll() -> None:
        run._start(batch, 0)
        read(0)
        push, drive = pybullet.applyExternalForce, pybullet.setJointMotorControl2
        world, motor = pybullet.WORLD_FRAME, pybullet.TORQUE_CONTROL
        for k in range(batch.steps):
            for body, vector in forces[k]:
                push(*address[body], vector, state[k, body, :3].tolist(), world, client)
            for joint, moment in zip(driven, torque[k].tolist(), strict=True):
                drive(*joint, motor, force=moment, physicsClientId=client)
            pybullet.stepSimulation(client)
            read(k + 1)

    return Lean(roll, lambda: model.states(state[1:]))


def lean_dart(run: Any, batch: Batch) -> Lean:
    model, count, constraint = run._model, run._step_count, dartpy.constraint
    skeleton, step = model.skeleton, model.world.step
    start, rate = (
        values[0]
        for values in model.coordinates(
            batch.position, batch.orientation, batch.velocity, batch.angular_velocity
        )
    )
    q, u = np.empty((2, batch.steps, len(start)))
    frames = [[(model.bodies[k].setExtForce, f[k]) for k in _pushed(f)] for f in batch.force[0]]
    driven = [(k, joint.setForce) for k, joint in run._loads._driven]

    def roll() -> None:
        for kind in (constraint.BallJointConstraint, constraint.WeldJointConstraint):
            kind.setErrorReductionParameter(run._error_reduction)  # the process's, not the world's
        skeleton.setPositions(start)
        skeleton.setVelocities(rate)
        for k in range(batch.steps):
            for hinge, drive in driven:
                drive(0, batch.torque[0, k, hinge])
            pushes = frames[k]
            for _ in range(count):
                for push, force in pushes:
                    push(force)
                step(False)
            q[k], u[k] = skeleton.getPositions(), skeleton.getVelocities()

    return Lean(roll, lambda: model.body_states(q, u))


def lean_exudyn(run: Any, batch: Batch) -> Lean:
    assert "DynamicSolverType.TrapezoidalIndex2" in run.native()
    names, data = run._names, run._mbs.systemData
    (start,), (rate,) = run._start(batch)
    q, u = np.empty((2, batch.steps, len(start)))
    put = run._mbs.SetLoadParameter
    solver: Any = exudyn.MainSolverImplicitSecondOrder
    first, now = exudyn.ConfigurationType.Initial, exudyn.ConfigurationType.Current
    forces = [(names["forces"][k], batch.force[0, :, k]) for k in _pushed(batch.force[0])]
    pairs = [
        (load, k, sign * hinge.axis)
        for k, (hinge, pair) in enumerate(zip(run._mechanism.hinges, names["torques"], strict=True))
        for load, sign in zip(pair, (1.0, -1.0), strict=True)
        if load is not None
    ]
    settings = _settings_by_frame(run, batch)
    for kind in settings:
        # What `SolveDynamic` sets for the trapezoidal method.
        alpha = kind.timeIntegration.generalizedAlpha
        alpha.useNewmark = alpha.useIndex2Constraints = True

    def roll() -> None:
        run._put(start, rate)
        for k in range(batch.steps):
            for load, vectors in forces:
                put(load, "loadVector", vectors[k])
            for load, hinge, axis in pairs:
                put(load, "loadVector", batch.torque[0, k, hinge] * axis)
            solver().SolveSystem(run._mbs, settings[k])
            data.SetSystemState(data.GetSystemState(now), first)
            data.SetODE2Coordinates_tt(data.GetODE2Coordinates_tt(now), first)
            q[k], u[k] = data.GetODE2Coordinates(), data.GetODE2Coordinates_t()

    return Lean(roll, lambda: run._model.to_bodies(q, u))


def _settings_by_frame(run: Any, batch: Batch) -> list[Any]:
    """Those that the adapter's rollout takes each frame with."""
    names = run._names
    usual, near = names["settings"], names.get("near_ground")
    if near is None:
        return [usual] * batch.steps
    tape: list[Any] = []
    step = run._step

    def taped() -> None:
        solve = names["step_frame"]
        taken: list[Any] = []

        def keep(settings: Any = usual) -> None:
            taken.append(settings)
            solve(settings)

        names["step_frame"] = keep
        step()
        names["step_frame"] = solve
        tape.append(taken[-1])

    run._step = taped
    run.rollout(batch)
    del run._step
    return tape


def _pushed(force: Array) -> list[int]:
    """Bodies that a force (…, body, 3) acts on."""
    return np.flatnonzero(np.moveaxis(force, -2, 0).reshape(force.shape[-2], -1).any(-1)).tolist()


LEAN: dict[str, Callable[[Any, Batch], Lean]] = {
    "mujoco": lean_mujoco,
    "pybullet": lean_pybullet,
    "dart": lean_dart,
    "exudyn": lean_exudyn,
}


def apart(mechanism: Mechanism, run: Run, batch: Batch, lean: Lean) -> float:
    """Largest distance of the two trajectories, in positions [m] and velocities [m/s, rad/s]."""
    told = run.rollout(batch)
    assert told.failures == (None,), told.failures
    lean.roll()
    made = lean.bodies()
    turned = mechanism.body_orientation(made.native)
    # A quaternion and its negative are one rotation.
    turned *= np.sign(np.sum(turned * told.orientation[0, 1:], axis=-1, keepdims=True))
    pairs = (
        (made.position, told.position),
        (turned, told.orientation),
        (made.velocity, told.velocity),
        (made.angular_velocity, told.angular_velocity),
    )
    return max(float(np.abs(mine - theirs[0, 1:]).max()) for mine, theirs in pairs)

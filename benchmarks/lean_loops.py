"""Loops by hand on the native models of the adapters: what an engine costs at the least.

A loop applies recorded inputs, takes the adapter's steps and keeps what the engine tells of its
state, frame by frame: no checks, no conversion. It is the bodies' states that a trajectory is made
of; DART's and Exudyn's loops keep coordinates, from which they follow, and do with less. Where
steps depend on how near the ground is, it has them from a rollout of the adapter.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import dartpy
import exudyn
import mujoco
import numpy as np
import pybullet
from numpy.typing import NDArray

from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.spin import carried
from mbds_xsim.scene.state import Batch
from mbds_xsim.simulate.adapter import Run

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lean:
    """A loop by hand on an adapter's native model."""

    roll: Callable[[], object]
    """Make the trajectory."""
    bodies: Callable[[], BodyStates]
    """What it was, shape (frame, body, …), without the start."""


def lean_mujoco(run: Any, batch: Batch) -> Lean:
    """Bodies as the engine has them: places, turns, and rates about the trees' centres of mass."""
    return _lean_mujoco(run, batch, bodies=True)


def mujoco_coordinates(run: Any, batch: Batch) -> Lean:
    """Nothing but MuJoCo's coordinates, which tell nobody where a body is."""
    return _lean_mujoco(run, batch, bodies=False)


def _lean_mujoco(run: Any, batch: Batch, *, bodies: bool) -> Lean:
    run = _in_use(run, batch)
    model, data, rows = run._model, run._data, np.array(run._bodies)
    (start,), (rate,) = run._start(batch)
    force, torque = batch.force[0], batch.torque[0]
    q, u = np.empty((batch.steps + 1, model.nq)), np.empty((batch.steps + 1, model.nv))
    place, turn, twist = (np.empty((batch.steps + 1, model.nbody, n)) for n in (3, 4, 6))
    frames, options = _mujoco_steps(run, batch), model.opt
    usual = options.integrator, options.timestep

    def keep_coordinates(k: int) -> None:
        q[k], u[k] = data.qpos, data.qvel

    def keep_bodies(k: int) -> None:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        place[k], turn[k], twist[k] = data.xipos, data.xquat, data.cvel

    def loop(keep: Callable[[int], None]) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = start, rate
        push, drive = data.xfrc_applied, data.ctrl
        keep(0)
        for k in range(batch.steps):
            push[rows, :3] = force[k]
            drive[:] = torque[k]
            for options.integrator, options.timestep, count, lead in frames[k]:
                if lead:
                    mujoco.mj_forward(model, data)
                    data.qvel += lead * data.qacc
                else:
                    mujoco.mj_step(model, data, count)
            keep(k + 1)
        options.integrator, options.timestep = usual

    def states() -> BodyStates:
        told = run.frames(1, batch.steps + 1)
        loop(functools.partial(told.keep, 0))
        made = told.states()
        if run._idle.any():
            turned = run._mechanism.native_rotation(batch.orientation)
            made = carried(run._idle, turned, made, run._mechanism.scene.clock.frame)
        return BodyStates(*(values[0, 1:] for values in vars(made).values()))

    keep = keep_bodies if bodies else keep_coordinates
    return Lean(lambda: loop(keep), states)


def _in_use(run: Any, batch: Batch) -> Any:
    """Of a run that has a model without spin beside the whole one, what the start is run with."""
    if not hasattr(run, "_spinless"):
        return run
    run._whole = None
    run.rollout(batch)
    return run._whole or run._spinless


def _mujoco_steps(run: Any, batch: Batch) -> list[list[tuple[int, float, int, float]]]:
    """What each frame takes in the adapter's rollout.

    Of calls of the engine's step: integrator, step [s] and number of steps; of moves of the
    velocities with the accelerations: the time [s] that they move on by, last.
    """
    stepper, step = run._stepper, mujoco.mj_step
    frame = stepper.frame
    lead: Any = getattr(stepper, "_lead", None)
    frames: list[list[tuple[int, float, int, float]]] = []
    begun = [0.0]

    def taped_frame(*given: Any) -> None:
        frames.append([])
        frame(*given)

    def taped_step(model: Any, data: Any, nstep: int = 1) -> None:
        _drop_undone(data.time)
        frames[-1].append((model.opt.integrator, model.opt.timestep, nstep, 0.0))
        begun[0] = data.time
        step(model, data, nstep)

    def taped_lead(model: Any, data: Any, *rest: Any) -> None:
        _drop_undone(data.time)
        velocity = data.qvel.copy()
        lead(model, data, *rest)
        if np.any(velocity != data.qvel):
            finer = model.opt.timestep
            frames[-1].append((model.opt.integrator, finer, 0, rest[-1] * finer))

    def _drop_undone(time: float) -> None:
        """Forget a step that was taken back: time is where it began."""
        if frames[-1] and not frames[-1][-1][3] and time <= begun[0]:
            frames[-1].pop()

    taped = {"frame": taped_frame} | ({"_lead": taped_lead} if lead else {})
    with patch.multiple(stepper, **taped), patch.object(mujoco, "mj_step", taped_step):
        run.rollout(batch)
    return frames


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
            if run._contact:
                run._contact.turn(model.states(state[k]), run._frame)
            pybullet.stepSimulation(client)
            read(k + 1)

    return Lean(roll, lambda: model.states(state[1:]))


def lean_dart(run: Any, batch: Batch) -> Lean:
    model, count, constraint = run._model, run._step_count, dartpy.constraint
    skeleton, step = model.skeleton, model.world.step
    start, rate = (values[0] for values in run._start(batch))
    q, u = np.empty((2, batch.steps, len(start)))
    frames = [[(model.bodies[k].setExtForce, f[k]) for k in _pushed(f)] for f in batch.force[0]]
    driven = [(k, joint.setForce) for k, joint in run._loads._driven]
    # `World.step` is the engine's; any other method is the toolkit's, and the same for both.
    own = type(run._stepper).__name__ == "SemiImplicitEuler"

    def roll() -> None:
        for kind in (constraint.BallJointConstraint, constraint.WeldJointConstraint):
            kind.setErrorReductionParameter(run._error_reduction)  # the process's, not the world's
        skeleton.setPositions(start)
        skeleton.setVelocities(rate)
        for k in range(batch.steps):
            for hinge, drive in driven:
                drive(0, batch.torque[0, k, hinge])
            pushes = frames[k]
            if not own:
                run._loads.forces, run._loads.others = pushes, []
                run._stepper.advance(count)
            for _ in range(count if own else 0):
                for push, force in pushes:
                    push(force)
                step(False)
            q[k], u[k] = skeleton.getPositions(), skeleton.getVelocities()

    return Lean(roll, lambda: model.body_states(q, u))


def lean_exudyn(run: Any, batch: Batch) -> Lean:
    trapezoidal = _solver_type(run, batch) == exudyn.DynamicSolverType.TrapezoidalIndex2
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
        # What `SolveDynamic` sets for the method.
        alpha = kind.timeIntegration.generalizedAlpha
        alpha.useNewmark = alpha.useIndex2Constraints = trapezoidal

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


def _solver_type(run: Any, batch: Batch) -> Any:
    """The one that the adapter's listing names."""
    (name,) = set(re.findall(r"DynamicSolverType\.(\w+)", run.native(batch)))
    return getattr(exudyn.DynamicSolverType, name)


def exudyn_in_one_call(run: Any, batch: Batch) -> Lean:
    """All frames in one call of the solver, without contact.

    It goes on from the accelerations of the last frame's loads and keeps its Jacobian, so that it
    makes another, less exact trajectory.
    """
    names, data, settings = run._names, run._mbs.systemData, run._names["settings"]
    (start,), (rate,) = run._start(batch)
    q, u = np.empty((2, batch.steps, len(start)))
    forces = [(names["forces"][k], batch.force[0, :, k]) for k in _pushed(batch.force[0])]
    stepping = settings.timeIntegration
    frame = stepping.endTime

    def read(k: int) -> None:
        q[k], u[k] = data.GetODE2Coordinates(), data.GetODE2Coordinates_t()

    def roll() -> None:
        run._put(start, rate)
        usual = stepping.endTime, stepping.numberOfSteps
        stepping.endTime, stepping.numberOfSteps = frame * batch.steps, usual[1] * batch.steps
        run._mbs.SetPreStepUserFunction(before_step)
        begun[0] = -1
        run._mbs.SolveDynamic(settings, solverType=_solver_type(run, batch))
        read(batch.steps - 1)
        run._mbs.SetPreStepUserFunction(0)
        stepping.endTime, stepping.numberOfSteps = usual

    begun = [-1]

    def before_step(mbs: Any, time: float) -> bool:
        k = int(time / frame - 1e-6)  # the time is that of the step's end
        if k > begun[0]:
            if k:
                read(k - 1)
            begun[0] = k
            for load, vectors in forces:
                mbs.SetLoadParameter(load, "loadVector", vectors[k])
        return True

    return Lean(roll, lambda: run._model.to_bodies(q, u))


def _settings_by_frame(run: Any, batch: Batch) -> list[Any]:
    """Those that the adapter's rollout takes each frame with."""
    names = run._names
    usual, near = names["settings"], names.get("near_ground")
    if near is None:
        return [usual] * batch.steps
    solve, step = names["step_frame"], names["next_frame"]
    frames: list[Any] = []

    def taped_step() -> None:
        frames.append(usual)
        step()

    def taped_solve(settings: Any = usual) -> None:
        frames[-1] = settings  # an earlier one was taken back
        solve(settings)

    with patch.dict(names, next_frame=taped_step, step_frame=taped_solve):
        run.rollout(batch)
    return frames


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

"""PyBullet: Featherstone multibodies stepped by semi-implicit Euler, loops by impulses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.engine import (
    LOOPS,
    Adapter,
    Feature,
    Method,
    Option,
    Profile,
    Readback,
    Run,
    Settings,
    Sweep,
)
from mbds_xsim.errors import InputError
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import Link, Mechanism
from mbds_xsim.registry import package_version
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory
from mbds_xsim.steps import careful_step, nearest_step
from mbds_xsim.stiffness import spring_step

from ._pybullet_client import Client
from ._pybullet_contact import CONTACT_LAW, Contact, Law
from ._pybullet_loads import Loads
from ._pybullet_model import RATES, SPEED_CAP, Damping, Model
from ._pybullet_script import script

__all__ = ["PyBullet"]

Array = NDArray[np.float64]

_USUAL_STEP = 1 / 240
# Keeps the budgets of the pendulums; in a scene that moves faster, a hundredth of a frame.
_CAREFUL_STEP, _CAREFUL_COUNT = 2e-5, 100
# That a spring's oscillation turns by, and a damper's motion decays, in a step at most.
_SPRING_ANGLE, _DECAY = 0.5, 0.5
# Ten leave a body on four corners with 1e-6 m/s, and turn it where it comes down flat.
_CAREFUL_CONTACT = {"solver_iterations": 50}
# What the engine takes without a word is more than what means something.
_OPTION_RANGES = {
    "solver_iterations": (1, 1_000_000),
    "residual_threshold": (0.0, math.inf),
    "erp": (0.0, 1.0),
    "linear_damping": (0.0, math.inf),
    "angular_damping": (0.0, math.inf),
    "contact_recovery": (0.0, math.inf),
    "contact_slop": (0.0, math.inf),
    "contact_reach": (0.0, math.inf),
    "bounce_threshold": (0.0, math.inf),
    "friction_axes": (False, True),
}
_BLOW_UP = 0.5 * SPEED_CAP
# A free body or ball joint turns by at most this in a step (btMultiBody::stepPositionsMultiDof).
_TURN_CAP = math.pi / 4
# Bullet's SIMD_EPSILON: what a joint moves does not move if it is less (kg, kg·m² about a hinge).
_LEAST = float(np.finfo(float).eps)
# PhysicsServerCommandProcessor::createEmptyDynamicsWorld and btCollisionObject.
_USUAL_CONTACT = {
    "bounce_threshold": 0.2,
    "contact_reach": 1e18,
    "contact_slop": 1e-5,
    "friction_axes": False,
}
_USUAL_CONTACT_ERP = 0.08
# Steps of free fall that still count as rest.
_FALLS = 4.0


class PyBullet(Adapter):
    """Bullet's multibody dynamics through the package `pybullet`."""

    name = "pybullet"
    package = "pybullet"
    methods: ClassVar[Mapping[str, Method]] = {
        "semi-implicit-euler": Method(
            "semi-implicit-euler", "semi-implicit Euler", 1, velocity_lag=-0.5
        ),
    }
    options: ClassVar[Mapping[str, Option]] = {
        "solver_iterations": Option(10, "sweeps over loops and contacts in each step"),
        "residual_threshold": Option(0.0, "the sweeps stop early below this residual; 0: never"),
        "erp": Option(0.8, "part of a loop's gap that a step closes (error reduction parameter)"),
        "linear_damping": Option(0.0, "drag on every link [1/s]; a user of the engine gets 0.04"),
        "angular_damping": Option(0.0, "the same for its rotation [1/s]"),
        "contact_recovery": Option(1.0, "time that pushes an overlap with the ground out [s]"),
        "bounce_threshold": Option(0.0, "slowest approach that bounces [m/s]; 0: 4 steps' fall"),
        "contact_reach": Option(1e-6, "gap from which on a contact acts [m]"),
        "contact_slop": Option(0.0, "overlap with the ground that counts as none [m]"),
        "friction_axes": Option(
            True,
            "turn the axes of friction once a frame so that friction opposes the slip; without, "
            "it is turned towards the axis, x or y, along which a body yields less",
        ),
    }
    sweeps: ClassVar[Mapping[str, Sweep]] = {
        "solver_iterations": Sweep((3, 10, 50, 200), needs=LOOPS | {Feature.CONTACT}),
        "erp": Sweep((0.2, 1.0), needs=LOOPS),
        "contact_recovery": Sweep((0.1, 10.0), needs=frozenset({Feature.CONTACT})),
    }
    limits: ClassVar[Mapping[Feature, str]] = {
        Feature.LOOP_SLIDER: "its constraint JOINT_PRISMATIC is not reliable between multibodies",
        Feature.DISTANCE_LINK: "it has no constraint that keeps a distance",
    }
    coordinates: ClassVar[Literal["reduced", "maximal"]] = "reduced"
    contact_law = CONTACT_LAW
    smallest = (
        f"masses of {_LEAST:.3g} kg where a body is free or on a slider, moments about a hinge of "
        f"{_LEAST:.3g} kg·m²: what is less stands still without a warning"
    )

    def too_small(self, scene: Scene) -> str:
        mechanism = Mechanism.of(scene)
        for link in mechanism.links:
            moved = _moved(mechanism, link)
            if moved < _LEAST:
                held = f"PyBullet moves {_LEAST:.3g} or more"
                return f"{scene.bodies[link.body].name!r} has {moved:.3g} kg or kg·m², {held}"
        return ""

    def version(self) -> str:
        return package_version(self.package)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        method = next(iter(self.methods))
        if profile == "native":
            usual = {
                "solver_iterations": 50,
                "residual_threshold": 1e-7,
                "erp": 0.2,
                "linear_damping": 0.04,
                "angular_damping": 0.04,
            }
            step = nearest_step(scene.clock.frame, _USUAL_STEP)
            if scene.contacts:
                usual |= {**_USUAL_CONTACT, "contact_recovery": step / _USUAL_CONTACT_ERP}
            return Settings(method, step, usual)
        longest = min(_CAREFUL_STEP, spring_step(scene, angle=_SPRING_ANGLE, decay=_DECAY))
        step = careful_step(scene.clock.frame, longest, _CAREFUL_COUNT)
        return Settings(method, step, _CAREFUL_CONTACT if scene.contacts else {})

    def load(self, scene: Scene, settings: Settings) -> Run:
        for name, (low, high) in _OPTION_RANGES.items():
            value = self.option(settings, name)
            if not (isinstance(value, int | float) and low <= value <= high):
                msg = f"option {name} of pybullet: got {value!r}, allowed is {low:g} to {high:g}"
                raise InputError(msg)
        return _Run(self, scene, settings)


class _Run(Run):
    """A world of its own in a connection of its own."""

    def __init__(self, adapter: PyBullet, scene: Scene, settings: Settings) -> None:
        self._client = Client()
        self._mechanism = mechanism = Mechanism.of(scene)
        self._frame = scene.clock.frame
        self._substeps = settings.substeps(self._frame)
        self._step = _divisible_step(self._frame, self._substeps)
        self._client.build("setGravity", *scene.gravity)
        self._client.build(
            "setPhysicsEngineParameter",
            numSolverIterations=int(adapter.option(settings, "solver_iterations")),
            solverResidualThreshold=float(adapter.option(settings, "residual_threshold")),
            erp=float(adapter.option(settings, "erp")),
            deterministicOverlappingPairs=1,
        )
        damping = Damping(
            float(adapter.option(settings, "linear_damping")),
            float(adapter.option(settings, "angular_damping")),
        )
        self._contact = self._lay_ground(adapter, settings)
        self._model = Model(self._client, mechanism, damping, self._contact)
        self._loads = Loads(self._client, self._model, mechanism)
        self._advance = self._client.function("stepSimulation")
        self._set_stepping(self._substeps)
        self.size = self._model.size
        # Only ball joints and free bodies are integrated as rotations.
        turning = [link for link in mechanism.links if not link.joint or link.joint.kind == "ball"]
        self._turning = np.array([link.body for link in turning], dtype=np.int64)
        self._carrier = np.array([link.parent for link in turning], dtype=np.int64)

    def _lay_ground(self, adapter: PyBullet, settings: Settings) -> Contact | None:
        scene = self._mechanism.scene
        if scene.ground is None:
            return None
        recovery, threshold, reach, slop = (
            float(adapter.option(settings, name))
            for name in ("contact_recovery", "bounce_threshold", "contact_reach", "contact_slop")
        )
        threshold = threshold or _FALLS * math.hypot(*scene.gravity) * self._step
        turns = bool(adapter.option(settings, "friction_axes"))
        law = Law(recovery, threshold, reach, slop, turns)
        return Contact(self._client, self._mechanism, scene.ground, law, self._step)

    def rollout(self, batch: Batch) -> Trajectory:
        shape = (len(batch), batch.steps + 1, self._mechanism.body_count, 13)
        told = np.full(shape, np.nan)
        each_step = self._loads.change_within_frame(batch.torque)
        self._set_stepping(1 if each_step else self._substeps)
        for row in range(len(batch)):
            self._roll(batch, row, told[row], self._substeps if each_step else 1)
        failures = tuple(self._failure(frames) for frames in told)
        for frames, failure in zip(told, failures, strict=True):
            if failure is not None:
                frames[failure.frame :] = np.nan
        states = self._model.states(told)
        return Trajectory(
            np.arange(batch.steps + 1, dtype=np.float64) * self._frame,
            states.position.copy(),
            self._mechanism.body_orientation(states.native),
            states.velocity.copy(),
            states.angular_velocity.copy(),
            failures,
        )

    def _roll(self, batch: Batch, row: int, told: Array, calls: int) -> None:
        """Fill in what Bullet tells of every frame (frame, body, 13), up to a blow-up."""
        read, apply, advance = self._model.read, self._loads.apply, self._advance
        self._start(batch, row)
        here = told[0] = read()
        for k in range(batch.steps):
            force, torque = batch.force[row, k], batch.torque[row, k]
            if self._contact:
                self._contact.turn(self._model.states(here), self._frame)
            for _ in range(calls):
                apply(force, torque, here)
                advance()
                here = read()
            told[k + 1] = here
            # Written so that NaN counts as bad.
            if not np.abs(here[:, RATES]).max() <= _BLOW_UP:
                return

    def _start(self, batch: Batch, row: int) -> None:
        if self._contact:
            self._contact.forget()
        native = self._mechanism.native_rotation(batch.orientation[row])
        self._model.put(
            BodyStates(
                batch.position[row], native, batch.velocity[row], batch.angular_velocity[row]
            )
        )

    def _failure(self, told: Array) -> Failure | None:
        """Find what first went wrong in a trajectory (frame, body, 13): Bullet never says it."""
        state = self._model.states(told)
        fine = np.isfinite(told).all(axis=(1, 2))
        fine &= np.abs(told[..., RATES]).max(axis=(1, 2)) <= _BLOW_UP
        fine &= self._turn(state) <= _TURN_CAP
        if self._contact:
            fine &= self._contact.heights(state).min(axis=-1) >= 0.0
        if fine.all():
            return None
        first = int(fine.argmin())
        # Frame 0 is the start, which is given.
        return Failure(max(1, first), self._trouble(self._model.states(told[first])))

    def _turn(self, state: BodyStates) -> Array:
        """Largest angle [rad] by which a body turns against its carrier in a step, shape (…)."""
        rate = state.angular_velocity
        carried = np.concatenate([rate, np.zeros_like(rate[..., :1, :])], axis=-2)
        relative = carried[..., self._turning, :] - carried[..., self._carrier, :]
        return np.asarray(self._step * np.linalg.norm(relative, axis=-1).max(axis=-1, initial=0.0))

    def _trouble(self, state: BodyStates) -> str:
        """Say what is wrong with a state."""
        rates = np.concatenate([state.velocity, state.angular_velocity])
        if not (np.isfinite(rates).all() and np.isfinite(state.position).all()):
            return "the state is not finite"
        fastest = np.abs(rates).max()
        if fastest > _BLOW_UP:
            return f"blow-up: {fastest:.3g} m/s or rad/s, the engine cuts at {SPEED_CAP:g}"
        turn = self._turn(state)
        if turn > _TURN_CAP:
            return f"a body turns by {turn:.3g} rad in a step, the engine cuts that at π/4"
        return self._contact.trouble(state) if self._contact else "a rotation is not finite"

    def _set_stepping(self, substeps: int) -> None:
        # Loads stay as they are over the sub-steps of one call.
        self._client.build(
            "setPhysicsEngineParameter", fixedTimeStep=self._step * substeps, numSubSteps=substeps
        )

    def readback(self, batch: Batch) -> Readback:
        inertia = self._model.inertia()  # puts the model at its reference pose
        self._start(batch, 0)
        told = self._model.read()
        state = self._model.states(told)
        world = self._client.function("getPhysicsEngineParameters")()
        joint_axis = self._model.joint_axis()
        return Readback(
            mass=self._model.mass(),
            inertia=inertia,
            com=state.position,
            orientation=self._mechanism.body_orientation(state.native),
            velocity=state.velocity,
            angular_velocity=state.angular_velocity,
            gravity=np.array([world[f"gravityAcceleration{axis}"] for axis in "XYZ"]),
            step=world["fixedTimeStep"] / max(1, world["numSubSteps"]),
            joint_axis=joint_axis,
            damping=self._model.damping(),
            contact=self._contact.readback(self._model.address) if self._contact else None,
            sphere=self._contact.centers(self._model.address, told) if self._contact else None,
            anchor=self._model.anchors(told),
            spring=self._loads.springs(state),
        )

    def native(self, batch: Batch) -> str:
        self._start(batch, 0)
        if self._contact:
            self._contact.turn(self._model.states(self._model.read()), self._frame)
        calls = self._substeps if self._mechanism.springs else 1
        self._set_stepping(self._substeps // calls)
        model, count = self._model, calls * self._mechanism.scene.clock.steps
        return self._client.listing() + script(
            self._mechanism, model.principal, model.address, count
        )

    def close(self) -> None:
        self._client.close()


def _moved(mechanism: Mechanism, link: Link) -> float:
    """Give what a body has against the motion of its joint: mass [kg] or moment [kg·m²]."""
    mass, joint = float(mechanism.mass[link.body]), link.joint
    if joint is None or joint.kind == "slider":
        return mass
    if joint.kind != "hinge":
        return np.inf
    arm = np.cross(joint.axis, joint.in_child)
    return float(joint.axis @ mechanism.inertia[link.body] @ joint.axis + mass * arm @ arm)


def _divisible_step(frame: float, substeps: int) -> float:
    """The step without its last bits, so that `substeps` of them add up without rounding.

    Bullet counts the steps of a frame as the whole part of frame / step and carries the rest
    over: rounded down it takes one too few, now and then.
    """
    mantissa, exponent = math.frexp(frame / substeps)
    bits = 53 - substeps.bit_length()
    return math.ldexp(round(math.ldexp(mantissa, bits)), exponent - bits)

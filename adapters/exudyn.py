"""Exudyn (https://github.com/jgerstmayr/EXUDYN): maximal coordinates, exact constraints."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any, ClassVar

import exudyn
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.engine import (
    Adapter,
    Feature,
    Method,
    ModelSize,
    Option,
    Profile,
    Readback,
    Run,
    Settings,
)
from mbds_xsim.errors import InputError, UnknownName
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory

from ._exudyn_listing import bodies_listing
from ._exudyn_settings import LINEAR_SOLVERS, Stepping
from ._exudyn_state import BodyCoordinates

__all__ = ["Exudyn"]

Array = NDArray[np.float64]

_NATIVE_STEP = 0.001
_MATCHED_STEP = 0.001
# A body that crosses so many scene lengths in a frame has blown up.
_LENGTHS_PER_FRAME = 1e3
# Exudyn keeps the inertia tensor as xx, yy, zz, yz, xz, xy.
_VOIGT = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
_AXIS_COLUMN = {"JointRevoluteZ": 2, "JointPrismaticX": 0}
_EXPLICIT = "Exudyn's explicit solvers have no Lagrange multipliers for it"
_JOINTS = tuple(
    feature
    for feature in Feature
    if feature in (Feature.BALL, Feature.HINGE, Feature.SLIDER, Feature.FIXED)
    or feature.name.startswith("LOOP_")
    or feature is Feature.DISTANCE_LINK
)
_NO_JOINTS = dict.fromkeys(_JOINTS, _EXPLICIT)


class Exudyn(Adapter):
    """Rigid bodies with six coordinates each; joints are constraints with multipliers."""

    name = "exudyn"
    package = "exudyn"
    methods: ClassVar = {
        "trapezoidal": Method("trapezoidal", "trapezoidal", 2),
        "generalised-alpha": Method("generalised-alpha", "generalised-alpha", 2),
        "RK44": Method("RK44", "RK4", 4, _NO_JOINTS),
        "RK67": Method("RK67", "Runge-Kutta 6(7)", 6, _NO_JOINTS),
    }
    options: ClassVar = {
        "spectral_radius": Option(
            0.9, "of generalised-alpha at infinite frequency: 1 damps nothing, 0 the most"
        ),
        "linear_solver": Option(
            "auto", "EXUdense, EigenDense or EigenSparse; auto takes the faster for the size"
        ),
        "modified_newton": Option(
            True, "whether Newton's method keeps its Jacobian over several steps"
        ),
    }
    limits: ClassVar = {Feature.CONTACT: "contact is not translated yet"}
    coordinates = "maximal"

    def version(self) -> str:
        return version(self.package)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        frame = scene.clock.frame
        if profile == "native":
            # `SolveDynamic` has no step of its own: 100 steps over whatever time is asked for.
            # The engine's examples of such mechanisms mostly take 1 ms.
            return Settings(
                "generalised-alpha",
                frame / max(1, round(frame / _NATIVE_STEP)),
                {"linear_solver": "EXUdense"},
            )
        return Settings("trapezoidal", frame / max(1, round(frame / _MATCHED_STEP)))

    def load(self, scene: Scene, settings: Settings) -> Run:
        solver, radius = (
            self.option(settings, key) for key in ("linear_solver", "spectral_radius")
        )
        if solver not in LINEAR_SOLVERS:
            raise UnknownName.of("linear solver of exudyn", str(solver), list(LINEAR_SOLVERS))
        if not (isinstance(radius, int | float) and 0 <= radius <= 1):
            msg = f"spectral_radius: got {radius!r}, allowed is 0 to 1"
            raise InputError(msg)
        stepping = Stepping(
            method=settings.method,
            frame=scene.clock.frame,
            substeps=settings.substeps(scene.clock.frame),
            linear_solver=solver,
            spectral_radius=float(radius),
            modified_newton=bool(self.option(settings, "modified_newton")),
        )
        return _Run(Mechanism.of(scene), stepping)


class _Run(Run):
    def __init__(self, mechanism: Mechanism, stepping: Stepping) -> None:
        self._mechanism = mechanism
        self._coordinates = BodyCoordinates(mechanism)
        self._listing = bodies_listing(mechanism) + stepping.listing(mechanism)
        exudyn.config.printToConsole = False
        exudyn.config.suppressWarnings = True
        # The listing is the model: running it leaves no call that it does not show.
        self._native: dict[str, Any] = {}
        exec(compile(self._listing, "<exudyn model>", "exec"), self._native)
        self._mbs = self._native["mbs"]
        data = self._mbs.systemData
        self.size = ModelSize(coordinates=data.ODE2Size(), constraints=data.AEsize())
        # Also the multipliers, which a later trajectory would start Newton's method from.
        self._rest = data.GetSystemState(exudyn.ConfigurationType.Initial)

    def rollout(self, batch: Batch) -> Trajectory:
        start = self._start(batch)
        shape = (len(batch), batch.steps + 1, self.size.coordinates)
        positions, velocities = np.full(shape, np.nan), np.full(shape, np.nan)
        positions[:, 0], velocities[:, 0] = start
        reasons = [
            self._record(batch[[row]], positions[row], velocities[row]) for row in range(len(batch))
        ]
        return self._trajectory(self._coordinates.to_bodies(positions, velocities), reasons)

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        native = self._mechanism.native_rotation(batch.orientation)
        return self._coordinates.from_bodies(
            BodyStates(batch.position, native, batch.velocity, batch.angular_velocity)
        )

    def _put(self, coordinates: Array, velocities: Array) -> None:
        """Start afresh, without the solver's memory of an earlier trajectory."""
        data = self._mbs.systemData
        for configuration in (
            exudyn.ConfigurationType.Initial,
            exudyn.ConfigurationType.Current,
        ):
            data.SetSystemState(self._rest, configuration)
            data.SetODE2Coordinates(coordinates, configuration)
            data.SetODE2Coordinates_t(velocities, configuration)
            data.SetODE2Coordinates_tt(np.zeros_like(velocities), configuration)

    def _record(self, row: Batch, positions: Array, velocities: Array) -> str | None:
        """Step through one trajectory; tell what the solver stumbled over, if it did.

        Every frame is a run of the solver that begins with the accelerations of its own loads:
        carried on from the last frame's, a jump of the loads would cost an order of accuracy.
        """
        self._put(positions[0], velocities[0])
        data = self._mbs.systemData
        for k in range(row.steps):
            self._load(row.force[0, k], row.torque[0, k])
            try:
                self._native["step_frame"]()
            except Exception as error:
                return _reason(self._mbs.sys["dynamicSolver"], error)
            positions[k + 1] = data.GetODE2Coordinates()
            velocities[k + 1] = data.GetODE2Coordinates_t()
            if not np.isfinite(velocities[k + 1]).all():
                return "a velocity is not a number"
        return None

    def _load(self, force: Array, torque: Array) -> None:
        put = self._mbs.SetLoadParameter
        for load, value in zip(self._native["forces"], force, strict=True):
            put(load, "loadVector", value)
        for joint, pair, moment in zip(
            self._mechanism.hinges, self._native["torques"], torque, strict=True
        ):
            for load, sign in zip(pair, (1.0, -1.0), strict=True):
                if load is not None:
                    put(load, "loadVector", sign * moment * joint.axis)

    def _trajectory(self, bodies: BodyStates, reasons: list[str | None]) -> Trajectory:
        """Cut every trajectory off at its first frame that is not a number or a blow-up."""
        scene = self._mechanism.scene
        fastest = np.linalg.norm(bodies.velocity, axis=-1).max(axis=-1)
        limit = _LENGTHS_PER_FRAME * scene.length / scene.clock.frame
        failures: list[Failure | None] = []
        for row, reason in enumerate(reasons):
            # Written so that NaN counts as bad.
            bad = np.flatnonzero(~(fastest[row] < limit))
            if not len(bad):
                failures.append(None)
                continue
            blow_up = f"a body's speed passes {limit:.3g} m/s or is not a number"
            failures.append(Failure(int(bad[0]), reason or blow_up))
            for values in vars(bodies).values():
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
        coordinates, velocities = self._start(batch[:1])
        self._put(coordinates[0], velocities[0])
        stepping = self._native["settings"].timeIntegration
        turn = self._output("RotationMatrix").reshape(-1, 3, 3)
        held = [self._mbs.GetObject(body) for body in self._native["bodies"]]
        return Readback(
            mass=np.array([body["mass"] for body in held]),
            inertia=np.array([body["inertia"] for body in held])[:, _VOIGT],
            com=self._output("Position"),
            orientation=self._mechanism.body_orientation(rotation.from_matrix(turn)),
            velocity=self._output("Velocity"),
            angular_velocity=self._output("AngularVelocity"),
            gravity=self._gravity(),
            step=(stepping.endTime - stepping.startTime) / stepping.numberOfSteps,
            joint_axis=self._joint_axes(turn),
            damping=np.zeros(0),
        )

    def _output(self, name: str) -> Array:
        """What the engine says of every body, at the centre of mass it holds."""
        mbs = self._mbs
        variable = getattr(exudyn.OutputVariableType, name)
        return np.array(
            [
                mbs.GetObjectOutputBody(body, variable, mbs.GetObject(body)["centerOfMass"])
                for body in self._native["bodies"]
            ]
        )

    def _gravity(self) -> Array:
        """Sum of the loads per mass on a body; NaN where bodies differ."""
        mbs, bodies = self._mbs, [int(body) for body in self._native["bodies"]]
        held = np.zeros((len(bodies), 3))
        for k in range(mbs.systemData.NumberOfLoads()):
            load = mbs.GetLoad(k)
            if load["loadType"] == "MassProportional":
                body = int(mbs.GetMarker(load["markerNumber"])["bodyNumber"])
                held[bodies.index(body)] += load["loadVector"]
        return held[0] if not np.ptp(held, axis=0).any() else np.full(3, np.nan)

    def _joint_axes(self, turn: Array) -> Array:
        """Axes as the parent's marker holds them, in W."""
        axes = []
        for placed, number in zip(self._mechanism.joints, self._native["joints"], strict=True):
            joint = self._mbs.GetObject(number)
            if joint["objectType"] in _AXIS_COLUMN:
                marker = self._mbs.GetMarker(joint["markerNumbers"][0])
                local = marker["localHT"][:3, :3] @ joint["rotationMarker0"]
                axis = local[:, _AXIS_COLUMN[joint["objectType"]]]
                axes.append(axis if placed.parent == WORLD_INDEX else turn[placed.parent] @ axis)
        return np.array(axes).reshape(-1, 3)

    def native(self) -> str:
        return self._listing

    def close(self) -> None:
        self._native.clear()
        self._mbs = None


def _reason(solver: Any, error: Exception) -> str:
    """One line out of what a solver that gave up knows."""
    state = solver.conv
    if state.linearSolverFailed:
        return "the linear solver failed: the system is singular"
    if not state.newtonConverged:
        count = solver.it.newtonSteps
        return f"Newton's method stopped at a residual of {state.residual:.3g} after {count} steps"
    return f"{type(error).__name__}: {solver.GetErrorString() or error}"

"""A scene loaded into Exudyn: its rollouts, and the readback of its native model."""

from __future__ import annotations

from typing import Any

import exudyn
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.joint_space import BodyStates, joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism, PlacedJoint
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.adapter import (
    ModelSize,
    Readback,
    Run,
    blow_up,
    first_failures,
    recorded,
    too_fast,
)
from mbds_xsim.simulate.claims import ContactScales

from .brakes import read_brakes
from .contact import TouchingSpheres, contact_listing
from .model import HEAD, Formulation
from .older import in_its_words, silence
from .stepping import Stepping

_START = """
# Inputs are left out: of a frame, loads of `forces` and `torques` by mbs.SetLoadParameter.
start = exu.ConfigurationType.Initial
mbs.systemData.SetODE2Coordinates({coordinates!r}, start)
mbs.systemData.SetODE2Coordinates_t({velocities!r}, start)
"""
_MEMORY = "mbs.systemData.SetDataCoordinates({memory!r}, start)\n"
_RUN = """
# To watch it: container.renderer.Start(); container.renderer.DoIdleTasks()
for _ in range({count}):
    next_frame()
kinds = exu.OutputVariableType
for body, frame in enumerate(frames):  # centre of mass, rotation matrix, velocity, angular velocity
    shown = (kinds.Position, kinds.RotationMatrix, kinds.Velocity, kinds.AngularVelocity)
    print(body, *(mbs.GetMarkerOutput(frame, kind).tolist() for kind in shown))
"""


class ExudynRun(Run):
    """A run that executes the listing, then the solver once per frame."""

    def __init__(
        self, mechanism: Mechanism, model: Formulation, stepping: Stepping, scales: ContactScales
    ) -> None:
        self._mechanism = mechanism
        self._model = model
        listing = _listing(mechanism, model, scales) + stepping.listing(mechanism)
        self._listing = in_its_words(listing)
        silence()
        # The listing is the model: it shows every call that builds the model.
        self._names = model.names
        exec(compile(self._listing, "<exudyn model>", "exec"), self._names)
        self._mbs = self._names["mbs"]
        data = self._mbs.systemData
        self.size = ModelSize(data.ODE2Size(), data.AEsize(), count_pairs(mechanism))
        touching = bool(mechanism.scene.contacts)
        self._spheres = TouchingSpheres(mechanism, self._names) if touching else None
        self._counters = self._find_counters()
        # Includes the multipliers, from which a later trajectory would start Newton's method.
        self._rest = data.GetSystemState(exudyn.ConfigurationType.Initial)

    def rollout(self, batch: Batch) -> Trajectory:
        start = self._start(batch)
        shape = (len(batch), batch.steps + 1, self.size.coordinates)
        positions, velocities = np.full(shape, np.nan), np.full(shape, np.nan)
        positions[:, 0], velocities[:, 0] = start
        reasons = [
            self._record(batch[[row]], positions[row], velocities[row]) for row in range(len(batch))
        ]
        bodies = self._model.to_bodies(positions, velocities)
        failures = first_failures(
            too_fast(self._mechanism, bodies.velocity),
            lambda row, _: reasons[row] or blow_up(self._mechanism),
        )
        return recorded(self._mechanism, bodies, failures)

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        return self._model.from_bodies(BodyStates.of(self._mechanism, batch))

    def _put(self, row: Batch, coordinates: Array, velocities: Array) -> None:
        """Set the start of a single row without the solver's memory of an earlier trajectory."""
        data, kinds = self._mbs.systemData, exudyn.ConfigurationType
        for configuration in (kinds.Initial, kinds.Current):
            data.SetSystemState(self._rest, configuration)
            data.SetODE2Coordinates(coordinates, configuration)
            data.SetODE2Coordinates_t(velocities, configuration)
            data.SetODE2Coordinates_tt(np.zeros_like(velocities), configuration)
        if self._spheres is not None:
            self._names["before"][0] = None
        if len(memory := self._memory(row)):
            data.SetDataCoordinates(memory, kinds.Initial)
            data.SetDataCoordinates(memory, kinds.Current)

    def _memory(self, row: Batch) -> Array:
        """Return the data coordinates of a start: angles of counted hinges, then those of contacts.

        A counter knows an angle up to half a turn from its last one.
        """
        memory = np.zeros(self._mbs.systemData.DataSize())
        bodies = BodyStates.of(self._mechanism, row[[0]])
        for joint, place in self._counters:
            memory[place] = joint_coordinate(joint, bodies.position, bodies.native)[0]
        if self._spheres is not None:
            contacts = self._spheres.memory()
            memory[len(memory) - len(contacts) :] = contacts
        return memory

    def _find_counters(self) -> list[tuple[PlacedJoint, int]]:
        """Return the hinges whose turns are counted, and where among the data coordinates."""
        numbers = range(self._mbs.systemData.NumberOfNodes())
        sizes = [self._mbs.GetNode(k).get("numberOfDataCoordinates", 0) for k in numbers]
        first, joints = np.cumsum([0, *sizes]).tolist(), self._mechanism.joints
        return [(joints[k], first[int(node)]) for k, node in self._names.get("counters", ())]

    def _record(self, row: Batch, positions: Array, velocities: Array) -> str | None:
        """Step through one trajectory; return why it failed, or None.

        Every frame is a run of the solver that begins with the accelerations of its own loads.
        With the last frame's, a jump of the loads would cost an order of accuracy.
        """
        self._put(row, positions[0], velocities[0])
        data, torque = self._mbs.systemData, with_pushes(self._mechanism.drives, row.torque)
        for k in range(row.steps):
            self._load(row.force[0, k], torque[0, k])
            try:
                self._names["next_frame"]()
            except Exception as error:
                return _reason(self._mbs.sys["dynamicSolver"], error)
            if self._spheres is not None and self._spheres.has_penetration():
                return "a contact sphere is in the ground, or in another, up to its centre"
            positions[k + 1] = data.GetODE2Coordinates()
            velocities[k + 1] = data.GetODE2Coordinates_t()
            if not np.isfinite(velocities[k + 1]).all():
                return "a velocity is not a number"
        return None

    def _load(self, force: Array, torque: Array) -> None:
        put = self._mbs.SetLoadParameter
        if self._spheres is not None:
            pulls = np.linalg.norm(force, axis=-1) / self._mechanism.mass
            self._names["driven"][0] = float(pulls.max())
        for load, value in zip(self._names["forces"], force, strict=True):
            put(load, "loadVector", value)
        hinges = self._mechanism.hinges
        for drive, push in zip(self._names["drives"], torque[len(hinges) :], strict=True):
            self._mbs.SetObjectParameter(drive, "offset", push)
        for joint, pair, moment in zip(hinges, self._names["torques"], torque, strict=False):
            for load, sign in zip(pair, (1.0, -1.0), strict=True):
                if load is not None:
                    put(load, "loadVector", sign * moment * joint.axis)

    def readback(self, batch: Batch) -> Readback:
        coordinates, velocities = self._start(batch[:1])
        self._put(batch, coordinates[0], velocities[0])
        model = self._model
        mass, inertia, off, gravity = model.mass_properties()
        turn = self._output("RotationMatrix").reshape(-1, 3, 3)
        spin = self._output("AngularVelocity")
        arm = np.einsum("kij,kj->ki", turn, off)
        com = self._output("Position") + arm
        uniform = not np.ptp(gravity, axis=0).any()
        stepping = self._names["settings"].timeIntegration
        friction, limits = read_brakes(model.objects("brakes"), self._mechanism)
        ties = model.objects("couplings")
        # Exudyn cannot report the limit of a drive's force function.
        drives = [(law["stiffness"], law["damping"], np.nan) for law in model.objects("drives")]
        return Readback(
            mass=mass,
            inertia=inertia,
            com=com,
            orientation=self._mechanism.body_orientation(rotation.from_matrix(turn)),
            velocity=self._output("Velocity") + np.cross(spin, arm),
            angular_velocity=spin,
            gravity=gravity[0] if uniform else np.full(3, np.nan),
            step=(stepping.endTime - stepping.startTime) / stepping.numberOfSteps,
            **model.joint_fields(com, turn),
            damping=None,
            **(self._spheres.readback() if self._spheres is not None else {}),
            spring=self._springs(),
            drive=np.array(drives),
            coupling=np.array([(1.0 / t["factor1"], t["offset"] / t["factor1"]) for t in ties]),
            friction=friction,
            limits=limits,
        )

    def _springs(self) -> Array:
        springs, length = self._model.objects("springs"), exudyn.OutputVariableType.Distance
        columns = [[s[key] for s in springs] for key in ("stiffness", "damping", "referenceLength")]
        numbers = self._names["springs"]
        columns += [[self._mbs.GetObjectOutput(number, length) for number in numbers]]
        return np.column_stack(columns)

    def _output(self, name: str) -> Array:
        """Return an output variable of the markers at the centres of mass."""
        variable = getattr(exudyn.OutputVariableType, name)
        frames = self._names["frames"]
        return np.array([self._mbs.GetMarkerOutput(frame, variable) for frame in frames])

    def native(self, batch: Batch) -> str:
        coordinates, velocities = (values[0] for values in self._start(batch))
        self._put(batch, coordinates, velocities)
        start = _START.format(coordinates=coordinates.tolist(), velocities=velocities.tolist())
        if len(memory := self._memory(batch)):
            start += _MEMORY.format(memory=memory.tolist())
        shapes = "\n".join(self._model.graphics())
        run = _RUN.format(count=self._mechanism.scene.clock.steps)
        return f"{self._listing}\n{shapes}\n{start}{run}"

    def close(self) -> None:
        self._names.clear()
        self._mbs = None


def _listing(mechanism: Mechanism, model: Formulation, scales: ContactScales) -> str:
    lines = [HEAD, *model.statements()]
    if mechanism.scene.contacts:
        lines += contact_listing(mechanism, scales, model.marker)
    return "\n".join([*lines, "mbs.Assemble()", ""])


def _reason(solver: Any, error: Exception) -> str:
    """Describe in one line why the solver gave up."""
    state = solver.conv
    if state.linearSolverFailed:
        return "the linear solver failed: the system is singular"
    if not state.newtonConverged:
        count = solver.it.newtonSteps
        return f"Newton's method stopped at a residual of {state.residual:.3g} after {count} steps"
    return f"{type(error).__name__}: {solver.GetErrorString() or error}"

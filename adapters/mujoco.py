"""MuJoCo (https://mujoco.org): reduced coordinates, soft equality constraints for loops."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.assembly import assemble
from mbds_xsim.engine import (
    LOOPS,
    Adapter,
    ContactScales,
    Feature,
    Method,
    ModelSize,
    Option,
    Profile,
    Readback,
    Run,
    Settings,
    Sweep,
)
from mbds_xsim.errors import InputError, UnknownName
from mbds_xsim.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.reference.ball import has_only_balls
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory
from mbds_xsim.steps import careful_step, nearest_step

from ._mujoco_contact import CONTACT_LAW, Impact, Spheres, sunk_spheres
from ._mujoco_model import Stepping, closing_point, mjcf, text, with_start
from ._mujoco_state import Coordinates
from ._mujoco_steps import FinerNearGround, OneCall, Stepper

__all__ = ["MuJoCo"]

Array = NDArray[np.float64]

_NATIVE_OPTIONS = {"loop_time_constant": 0.0, "link_time_constant": 0.0, "contact_substeps": 0}
_SOLVERS = ("Newton", "CG", "PGS")
# An ordinary user's [s].
_DEFAULT_STEP = 0.002
# Keeps RK4 within the budgets of chains of links of 0.1 m and more [s].
_CAREFUL_STEP = 0.005
_CAREFUL_LINK_STEP = 0.001
_CAREFUL_COUNT = 4
# Time constant of MuJoCo's own contact, `solref` [s].
_DEFAULT_IMPACT = 0.02
# With fewer steps an impact's restitution depends on how it lies between them.
_SHORTEST_IMPACT = 4
# Of the reciprocal of a spring's rate: forty steps a period.
_SPRING_FRACTION = 0.15
# A body that crosses so many scene lengths in a frame has blown up.
_LENGTHS_PER_FRAME = 1e3


class MuJoCo(Adapter):
    """Tree joints are exact, loops and distance links are soft constraints tied to the step."""

    name = "mujoco"
    package = "mujoco"
    methods: ClassVar = {
        "RK4": Method("RK4", "RK4", 4, loop_order=2),
        "Euler": Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5),
        # Implicit in the forces of dampers alone, so without any it is Euler to the last bit.
        "implicitfast": Method("implicitfast", "semi-implicit Euler", 1, velocity_lag=-0.5),
    }
    options: ClassVar = {
        # Shorter, and RK4's stages, which leave the constraint by O(h²), come back as an error of
        # the velocities; longer, and gaps widen. Euler is unstable below 1.3.
        "loop_time_constant": Option(
            3.0, "of loop constraints, in steps; 0 leaves MuJoCo's default solref and solimp"
        ),
        # MuJoCo leaves J̇·v out of a tendon's row, so a gap of |J̇·v|·τ² stays.
        "link_time_constant": Option(
            1.5, "of distance links, in steps; 0 leaves MuJoCo's default solref and solimp"
        ),
        "contact_substeps": Option(
            50,
            "semi-implicit Euler steps into which a step near the ground is divided; 0 leaves "
            "MuJoCo's default contact",
        ),
        "impact_steps": Option(
            12,
            "such steps that an impact lasts, 4 or more; or 1, right where all contact spheres are "
            "around the centres of mass of free bodies, the others",
        ),
        "solver": Option("Newton", "constraint solver: Newton, CG or PGS"),
    }
    sweeps: ClassVar = {
        "loop_time_constant": Sweep((0.0, 1.5, 6.0), needs=LOOPS),
        "link_time_constant": Sweep((0.0, 3.0), needs=frozenset({Feature.DISTANCE_LINK})),
        "contact_substeps": Sweep((10, 50, 200), needs=frozenset({Feature.CONTACT})),
        "impact_steps": Sweep((4, 12, 36), needs=frozenset({Feature.CONTACT})),
        "solver": Sweep(_SOLVERS, needs=LOOPS | {Feature.DISTANCE_LINK}),
    }
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "MuJoCo has no equality constraint that leaves a sliding direction "
        "free; close the loop at another joint",
    }
    coordinates = "reduced"
    contact_law = CONTACT_LAW

    def version(self) -> str:
        return version(self.package)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        frame = scene.clock.frame
        if profile == "native":
            return Settings("Euler", nearest_step(frame, _DEFAULT_STEP), _NATIVE_OPTIONS)
        longest = _CAREFUL_STEP if not scene.distance_links else _CAREFUL_LINK_STEP
        longest = min(longest, _SPRING_FRACTION / max(_spring_rates(scene), default=1e-9))
        impact = {"impact_steps": 1} if has_only_balls(Mechanism.of(scene)) else {}
        return Settings("RK4", careful_step(frame, longest, _CAREFUL_COUNT), impact)

    def contact_scales(self, settings: Settings) -> ContactScales:
        division = self.option(settings, "contact_substeps")
        if not division:
            return ContactScales(_DEFAULT_IMPACT)
        return ContactScales(self._impact_steps(settings) * settings.step / division)

    def load(self, scene: Scene, settings: Settings) -> Run:
        solver = self.option(settings, "solver")
        if solver not in _SOLVERS:
            raise UnknownName.of("solver of mujoco", str(solver), list(_SOLVERS))
        substeps = settings.substeps(scene.clock.frame)
        step = scene.clock.frame / substeps
        division = self._division(scene, settings)
        if division and solver == "PGS":
            msg = "solver: PGS does not converge on contacts, allowed is Newton or CG"
            raise InputError(msg)
        finer = step / division if division else 0.0
        stepping = Stepping(
            "Euler" if division else settings.method,
            finer or step,
            solver,
            step * self._steps(settings, "loop_time_constant"),
            step * self._steps(settings, "link_time_constant"),
            Impact(finer, self._impact_steps(settings)),
        )
        return _Run(Mechanism.of(scene), stepping, settings.method, substeps, division)

    def _division(self, scene: Scene, settings: Settings) -> int:
        """Finer steps of a step near the ground; 0 where contact needs none."""
        value = self.option(settings, "contact_substeps")
        if not (isinstance(value, int) and value >= 0):
            msg = f"contact_substeps: got {value!r}, allowed is a whole number of steps, or 0"
            raise InputError(msg)
        return value if scene.contacts else 0

    def _impact_steps(self, settings: Settings) -> int:
        value = self.option(settings, "impact_steps")
        if not (isinstance(value, int) and (value == 1 or value >= _SHORTEST_IMPACT)):
            msg = f"impact_steps: got {value!r}, allowed is 1, or {_SHORTEST_IMPACT} and more"
            raise InputError(msg)
        return value

    def _steps(self, settings: Settings, name: str) -> float:
        value = self.option(settings, name)
        if not (isinstance(value, int | float) and 0 <= value < math.inf):
            msg = f"{name}: got {value!r}, allowed is 0 or more steps"
            raise InputError(msg)
        return value


class _Run(Run):
    def __init__(
        self,
        mechanism: Mechanism,
        stepping: Stepping,
        method: str,
        count: int,
        division: int,
    ) -> None:
        self._mechanism = mechanism
        self._division = division
        self._xml = text(mjcf(mechanism, stepping))
        self._model: Any = mujoco.MjModel.from_xml_string(self._xml)
        self._data: Any = mujoco.MjData(self._model)
        self._coordinates = Coordinates(self._model, mechanism)
        # MuJoCo numbers bodies depth first, so only names tell.
        self._bodies = [self._model.body(body.name).id for body in mechanism.scene.bodies]
        self._spheres = Spheres(self._model, mechanism)
        self._stepper: Stepper = OneCall(count)
        if division:
            self._stepper = FinerNearGround(self._model, self._spheres, method, count, division)
        mujoco.mj_forward(self._model, self._data)
        self.size = ModelSize(
            coordinates=self._model.nv,
            constraints=self._data.ne,
            contact_pairs=self._model.npair,
        )

    def rollout(self, batch: Batch) -> Trajectory:
        qpos, qvel = self._start(batch)
        frames = batch.steps + 1
        positions = np.full((len(batch), frames, self._model.nq), np.nan)
        velocities = np.full((len(batch), frames, self._model.nv), np.nan)
        positions[:, 0], velocities[:, 0] = qpos, qvel
        reasons = []
        with _captured_warnings() as warnings:
            for row in range(len(batch)):
                self._put(qpos[row], qvel[row])
                self._record(batch[[row]], positions[row], velocities[row])
                reasons.append(warnings[0] if warnings else None)
                warnings.clear()
        links = self._coordinates.to_links(positions, velocities)
        return self._trajectory(to_bodies(self._mechanism, links), reasons)

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        bodies = BodyStates(
            batch.position,
            self._mechanism.native_rotation(batch.orientation),
            batch.velocity,
            batch.angular_velocity,
        )
        return self._coordinates.from_links(to_links(self._mechanism, bodies))

    def _put(self, qpos: Array, qvel: Array) -> None:
        """Start afresh, without the solver's memory of an earlier trajectory."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = qpos, qvel

    def _record(self, row: Batch, positions: Array, velocities: Array) -> None:
        """Step through one trajectory; frames from a warning on stay as they are."""
        model, data = self._model, self._data
        for k in range(row.steps):
            # At the centre of mass and along W in every stage of a step.
            data.xfrc_applied[self._bodies, :3] = row.force[0, k]
            data.ctrl[:] = row.torque[0, k]
            self._stepper.frame(model, data)
            if data.warning.number.any():
                return
            positions[k + 1], velocities[k + 1] = data.qpos, data.qvel

    def _trajectory(self, bodies: BodyStates, reasons: list[str | None]) -> Trajectory:
        """Cut every trajectory off at its first frame that is not a number or a blow-up."""
        scene = self._mechanism.scene
        fastest = np.linalg.norm(bodies.velocity, axis=-1).max(axis=-1)
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

    def native(self) -> str:
        start = to_links(self._mechanism, BodyStates(**vars(assemble(self._mechanism))))
        return with_start(self._xml, *self._coordinates.from_links(start), self._stepper.remark)

    def close(self) -> None:
        self._model = self._data = None


def _spring_rates(scene: Scene) -> list[float]:
    """Give the fastest rate [rad/s] of each spring–damper, its ends as light as they can be."""
    mechanism = Mechanism.of(scene)
    rates = []
    for spring in mechanism.springs:
        yielding = sum(
            1.0 / mechanism.mass[body]
            + point @ point / np.linalg.eigvalsh(mechanism.inertia[body])[0]
            for body, point in zip(spring.bodies, spring.in_body, strict=True)
            if body != WORLD_INDEX
        )
        rates.append(float(np.sqrt(spring.stiffness * yielding) + spring.damping * yielding))
    return [rate for rate in rates if rate > 0]


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

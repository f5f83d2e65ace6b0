"""DART: generalised coordinates, one skeleton, loops closed by velocity constraints."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from typing import ClassVar, Literal

import dartpy
import numpy as np
from numpy.typing import NDArray

from mbds_xsim import rotation
from mbds_xsim.engine import (
    LOOPS,
    Adapter,
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
from mbds_xsim.joint_space import BodyStates
from mbds_xsim.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.registry import package_version
from mbds_xsim.scene import Scene
from mbds_xsim.state import Batch, Failure, Trajectory
from mbds_xsim.steps import careful_step, nearest_step
from mbds_xsim.stiffness import spring_step

from ._dart_contact import (
    CONTACT_LAW,
    DETECTORS,
    SOLVERS,
    ContactSolver,
    centers,
    contact_failures,
    contact_statements,
    pairs,
)
from ._dart_listing import build_listing
from ._dart_loads import Loads
from ._dart_model import Model
from ._dart_script import script
from ._dart_steppers import ForwardDynamicsRK4, SemiImplicitEuler, Stepper
from ._dart_warnings import CaughtWarnings

__all__ = ["Dart"]

Array = NDArray[np.float64]

# A joint rate [rad/s or m/s] that only a blow-up reaches.
_BLOW_UP = 1e5
_NATIVE_STEP = 1e-3
# Keeps the budgets of the pendulums; in a scene that moves faster, a hundredth of a frame.
_CAREFUL_STEP, _CAREFUL_COUNT = 2e-5, 100
# That a spring's oscillation turns by, and a damper's motion decays, in a step at most.
_SPRING_ANGLE, _DECAY = 0.5, 0.5
# Keeps the ball scenes' budgets; what follows on an impact of several spheres knows none.
_CONTACT_STEP = 1e-4
# The gap falls up to 1, where an error that is put right too late would be put right twice.
_LOOP_ERROR_REDUCTION = 0.8
_ERROR_REDUCTION = "error_reduction"
_DETECTOR, _FRICTION = "collision_detector", "friction_solver"
_NO_CONTACT = "the toolkit's RK4 on the engine's forward dynamics solves no impacts"
_NO_LOOPS = "the toolkit's RK4 on the engine's forward dynamics solves no constraints"
_INPUTS = """
# Inputs are left out. Of a frame: joints[k].setForce(0, torque) of each driven hinge; of a step:
# bodies[k].setExtForce(force) of each pushed body, as DART turns forces with bodies.
"""
_STEPPERS: dict[str, type[Stepper]] = {
    "semi-implicit-euler": SemiImplicitEuler,
    "forward-dynamics-RK4": ForwardDynamicsRK4,
}


class Dart(Adapter):
    """DART through dartpy."""

    name = "dart"
    package = "dartpy"
    coordinates: ClassVar[Literal["reduced", "maximal"]] = "reduced"
    contact_law = CONTACT_LAW
    methods: ClassVar[Mapping[str, Method]] = {
        "semi-implicit-euler": Method(
            "semi-implicit-euler", "semi-implicit Euler", 1, velocity_lag=-0.5
        ),
        "forward-dynamics-RK4": Method(
            "forward-dynamics-RK4",
            "toolkit RK4",
            4,
            refuses={
                Feature.LOOP_BALL: _NO_LOOPS,
                Feature.LOOP_HINGE: _NO_LOOPS,
                Feature.LOOP_FIXED: _NO_LOOPS,
                Feature.CONTACT: _NO_CONTACT,
            },
            own=False,
        ),
    }
    options: ClassVar[Mapping[str, Option]] = {
        _ERROR_REDUCTION: Option(
            0.01, "share of a loop's gap that DART closes in a step (its error reduction parameter)"
        ),
        _DETECTOR: Option("fcl", f"what finds contacts: {', '.join(DETECTORS)}"),
        _FRICTION: Option(
            "dantzig",
            "what solves contacts: dantzig (friction bounded by a box along x and y, "
            "DART's own choice) or nsgs (a round cone)",
        ),
    }
    sweeps: ClassVar[Mapping[str, Sweep]] = {
        _ERROR_REDUCTION: Sweep((0.01, 0.2, 0.8), needs=LOOPS),
        _FRICTION: Sweep(tuple(SOLVERS), needs=frozenset({Feature.CONTACT})),
    }
    limits: ClassVar[Mapping[Feature, str]] = {
        Feature.LOOP_SLIDER: "DART has no constraint that keeps a point on a line",
        Feature.DISTANCE_LINK: "DART has no constraint that keeps a distance",
    }

    def version(self) -> str:
        return package_version(self.package)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        method, frame = next(iter(self.methods)), scene.clock.frame
        if profile == "native":
            return Settings(method, nearest_step(frame, _NATIVE_STEP))
        options: dict[str, float | str] = {}
        if Mechanism.of(scene).loops:
            options[_ERROR_REDUCTION] = _LOOP_ERROR_REDUCTION
        if scene.contacts:
            options |= {_DETECTOR: "ode", _FRICTION: "nsgs"}
        longest = _CONTACT_STEP if scene.contacts else _CAREFUL_STEP
        longest = min(longest, spring_step(scene, angle=_SPRING_ANGLE, decay=_DECAY))
        return Settings(method, careful_step(frame, longest, _CAREFUL_COUNT), options)

    def load(self, scene: Scene, settings: Settings) -> Run:
        share = float(self.option(settings, _ERROR_REDUCTION))
        if not 0.0 <= share <= 1.0:
            msg = f"{_ERROR_REDUCTION}: got {share}, allowed is 0 to 1"
            raise InputError(msg)
        detector, solver = (
            self._name(settings, option, allowed)
            for option, allowed in ((_DETECTOR, DETECTORS), (_FRICTION, SOLVERS))
        )
        step = scene.clock.frame / settings.substeps(scene.clock.frame)
        contact = list(contact_statements(Mechanism.of(scene), step, detector, solver))
        return _DartRun(scene, settings, share, contact)

    def _name(self, settings: Settings, option: str, allowed: Collection[str]) -> str:
        name = str(self.option(settings, option))
        if name not in allowed:
            raise UnknownName.of(option, name, list(allowed))
        return name


class _DartRun(Run):
    def __init__(
        self, scene: Scene, settings: Settings, error_reduction: float, contact: list[str]
    ) -> None:
        self._mechanism = Mechanism.of(scene)
        self._step_count = settings.substeps(scene.clock.frame)
        self._step = scene.clock.frame / self._step_count
        self._frame = scene.clock.frame
        self._error_reduction = error_reduction
        self._listing = build_listing(self._mechanism, self._step, error_reduction, contact)
        with _error_reduction(error_reduction):
            self._model = Model(self._mechanism, self._listing)
        self._loads = Loads(self._model)
        self._contact = ContactSolver(self._model.world)
        self._stepper = _STEPPERS[settings.method](self._model, self._loads, self._step)
        rows = {"ball": 3, "hinge": 6, "fixed": 6}
        self.size = ModelSize(
            self._model.coordinate_count,
            sum(rows[joint.kind] for joint in self._mechanism.loops),
            len(scene.contacts),
        )

    def rollout(self, batch: Batch) -> Trajectory:
        model = self._model
        start_q, start_u = self._start(batch)
        q = np.full((len(batch), batch.steps + 1, model.coordinate_count), np.nan)
        u = np.full_like(q, np.nan)
        with _error_reduction(self._error_reduction), CaughtWarnings() as caught:
            failures = tuple(
                self._roll(batch, row, start_q[row], start_u[row], q[row], u[row], caught)
                for row in range(len(batch))
            )
        bodies = model.body_states(q, u)
        if self._mechanism.scene.contacts:
            failures = self._contact_checked(bodies, failures)
        orientation = self._mechanism.body_orientation(bodies.native)
        return Trajectory(
            self._frame * np.arange(batch.steps + 1, dtype=np.float64),
            bodies.position,
            _continuous(orientation, batch.orientation),
            bodies.velocity,
            bodies.angular_velocity,
            failures,
        )

    def _roll(
        self,
        batch: Batch,
        row: int,
        start_q: Array,
        start_u: Array,
        q: Array,
        u: Array,
        caught: CaughtWarnings,
    ) -> Failure | None:
        """Fill q and u (frame, coordinate) with one trajectory."""
        skeleton, printed = self._model.skeleton, caught.size()
        self._model.set_state(start_q, start_u)
        self._contact.restart()
        q[0], u[0] = start_q, start_u
        for k in range(batch.steps):
            self._loads.hold(batch.force[row, k], batch.torque[row, k])
            self._stepper.advance(self._step_count)
            here, rate = skeleton.getPositions(), skeleton.getVelocities()
            if caught.size() > printed:
                return Failure(k + 1, f"DART: {caught.first_since(printed)}")
            fastest = float(np.abs(rate).max())
            if not (fastest < _BLOW_UP and np.isfinite(here).all()):
                return Failure(k + 1, f"blow-up: a joint rate of {fastest:.3g} rad/s or m/s")
            if trouble := self._contact.trouble():
                return Failure(k + 1, trouble)
            q[k + 1], u[k + 1] = here, rate
        return None

    def _contact_checked(
        self, bodies: BodyStates, failures: tuple[Failure | None, ...]
    ) -> tuple[Failure | None, ...]:
        """End trajectories where contact went wrong; their later states become NaN."""
        found = contact_failures(self._mechanism, bodies, self._frame)
        first = tuple(_earlier(*two) for two in zip(failures, found, strict=True))
        for row, failure in enumerate(first):
            if failure is not None:
                for key in ("position", "native", "velocity", "angular_velocity"):
                    getattr(bodies, key)[row, failure.frame :] = np.nan
        return first

    def readback(self, batch: Batch) -> Readback:
        model = self._model
        q, u = self._start(batch[:1])
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
            joint_axis=self._joint_axes(),
            damping=self._damping(),
            contact=pairs(model.shapes),
            sphere=centers(model.shapes),
            anchor=self._anchors(),
            spring=self._loads.springs(),
        )

    def _joint_axes(self) -> Array:
        """Axes of hinges and sliders in W; a scene's joint may point against its tree link."""
        axes = []
        links = {link.joint.index: link for link in self._mechanism.links if link.joint}
        for joint in self._mechanism.joints:
            if joint.kind not in ("hinge", "slider"):
                continue
            link = links.get(joint.index)
            if link is None:
                axes.append(np.full(3, np.nan))
                continue
            sign = 1.0 if link.body == joint.child else -1.0
            turn = self._model.bodies[link.body].getWorldTransform().rotation()
            axes.append(sign * turn @ self._model.joints[link.body].getAxis())
        return np.array(axes).reshape(-1, 3)

    def _anchors(self) -> Array:
        """As fixed in the parent and in the child, in W; DART does not tell those of loops."""
        anchors = np.full((len(self._mechanism.joints), 2, 3), np.nan)
        for link in self._mechanism.links:
            if link.joint is None:
                continue
            joint, body = self._model.joints[link.body], self._model.bodies[link.body]
            above = joint.getTransformFromParentBodyNode().translation()
            if link.parent != WORLD_INDEX:
                above = self._model.bodies[link.parent].getWorldTransform().multiply(above)
            below = joint.getTransformFromChildBodyNode().translation()
            ends = (above, body.getWorldTransform().multiply(below))
            forwards = self._mechanism.joints[link.joint.index].child == link.body
            anchors[link.joint.index] = ends if forwards else ends[::-1]
        return anchors

    def _damping(self) -> Array:
        return np.array(
            [
                value
                for joint in self._model.joints
                for k in range(joint.getNumDofs())
                for value in (
                    joint.getDampingCoefficient(k),
                    joint.getCoulombFriction(k),
                    joint.getSpringStiffness(k),
                )
            ]
        )

    def native(self, batch: Batch) -> str:
        q, u = self._start(batch)
        count = self._step_count * self._mechanism.scene.clock.steps
        run = script(self._mechanism, q[0], u[0], self._stepper.call, count)
        return f"{self._listing}{_INPUTS}{run}"

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        return self._model.coordinates(
            batch.position, batch.orientation, batch.velocity, batch.angular_velocity
        )

    def close(self) -> None:
        vars(self).clear()


@contextlib.contextmanager
def _error_reduction(value: float) -> Iterator[None]:
    """Set DART's process-wide parameter, and put it back."""
    kinds = (dartpy.constraint.BallJointConstraint, dartpy.constraint.WeldJointConstraint)
    before = [kind.getErrorReductionParameter() for kind in kinds]
    try:
        for kind in kinds:
            kind.setErrorReductionParameter(value)
        yield
    finally:
        for kind, old in zip(kinds, before, strict=True):
            kind.setErrorReductionParameter(old)


def _earlier(first: Failure | None, second: Failure | None) -> Failure | None:
    if first is None or second is None:
        return first or second
    return min(first, second, key=lambda failure: failure.frame)


def _continuous(orientation: Array, start: Array) -> Array:
    """Give quaternions (trajectory, frame, body, 4) the sign that follows on the start's."""
    path = np.concatenate([start[:, None], orientation], axis=1)
    jumps = np.sum(path[:, 1:] * path[:, :-1], axis=-1) < 0
    return orientation * np.where(np.cumsum(jumps, axis=1) % 2, -1.0, 1.0)[..., None]

"""DART: generalised coordinates, one skeleton, loops closed by velocity constraints."""

from __future__ import annotations

from typing import ClassVar

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.stiffness import spring_step
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import CONTACTS, LOOPS, Feature, Method, Option, Sweep, named

from .contact import CONTACT_LAW, DETECTORS, SOLVERS, contact_statements
from .run import DartRun
from .stepping import STEPPERS

__all__ = ["Dart"]

_NATIVE_STEP = 1e-3
# Step that keeps the pendulums' budgets [s], and fewest steps in a frame for faster scenes.
_CAREFUL_STEP, _CAREFUL_COUNT = 2e-5, 100
# Largest phase [rad] of a spring's oscillation, and decay of a damper's motion, in one step.
_SPRING_ANGLE, _DECAY = 0.5, 0.5
# Keeps the ball scenes' budgets; motion after an impact of several spheres has no budget.
_CONTACT_STEP = 1e-4
# The gap shrinks as this share rises; at 1, an error corrected late would be corrected twice.
_LOOP_ERROR_REDUCTION = 0.8
_ERROR_REDUCTION = "error_reduction"
_DETECTOR, _FRICTION = "collision_detector", "friction_solver"
_NO_CONTACT = "this toolkit's RK4 steps DART's forward dynamics, without impacts or dry friction"
_NO_LOOPS = "this toolkit's RK4 steps DART's forward dynamics, without constraints"


class Dart(Adapter):
    """DART through dartpy."""

    name = "dart"
    revision = 5
    package = "dartpy"
    coordinates = "reduced"
    contact_law = CONTACT_LAW
    methods: ClassVar = named(
        Method("semi-implicit-euler", "semi-implicit Euler", 1, velocity_lag=-0.5),
        Method(
            "forward-dynamics-RK4",
            "toolkit RK4",
            4,
            refuses={
                Feature.LOOP_BALL: _NO_LOOPS,
                Feature.LOOP_HINGE: _NO_LOOPS,
                Feature.LOOP_FIXED: _NO_LOOPS,
                Feature.JOINT_FRICTION: _NO_CONTACT,
                Feature.JOINT_LIMITS: _NO_CONTACT,
                **dict.fromkeys(CONTACTS, _NO_CONTACT),
            },
            own=False,
        ),
    )
    options: ClassVar = {
        _ERROR_REDUCTION: Option(
            0.01,
            "share of a loop's gap that DART closes in a step (its error reduction parameter)",
            least=0,
            most=1,
        ),
        _DETECTOR: Option("fcl", f"collision detector: {', '.join(DETECTORS)}", names=DETECTORS),
        _FRICTION: Option(
            "dantzig",
            "contact solver: dantzig (friction bounded by a box along x and y, "
            "DART's own choice) or nsgs (a round cone)",
            names=SOLVERS,
        ),
    }
    sweeps: ClassVar = {
        _ERROR_REDUCTION: Sweep((0.01, 0.2, 0.8), needs=LOOPS),
        _FRICTION: Sweep(SOLVERS, needs=frozenset({Feature.CONTACT})),
    }
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "DART has no constraint that keeps a point on a line",
        Feature.DISTANCE_LINK: "DART has no constraint that keeps a distance",
        Feature.HELD_ARMATURE: "DART can model a rotor only as an implicit damper. The impulses by "
        "which it closes loops, brakes joints and keeps bodies out of the ground ignore it",
        Feature.COUPLING: "dartpy has no call that makes one joint follow another",
        Feature.JOINT_REBOUND: "DART's joint limits stop a joint; they cannot make it rebound",
        Feature.CLOSING_LOAD: "DART's joint springs and dampers act on coordinates, and a joint "
        "that closes a loop has none",
    }

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
        detector, solver = self.option(settings, _DETECTOR), self.option(settings, _FRICTION)
        step = scene.clock.frame / settings.substeps(scene.clock.frame)
        contact = contact_statements(Mechanism.of(scene), step, detector, solver)
        share = float(self.option(settings, _ERROR_REDUCTION))
        return DartRun(scene, settings, STEPPERS[settings.method], share, contact)

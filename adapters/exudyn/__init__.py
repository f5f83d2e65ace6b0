"""Exudyn (https://github.com/jgerstmayr/EXUDYN): maximal coordinates, exact constraints."""

from __future__ import annotations

from typing import ClassVar

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import (
    CONTACTS,
    LOOPS,
    ContactScales,
    Feature,
    Method,
    Option,
    Sweep,
    named,
)

from .contact import CONTACT_LAW
from .model import RigidBodies
from .run import ExudynRun
from .stepping import LINEAR_SOLVERS, Stepping, has_redundant_constraints
from .tree import KinematicTree

__all__ = ["Exudyn"]

_TREE = "tree-RK44"
_USUAL_STEP = 1e-3
# Step that keeps the pendulums' budgets [s], and fewest steps in a frame for faster scenes.
_CAREFUL_STEP, _CAREFUL_COUNT = 6.25e-4, 20
# Step where joints have friction or stops, whose error is the distance moved in a step [s].
_CAREFUL_LIMIT_STEP = 1.25e-4
# Slip speed [m/s]; a ball that rolls up a slope creeps 1 mm a second at 1e-2, 8 µm at 1e-4.
_CAREFUL_SLIP = 1e-4
# Without gravity a step ends on the touch to the last bit. The next one begins outside and goes in
# by its whole length, so an impact of n steps returns up to (π / n)² / 2 of the speed too much.
_CAREFUL_IMPACT = {"impact_steps": 48, "contact_substeps": 40}
# The slip speed is the engine's default, the only one that its contacts have.
_NATIVE_OPTIONS: dict[str, float | int | bool | str] = {
    "linear_solver": "EXUdense",
    "contact_substeps": 1,
    "slip_speed": 1e-3,
}
# With fewer steps an impact is not resolved.
_SHORTEST_IMPACT = 4
_CONSTRAINTS = LOOPS | {Feature.DISTANCE_LINK}
_NO_FRICTION = dict.fromkeys(
    CONTACTS,
    "friction in an impact is too stiff for Exudyn's explicit solvers, which then create energy",
)
_NO_JOINTS = _NO_FRICTION | dict.fromkeys(
    (Feature.BALL, Feature.HINGE, Feature.SLIDER, Feature.FIXED, *_CONSTRAINTS),
    "Exudyn's explicit solvers take no constraints",
)
_ONLY_A_TREE = {
    Feature.BALL: "a kinematic tree has only hinges and sliders, and three hinges in place of a "
    "ball joint are singular when the second turns by 90°",
    Feature.FIXED: "a kinematic tree has only hinges and sliders; merge the two bodies into one",
    Feature.FREE_BODY: "a kinematic tree is attached to the world",
    Feature.DRIVE: "the adapter limits servos through markers, and the coordinates of "
    "Exudyn's trees have none",
    **dict.fromkeys(
        (Feature.JOINT_FRICTION, Feature.JOINT_LIMITS, Feature.COUPLING),
        "Exudyn's friction, stops and gears act on markers, and its trees' coordinates have none",
    ),
    **_NO_FRICTION,
    **dict.fromkeys(_CONSTRAINTS, "Exudyn's explicit solvers take no constraints"),
}


class Exudyn(Adapter):
    """Exudyn: rigid bodies with six coordinates each; joints are constraints with multipliers."""

    name = "exudyn"
    revision = 7
    package = "exudyn"
    methods: ClassVar = named(
        Method(
            "trapezoidal",
            "trapezoidal",
            2,
            {Feature.COUPLING: "with gears, noise of 1e-8 rad in joint angles hides its order"},
        ),
        Method("generalised-alpha", "generalised-alpha", 2),
        Method("RK44", "RK4", 4, _NO_JOINTS),
        Method("RK67", "Runge-Kutta 6(7)", 6, _NO_JOINTS),
        Method(_TREE, "RK4", 4, _ONLY_A_TREE),
    )
    options: ClassVar = {
        "spectral_radius": Option(
            0.9, "of generalised-alpha at infinite frequency: 1 damps nothing, 0 damps most", 0, 1
        ),
        "linear_solver": Option(
            "auto",
            "EXUdense, EigenDense or EigenSparse; auto takes the fastest for the size",
            names=LINEAR_SOLVERS,
        ),
        "modified_newton": Option(
            True, "whether Newton's method keeps its Jacobian over several steps"
        ),
        "contact_substeps": Option(
            10, "number of substeps to a step, in frames in which a sphere may touch", least=1
        ),
        "impact_steps": Option(
            12, "number of these substeps that an impact lasts, at least", _SHORTEST_IMPACT
        ),
        "slip_speed": Option(
            1e-2,
            "[m/s]: below it friction is proportional to the slip, above it Coulomb's; 1e-4 is as "
            "stable as 1e-2 (14 and 15 of 36 cells of `stability throw`) and has Exudyn report "
            "15 of 22 failures, not 1 of 21",
            above=0,
        ),
    }
    sweeps: ClassVar = {
        "spectral_radius": Sweep((0.5, 1.0), methods=("generalised-alpha",)),
        "modified_newton": Sweep((True, False), methods=("trapezoidal", "generalised-alpha")),
        "contact_substeps": Sweep((5, 50), needs=frozenset({Feature.CONTACT})),
        "impact_steps": Sweep((4, 12, 36), needs=frozenset({Feature.CONTACT})),
        "slip_speed": Sweep((1e-3, 1e-1), needs=frozenset({Feature.CONTACT})),
    }
    limits: ClassVar[dict[Feature, str]] = {
        Feature.JOINT_REBOUND: "Exudyn's stops are springs and dampers, so the rebound depends on "
        "the mass that they stop",
    }
    coordinates = "maximal"
    contact_law = CONTACT_LAW

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        # `SolveDynamic` has no default step, it divides any time into 100; the engine's examples
        # of such mechanisms mostly use 1 ms.
        frame = scene.clock.frame
        if profile == "native":
            step = nearest_step(frame, _USUAL_STEP)
            return Settings("generalised-alpha", step, _NATIVE_OPTIONS)
        # With redundant constraints, Newton's method does not converge in the trapezoidal rule.
        mechanism = Mechanism.of(scene)
        damped = has_redundant_constraints(mechanism) or mechanism.couplings
        method = "generalised-alpha" if damped else "trapezoidal"
        # A kept Jacobian leaves an error of 2e-8 m that does not shrink with the step.
        options: dict[str, bool | float] = {"modified_newton": False}
        if scene.contacts:
            options["slip_speed"] = _CAREFUL_SLIP
            if not any(scene.gravity):
                options |= _CAREFUL_IMPACT
        longest = _CAREFUL_LIMIT_STEP if mechanism.braked else _CAREFUL_STEP
        return Settings(method, careful_step(frame, longest, _CAREFUL_COUNT), options)

    def contact_scales(self, settings: Settings) -> ContactScales:
        finest = settings.step / self.option(settings, "contact_substeps")
        duration = finest * self.option(settings, "impact_steps")
        return ContactScales(duration, self.option(settings, "slip_speed"))

    def load(self, scene: Scene, settings: Settings) -> Run:
        mechanism = Mechanism.of(scene)
        stepping = Stepping(
            method=settings.method,
            substeps=settings.substeps(scene.clock.frame),
            linear_solver=self.option(settings, "linear_solver"),
            spectral_radius=float(self.option(settings, "spectral_radius")),
            modified_newton=self.option(settings, "modified_newton"),
            division=self.option(settings, "contact_substeps") if scene.contacts else 0,
        )
        formulation = KinematicTree if settings.method == _TREE else RigidBodies
        model = formulation(mechanism, settings.step)
        return ExudynRun(mechanism, model, stepping, self.contact_scales(settings))

"""Drake (https://drake.mit.edu): Runge–Kutta integrators, or plants that step themselves."""

from __future__ import annotations

from typing import ClassVar

from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.stiffness import spring_step
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import LOOPS, ContactScales, Feature, Method, Option, named

from .contact import CONTACT_LAW, LEAST_REBOUND, MOST_REBOUND, OWN_TIME, STICTION, steps_of_impact
from .stops import at_least, least_step, most_inertia

__all__ = ["Drake"]

_OWN = "semi-implicit-euler"
_IMPACT = "impact_steps"
# Drake's default step [s].
_NATIVE_STEP = 1e-3
# Step [s] that keeps the pendulums' budgets by far, and fewest steps in a frame.
_CAREFUL_STEP, _CAREFUL_COUNT = 0.005, 4
# The same for Drake's own steps, whose order is 1.
_OWN_STEP, _OWN_COUNT = 2e-4, 100
# Longest duration of an impact [s].
_IMPACT_TIME = 5e-3
# Largest phase [rad] of a spring's oscillation, and decay of a damper's motion, in one step.
_SPRING_ANGLE, _DECAY = 0.15, 0.5
_ONLY_OWN = "Drake's integrators take no constraints; only its discrete plants do"
_NO_IMPACTS = "Drake's integrators use Hunt and Crossley's contact; its rebound depends on speed"
_TREES = {
    **dict.fromkeys(sorted(LOOPS, key=lambda each: each.name), _ONLY_OWN),
    Feature.DISTANCE_LINK: _ONLY_OWN,
    Feature.COUPLING: _ONLY_OWN,
    Feature.JOINT_LIMITS: _ONLY_OWN,
    Feature.DRIVE: "Drake's actuators have controllers only in discrete plants",
    Feature.CONTACT: _NO_IMPACTS,
}


class Drake(Adapter):
    """Drake through pydrake: its Runge–Kutta integrators, and plants that step themselves."""

    name = "drake"
    package = "drake"
    revision = 3
    methods: ClassVar = named(
        Method("runge_kutta5", "Runge-Kutta 5", 5, refuses=_TREES),
        Method(_OWN, "semi-implicit Euler", 1, velocity_lag=-0.5),
    )
    options: ClassVar = {
        _IMPACT: Option(
            71.0,
            "number n of steps that an impact on the ground lasts; it sets the restitution, "
            "exp(−π²/2n). 0: Drake's default stiffness, damper and solver, without restitution",
            least=0,
            most=10_000,
        ),
    }
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "Drake has no constraint that keeps a point on a line",
        Feature.JOINT_FRICTION: "Drake's joints have no dry friction",
        Feature.JOINT_REBOUND: "Drake's joint limits stop a joint; they cannot make it rebound",
        Feature.CLOSING_LOAD: "a joint that closes a loop has no coordinate in Drake",
        Feature.COLLISION: "Drake puts the contact springs of two bodies in series; the right "
        "rebound would need a separate stiffness for each pair of masses",
        Feature.LINKED_CONTACT: "Drake's contact stiffness is fixed beforehand, so the rebound "
        "would depend on the effective mass at the contact",
    }
    coordinates = "reduced"
    contact_law = CONTACT_LAW
    smallest = (
        "any mass that a scene file allows; a spring needs a rest length above 0, and the ground's "
        f"restitution must be 0, or {LEAST_REBOUND:g} to {MOST_REBOUND:g}; at steps of 1 ms joints "
        f"with limits move at most {most_inertia(1e-3):.3g} kg or kg·m², by the step's square less "
        "at finer ones: above, their stops would rebound"
    )

    def cannot_hold(self, scene: Scene) -> str:
        for spring in Mechanism.of(scene).springs:
            if spring.length <= 0.0:
                return f"the spring {spring.name!r} has no rest length; Drake needs more than 0 m"
        restitution = scene.ground.restitution if scene.ground else 0.0
        if restitution and not LEAST_REBOUND <= restitution <= MOST_REBOUND:
            bounds = f"Drake can do 0, or {LEAST_REBOUND:g} to {MOST_REBOUND:g}"
            return f"the ground's restitution is {restitution:g}; {bounds}"
        if (least := least_step(scene)) > scene.clock.frame:
            heaviest = f"a joint with limits moves {most_inertia(least):.3g} kg or kg·m²"
            most = f"{most_inertia(scene.clock.frame):.3g} at steps of a whole frame"
            return f"{heaviest}; Drake's stops hold {most}, and make more rebound"
        return ""

    def contact_scales(self, settings: Settings) -> ContactScales:
        count = float(self.option(settings, _IMPACT))
        return ContactScales(count * settings.step if count else OWN_TIME, STICTION)

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        frame, least = scene.clock.frame, least_step(scene)
        if profile == "native":
            options = {_IMPACT: 0.0} if scene.contacts else {}
            step = at_least(least, nearest_step(frame, _NATIVE_STEP), frame)
            return Settings(_OWN, step, options)
        springs = spring_step(scene, angle=_SPRING_ANGLE, decay=_DECAY)
        method = next((m for m in self.methods if not self.refusals(scene, m)), _OWN)
        if method != _OWN:
            return Settings(
                method, careful_step(frame, min(_CAREFUL_STEP, springs), _CAREFUL_COUNT)
            )
        if scene.ground is None:
            step = careful_step(frame, min(_OWN_STEP, springs), _OWN_COUNT)
            return Settings(_OWN, at_least(least, step, frame))
        count = steps_of_impact(scene.ground.restitution)
        step = careful_step(frame, min(_IMPACT_TIME / count, springs), _OWN_COUNT)
        return Settings(_OWN, step, {_IMPACT: count})

    def load(self, scene: Scene, settings: Settings) -> Run:
        from .run import DrakeRun

        step, least = scene.clock.frame / settings.substeps(scene.clock.frame), least_step(scene)
        if step < least * (1.0 - 1e-9):
            raise Unsupported(
                f"drake: step: got {step:.3g} s, allowed is from {least:.3g} s, as joints with "
                f"limits move up to {most_inertia(least):.3g} kg or kg·m² in {scene.name}: Drake's "
                "stops make them rebound at finer steps; take longer steps"
            )
        scheme = "" if settings.method == _OWN else settings.method
        return DrakeRun(scene, settings, scheme, float(self.option(settings, _IMPACT)))

"""PyBullet: Featherstone multibodies stepped by semi-implicit Euler, loops by impulses."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from mbds_xsim.scene.mechanism import Link, Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.stiffness import spring_step
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import LOOPS, Feature, Method, Option, Sweep, named

from .carriers import MOST_SPHERES, sinking
from .contact import CONTACT_LAW
from .run import PyBulletRun

__all__ = ["PyBullet"]

_USUAL_STEP = 1 / 240
# Step that keeps the pendulums' budgets [s], and fewest steps in a frame for faster scenes.
_CAREFUL_STEP, _CAREFUL_COUNT = 2e-5, 100
# Largest phase [rad] of a spring's oscillation, and decay of a damper's motion, in one step.
_SPRING_ANGLE, _DECAY = 0.5, 0.5
# With ten sweeps, a body on four corners keeps 1e-6 m/s, and one that comes down flat is turned.
# If a step ends within reach of the ground, the next one closes the gap: that speed is lost.
_CAREFUL_CONTACT = {"solver_iterations": 50, "contact_reach": 1e-8}
# With ten, a cheetah's rotors are 5e-7 m off their joints after ten frames; with 100, rounding.
_GEARED_SWEEPS = 200
# A joint past its stop gets that distance back as speed: an erp of 0.8 rebounds by up to 0.8.
_LIMIT_ERP = 1e-5
# Bullet's SIMD_EPSILON: a joint with less to move stands still (kg, or kg·m² about a hinge).
_LEAST = float(np.finfo(float).eps)
# Defaults of PhysicsServerCommandProcessor::createEmptyDynamicsWorld and btCollisionObject.
_USUAL_CONTACT = {
    "bounce_threshold": 0.2,
    "contact_reach": 1e18,
    "contact_slop": 1e-5,
    "friction_axes": False,
}
_USUAL_CONTACT_ERP = 0.08
# The engine accepts more without a warning, but more has no meaning.
_MOST_SWEEPS = 1_000_000


class PyBullet(Adapter):
    """Bullet's multibody dynamics through the package `pybullet`."""

    name = "pybullet"
    package = "pybullet"
    revision = 3
    methods: ClassVar = named(
        Method("semi-implicit-euler", "semi-implicit Euler", 1, velocity_lag=-0.5)
    )
    options: ClassVar = {
        "solver_iterations": Option(
            10, "sweeps over loops, rotors and contacts in each step", 1, _MOST_SWEEPS
        ),
        "residual_threshold": Option(0.0, "sweeps stop early below this residual; 0: never", 0),
        "erp": Option(
            0.8, "part of a loop's gap that a step closes (error reduction parameter)", 0, 1
        ),
        "linear_damping": Option(
            0.0, "drag on every link [1/s]; a user of the engine gets 0.04", 0
        ),
        "angular_damping": Option(0.0, "the same for its rotation [1/s]", 0),
        "contact_recovery": Option(1.0, "time to push out an overlap with the ground [s]", 0),
        "bounce_threshold": Option(
            0.0, "slowest approach that rebounds [m/s]; 0: the speed of a fall for 4 steps", 0
        ),
        "contact_reach": Option(1e-6, "gap from which on a contact acts [m]", 0),
        "contact_slop": Option(0.0, "overlap with the ground that counts as none [m]", 0),
        "friction_axes": Option(
            True,
            "turn the axes of friction once a frame so that friction opposes the slip; if off, it "
            "leans towards the axis, x or y, along which the body is harder to move",
        ),
    }
    sweeps: ClassVar = {
        "solver_iterations": Sweep(
            (3, 10, 50, 200), needs=LOOPS | {Feature.ARMATURE, Feature.CONTACT}
        ),
        "erp": Sweep((0.2, 1.0), needs=LOOPS),
        "contact_recovery": Sweep((0.1, 10.0), needs=frozenset({Feature.CONTACT})),
    }
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "PyBullet's JOINT_PRISMATIC constraint is unreliable between "
        "multibodies",
        Feature.DISTANCE_LINK: "PyBullet has no constraint that keeps a distance",
        Feature.JOINT_REBOUND: "PyBullet's joint limits stop a joint; they cannot make it rebound",
        Feature.CLOSING_LOAD: "PyBullet's damping acts on coordinates, and a joint that closes a "
        "loop has none",
    }
    coordinates = "reduced"
    contact_law = CONTACT_LAW
    smallest = (
        f"masses of {_LEAST:.3g} kg of free bodies and on sliders, moments about a hinge of "
        f"{_LEAST:.3g} kg·m²: below, a body stands still without a warning; a body "
        f"that a joint ties to the world has at most {MOST_SPHERES} contact spheres"
    )

    def cannot_hold(self, scene: Scene) -> str:
        mechanism = Mechanism.of(scene)
        if reason := sinking(mechanism):
            return reason
        for link in mechanism.links:
            inertia = _moved_inertia(mechanism, link)
            if inertia < _LEAST:
                least = f"PyBullet moves {_LEAST:.3g} or more"
                return f"{scene.bodies[link.body].name!r} has {inertia:.3g} kg or kg·m², {least}"
        return ""

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
        options: dict[str, float] = dict(_CAREFUL_CONTACT if scene.contacts else {})
        mechanism = Mechanism.of(scene)
        if mechanism.limited:
            options["erp"] = _LIMIT_ERP
        if mechanism.rotors:
            options["solver_iterations"] = _GEARED_SWEEPS
        return Settings(method, step, options)

    def load(self, scene: Scene, settings: Settings) -> Run:
        return PyBulletRun(
            scene, settings, {name: self.option(settings, name) for name in self.options}
        )


def _moved_inertia(mechanism: Mechanism, link: Link) -> float:
    """Return a body's inertia against the motion of its joint: mass [kg] or moment [kg·m²]."""
    mass, joint = float(mechanism.mass[link.body]), link.joint
    if joint is None or joint.kind == "slider":
        return mass
    if joint.kind != "hinge":
        return np.inf
    arm = np.cross(joint.axis, joint.in_child)
    return float(joint.axis @ mechanism.inertia[link.body] @ joint.axis + mass * arm @ arm)

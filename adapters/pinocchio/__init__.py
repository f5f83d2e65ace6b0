"""Pinocchio (https://github.com/stack-of-tasks/pinocchio): exact dynamics in joint coordinates."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.stiffness import spring_step
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import CONTACTS, LOOPS, Feature, Method, Option, Sweep, named

__all__ = ["Pinocchio"]

_METHOD = "forward-dynamics-RK4"
_DRIFT, _SOFTNESS = "drift_time", "softness"
_NATIVE_STEP = 1e-3
# Step that keeps the pendulums' and ladders' budgets [s], and fewest steps in a frame.
_CAREFUL_STEP, _CAREFUL_COUNT = 0.005, 4
# Largest phase [rad] of a spring's oscillation, and decay of a damper's motion, in one step.
_SPRING_ANGLE, _DECAY = 0.15, 0.5
# Smallest mass by which Pinocchio divides when it puts a body on a joint [kg].
_LEAST = 2.23e-16
_NO_CONTACT = "Pinocchio computes accelerations; it has no impacts"


class Pinocchio(Adapter):
    """Pinocchio: articulated bodies; proximal steps solve acceleration constraints of loops."""

    name = "pinocchio"
    package = "pin"
    revision = 2
    methods: ClassVar = named(Method(_METHOD, "toolkit RK4", 4, own=False))
    options: ClassVar = {
        _DRIFT: Option(
            5.0,
            "number of frames in which an open loop is closed (Baumgarte stabilisation); 0 leaves "
            "it open",
            least=0,
        ),
        _SOFTNESS: Option(
            0.01,
            "of the proximal iterations that solve the constraints (mu), relative to the mean of "
            "1/mass over the bodies; lower values amplify rounding errors of redundant constraints",
            above=0,
            most=1,
        ),
    }
    sweeps: ClassVar = {_DRIFT: Sweep((0.0, 1.0, 5.0), needs=LOOPS)}
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "Pinocchio has no constraint that keeps a point on a line",
        Feature.DISTANCE_LINK: "Pinocchio has no constraint that keeps a distance",
        Feature.COUPLING: "its articulated-body algorithm does not support its mimic joints",
        Feature.JOINT_FRICTION: "Pinocchio computes accelerations; it has no dry friction",
        Feature.JOINT_LIMITS: "Pinocchio computes accelerations; it has no stops",
        Feature.CLOSING_LOAD: "a joint that closes a loop has no coordinate in Pinocchio",
        **dict.fromkeys(CONTACTS, _NO_CONTACT),
    }
    coordinates = "reduced"
    smallest = (
        f"masses of {_LEAST:g} kg: below, Pinocchio moves the centre of mass without a warning"
    )

    def cannot_hold(self, scene: Scene) -> str:
        mass = Mechanism.of(scene).mass
        small = int(np.argmin(mass))
        if mass[small] >= _LEAST:
            return ""
        return f"{scene.bodies[small].name!r} has {mass[small]:.3g} kg; Pinocchio needs {_LEAST:g}"

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        frame = scene.clock.frame
        if profile == "native":
            return Settings(_METHOD, nearest_step(frame, _NATIVE_STEP), {_DRIFT: 0.0})
        longest = min(_CAREFUL_STEP, spring_step(scene, angle=_SPRING_ANGLE, decay=_DECAY))
        return Settings(_METHOD, careful_step(frame, longest, _CAREFUL_COUNT))

    def load(self, scene: Scene, settings: Settings) -> Run:
        from .run import PinocchioRun

        drift_time = scene.clock.frame * self.option(settings, _DRIFT)
        return PinocchioRun(scene, settings, drift_time, self.option(settings, _SOFTNESS))

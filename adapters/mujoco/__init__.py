"""MuJoCo (https://mujoco.org): reduced coordinates, soft equality constraints for loops."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import numpy as np

from mbds_xsim.base.errors import InputError
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.spin import idle_axes
from mbds_xsim.scene.stiffness import spring_step
from mbds_xsim.simulate.adapter import Adapter, Profile, Run, Settings, careful_step, nearest_step
from mbds_xsim.simulate.claims import LOOPS, ContactScales, Feature, Method, Option, Sweep, named

from .contact import CONTACT_LAW, HARDEST, Impact
from .model import StepOptions
from .run import ModelRun
from .spinless import SpinlessRun
from .state import slim_axes

__all__ = ["MuJoCo"]

_NATIVE_OPTIONS = {
    "loop_time_constant": 0.0,
    "link_time_constant": 0.0,
    "contact_substeps": 0,
    "hard_limits": False,
}
_SOLVERS = ("Newton", "CG", "PGS")
# MuJoCo's default step [s].
_DEFAULT_STEP = 0.002
# Step that keeps RK4 within the budgets of chains of links of 0.1 m and more [s].
_CAREFUL_STEP = 0.005
_CAREFUL_LINK_STEP = 0.001
_CAREFUL_COUNT = 4
# Time constant of MuJoCo's own contact, `solref` [s].
_DEFAULT_IMPACT = 0.02
# With fewer steps an impact's restitution depends on where in a step it begins.
# With many more, the calibration of the damper ends before the sphere has left the ground.
_SHORTEST_IMPACT, _LONGEST_IMPACT = 4, 500
# Least and most: time constants in steps, of which even the least are unstable; angles [rad].
_SOFT, _TURNS = (1e-3, 1e6), (1e-6, 1e3)
# Smallest body that MuJoCo's compiler accepts: mjMINVAL [kg] and mjEPS [kg·m²].
_LEAST_MASS, _LEAST_MOMENT = 1e-15, 1e-14
# Hardness of contacts on wheels, several of which share a load. With spheres off centres of mass,
# contacts must be hard: MuJoCo's estimate of yielding is too rough for the calibrated damper.
_WHEEL_HARDNESS = 0.5
_OFFSET = 1e-9  # largest offset of a sphere that counts as centred [m]
# Phase of a spring's oscillation in one step: forty steps a period [rad].
_SPRING_ANGLE = 0.15
# Decay of a damper's motion in one step; RK4 is unstable from 2.8, Euler from 2, and of order 1.
_DECAY, _EULER_DECAY = 0.5, 0.1
# Step where joints have limits or dry friction: each stop is off by the distance of a step [s].
_CAREFUL_LIMIT_STEP, _CAREFUL_REBOUND_STEP = 1e-4, 5e-5
_NO_REBOUND = "it evaluates a stop four times a step, for which no damper gives the right rebound"


class MuJoCo(Adapter):
    """MuJoCo: exact tree joints; loops and distance links as soft constraints tied to the step."""

    name = "mujoco"
    package = "mujoco"
    revision = 5
    methods: ClassVar = named(
        # A loop is as stiff as the step h allows. The stages of a step see it open by h² and push
        # with accelerations that do not vanish with h, so velocities are off in proportion to h.
        Method(
            "RK4",
            "RK4",
            4,
            {Feature.JOINT_REBOUND: _NO_REBOUND},
            loop_order=2,
            loop_velocity_order=1,
        ),
        Method("Euler", "semi-implicit Euler", 1, velocity_lag=-0.5),
        # Implicit in the forces of dampers. Without dampers it equals Euler to the last bit on
        # jointed bodies, but not on free ones that spin.
        Method("implicitfast", "semi-implicit Euler", 1, velocity_lag=-0.5),
    )
    options: ClassVar = {
        # If it is shorter, RK4's stages, which leave the constraint by O(h²), cause an error of
        # the velocities; if longer, gaps widen. Euler is unstable below 1.3.
        "loop_time_constant": Option(
            3.0,
            "of loop constraints, in steps; 0 keeps MuJoCo's default solref and solimp",
            *_SOFT,
            or_zero=True,
        ),
        # MuJoCo leaves J̇·v out of a tendon's row, so a gap of |J̇·v|·τ² stays.
        "link_time_constant": Option(
            1.5,
            "of distance links, in steps; 0 keeps MuJoCo's default solref and solimp",
            *_SOFT,
            or_zero=True,
        ),
        "contact_substeps": Option(
            50,
            "number of semi-implicit Euler substeps to a step near the ground; 0 keeps "
            "MuJoCo's default contact",
            least=0,
        ),
        "impact_steps": Option(
            12,
            "number of these substeps that an impact lasts: 4 or more; or 1, which is right only "
            "if every contact sphere is centred on a free body's centre of mass",
            least=1,
            most=_LONGEST_IMPACT,
        ),
        "contact_hardness": Option(
            HARDEST,
            "share of an acceleration into the ground that a contact resists at any depth; "
            "slightly below 1, a body on several spheres rattles; at lower values it sinks more",
            above=0,
            most=HARDEST,
        ),
        "hard_limits": Option(
            True,
            "joint limits stop a joint, or let it rebound by its restitution, within a step; if "
            "off, MuJoCo's default solref and solimp decide the rebound",
        ),
        "solver": Option("Newton", "constraint solver: Newton, CG or PGS", names=_SOLVERS),
        "spin": Option(
            True,
            "model the spin of rods that nothing in the scene turns about their own axes; if off, "
            "such a rod keeps two coordinates, and a trajectory that starts with spin or bends a "
            "rod by more than a radian is simulated with it all the same",
        ),
        "turn": Option(
            0.125,
            "angle [rad] that a joint may turn in a frame before the frame gets more steps; 0 "
            "makes all steps equal; for RK4 without contact",
            *_TURNS,
            or_zero=True,
        ),
    }
    sweeps: ClassVar = {
        "loop_time_constant": Sweep((0.0, 1.5, 6.0), needs=LOOPS),
        "link_time_constant": Sweep((0.0, 3.0), needs=frozenset({Feature.DISTANCE_LINK})),
        "contact_substeps": Sweep((10, 50, 200), needs=frozenset({Feature.CONTACT})),
        "impact_steps": Sweep((4, 12, 36), needs=frozenset({Feature.CONTACT})),
        "contact_hardness": Sweep((0.5, 0.9), needs=frozenset({Feature.CONTACT})),
        "hard_limits": Sweep((True, False), needs=frozenset({Feature.JOINT_LIMITS})),
        "solver": Sweep(_SOLVERS, needs=LOOPS | {Feature.DISTANCE_LINK}),
        "spin": Sweep((True, False), needs=frozenset({Feature.BALL})),
        "turn": Sweep((0.0, 0.25, 0.0625), methods=("RK4",)),
    }
    limits: ClassVar = {
        Feature.LOOP_SLIDER: "MuJoCo has no equality constraint that leaves a sliding direction "
        "free; close the loop at another joint",
        Feature.CLOSING_LOAD: "MuJoCo's joint springs and dampers act on coordinates, and a "
        "joint that closes a loop has none",
    }
    coordinates = "reduced"
    contact_law = CONTACT_LAW
    smallest = f"masses of {_LEAST_MASS:g} kg and principal moments of {_LEAST_MOMENT:g} kg·m²"

    def cannot_hold(self, scene: Scene) -> str:
        mechanism = Mechanism.of(scene)
        moment = np.linalg.eigvalsh(mechanism.inertia)[:, 0]
        small = np.flatnonzero((mechanism.mass < _LEAST_MASS) | (moment < _LEAST_MOMENT))
        if not len(small):
            return ""
        body = int(small[0])
        return (
            f"{scene.bodies[body].name!r} has {mechanism.mass[body]:.3g} kg and "
            f"{moment[body]:.3g} kg·m², MuJoCo's compiler takes {self.smallest}, or more"
        )

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        frame = scene.clock.frame
        if profile == "native":
            return Settings("Euler", nearest_step(frame, _DEFAULT_STEP), _NATIVE_OPTIONS)
        longest = _CAREFUL_STEP if not scene.distance_links else _CAREFUL_LINK_STEP
        longest = min(longest, spring_step(scene, angle=_SPRING_ANGLE, decay=_DECAY))
        mechanism = Mechanism.of(scene)
        options: dict[str, float | bool] = {}
        if any(joint.restitution for joint in mechanism.limited):
            sprung = spring_step(scene, angle=_SPRING_ANGLE, decay=_EULER_DECAY)
            longest = min(sprung, _CAREFUL_REBOUND_STEP)
            return Settings("Euler", careful_step(frame, longest, _CAREFUL_COUNT))
        if mechanism.braked:
            longest = min(longest, _CAREFUL_LIMIT_STEP)
        if mechanism.has_only_balls:
            options["impact_steps"] = 1
        elif scene.contacts and abs(mechanism.sphere_offset).max() < _OFFSET:
            options["contact_hardness"] = _WHEEL_HARDNESS
        # Leaving out the spin of rods costs accuracy where they bend far, which closed loops
        # prevent, and saves time where there are many of them, as in closed loops.
        if mechanism.loops and idle_axes(scene).any():
            options["spin"] = False
        return Settings("RK4", careful_step(frame, longest, _CAREFUL_COUNT), options)

    def contact_scales(self, settings: Settings) -> ContactScales:
        division = self.option(settings, "contact_substeps")
        if not division:
            return ContactScales(_DEFAULT_IMPACT)
        return ContactScales(self.option(settings, "impact_steps") * settings.step / division)

    def load(self, scene: Scene, settings: Settings) -> Run:
        option = partial(self.option, settings)
        solver, impact_steps = option("solver"), option("impact_steps")
        if 1 < impact_steps < _SHORTEST_IMPACT:
            msg = f"impact_steps: got {impact_steps}, allowed is 1, or {_SHORTEST_IMPACT} and more"
            raise InputError(msg)
        division = option("contact_substeps") if scene.contacts else 0
        if division and solver == "PGS":
            raise InputError("solver: PGS does not converge on contacts, allowed is Newton or CG")
        substeps = settings.substeps(scene.clock.frame)
        step = scene.clock.frame / substeps
        finer = step / division if division else 0.0
        stepping = StepOptions(
            "Euler" if division else settings.method,
            finer or step,
            solver,
            step * option("loop_time_constant"),
            step * option("link_time_constant"),
            Impact(finer, impact_steps, option("contact_hardness")),
            option("hard_limits"),
        )
        turn = 0.0 if scene.contacts or settings.method != "RK4" else option("turn")
        mechanism = Mechanism.of(scene)
        run = partial(ModelRun, mechanism, stepping, settings.method, substeps, division, turn)
        idle = slim_axes(mechanism)
        if option("spin") or not idle.any():
            return run()
        return SpinlessRun(mechanism, idle, run)

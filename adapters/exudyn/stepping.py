"""Exudyn's simulation settings for a frame, as program text that creates them."""

from __future__ import annotations

from dataclasses import dataclass

from mbds_xsim.scene.constraints import degrees_of_freedom, layout_of
from mbds_xsim.scene.mechanism import Mechanism

SOLVERS = {
    "trapezoidal": "TrapezoidalIndex2",
    "generalised-alpha": "GeneralizedAlpha",
    "RK44": "RK44",
    "RK67": "RK67",
    "tree-RK44": "RK44",
}
LINEAR_SOLVERS = ("auto", "EXUdense", "EigenDense", "EigenSparse")

# Tolerances of Newton's method: Exudyn's default, and one for the finer steps near the ground, with
# which the default would leave a larger error in a flight than the steps do.
_USUAL, _TIGHT = 1e-8, 1e-10
# Share to which a step may be shortened to end where a sphere touches down or leaves. Some steps
# later it is back at its full length. By default it would stay short after a step that took
# Newton's method many iterations, as very short steps do because of rounding.
_SHORTEST_SHARE = 1e-5
# Speed [m/s] whose path in a shortest step sets the tolerance of the contact force at a touch. The
# solver gives up if even a shortest step misses that tolerance.
_FASTEST_IMPACT = 100.0
# Tolerance for forces of stops that begin or end within a step. By default it is 1 N or N·m, and a
# stop may pull on the joint that leaves it.
_KINK = 0.0
# Rounding error of positions some metres off. A damper turns it into a force within a step, and
# Newton's method cannot get below that force: it would try for ever where all is at rest.
_ROUNDING = 1e-15
_NEAR_GROUND = f"""\
near_ground = steps_of_a_frame({{count}})
stepping = near_ground.timeIntegration
stepping.adaptiveStep = True
stiffness = max(mbs.GetObject(number)["contactStiffness"] for number in contacts)
stepping.discontinuous.iterationTolerance = {_FASTEST_IMPACT} * stiffness * stepping.minimumStepSize
damping = max(mbs.GetObject(number)["contactDamping"] for number in contacts)
noise = {_ROUNDING} * damping * stepping.numberOfSteps / stepping.endTime
stepping.newton.absoluteTolerance = max(stepping.newton.absoluteTolerance, noise)
"""
_NEXT_FRAME = """
def next_frame():  # in finer steps if a sphere may touch the ground
    data, kinds = mbs.systemData, exu.ConfigurationType
    before = data.GetSystemState(kinds.Initial)
    if not may_touch(settings.timeIntegration.endTime):
        try:
            step_frame()
            if gaps().min() > 0.0:
                return
        except Exception:  # the solver gives up on contact in steps this long
            pass
        # Driven down harder than foreseen.
        data.SetSystemState(before, kinds.Initial)
        data.SetSystemState(before, kinds.Current)
    step_frame(near_ground)"""
# From this many bodies on the sparse factorisation is faster.
_SPARSE_FROM = 8


@dataclass(frozen=True)
class Stepping:
    """All settings of the solver."""

    method: str
    substeps: int
    linear_solver: str
    spectral_radius: float
    modified_newton: bool
    division: int = 0
    """Number of finer steps in a step near the ground; 0 if the scene has no contact."""

    def listing(self, mechanism: Mechanism) -> str:
        """Return the program that defines `settings`, and `next_frame` to call once per frame.

        Where joints have friction or limits, Newton's method may go back and forth between the
        kinks of their laws; a step on which it does not converge is divided into shorter ones.
        """
        redundant, finer = has_redundant_constraints(mechanism), self.substeps * self.division
        return f"""


def steps_of_a_frame(count):
    settings = exu.SimulationSettings()
    settings.solution.file.write = False
    settings.solution.sensors.active = False
    stepping = settings.timeIntegration
    stepping.endTime = {mechanism.scene.clock.frame!r}
    stepping.numberOfSteps = count
    stepping.adaptiveStep = {mechanism.braked}
    stepping.adaptiveStepRecoverySteps = 1
    stepping.adaptiveStepRecoveryIterations = 1000
    stepping.minimumStepSize = {_SHORTEST_SHARE} * stepping.endTime / count
    stepping.stepInformation = 0
    stepping.automaticStepSize = False
    stepping.discontinuous.iterationTolerance = {_KINK!r}
    stepping.newton.useModifiedNewton = {self.modified_newton}
    stepping.newton.relativeTolerance = {_TIGHT if self.division else _USUAL}
    stepping.generalizedAlpha.spectralRadius = {self.spectral_radius!r}
    settings.linearSolver.solverType = \
        exu.LinearSolverType.{self._linear_solver(mechanism, redundant)}
    settings.linearSolver.ignoreSingularJacobian = {redundant}
    return settings


settings = steps_of_a_frame({self.substeps})
{_NEAR_GROUND.format(count=finer) if self.division else ""}

def step_frame(settings=settings):
    mbs.SolveDynamic(
        settings, solverType=exu.DynamicSolverType.{SOLVERS[self.method]}, updateInitialValues=True
    )

{_NEXT_FRAME if self.division else "next_frame = step_frame"}
"""

    def _linear_solver(self, mechanism: Mechanism, redundant: bool) -> str:
        if redundant:
            return "EigenDense"
        if self.linear_solver != "auto":
            return self.linear_solver
        return "EigenSparse" if mechanism.body_count >= _SPARSE_FROM else "EigenDense"


def has_redundant_constraints(mechanism: Mechanism) -> bool:
    """Return whether constraint rows are linearly dependent at the reference pose.

    Exudyn's solvers then need its dense solver that ignores a singular Jacobian.
    """
    if not (mechanism.loops or mechanism.distances):
        return False
    rows = layout_of(mechanism).row_count
    return 6 * mechanism.body_count - rows != degrees_of_freedom(mechanism)

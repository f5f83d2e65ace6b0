"""How a frame is stepped: Exudyn's simulation settings, as text that is run to make them."""

from __future__ import annotations

from dataclasses import dataclass

from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Mechanism

SOLVERS = {
    "trapezoidal": "TrapezoidalIndex2",
    "generalised-alpha": "GeneralizedAlpha",
    "RK44": "RK44",
    "RK67": "RK67",
    "tree-RK44": "RK44",
}
LINEAR_SOLVERS = ("auto", "EXUdense", "EigenDense", "EigenSparse")

_ROWS = {"fixed": 6, "hinge": 5, "slider": 5, "ball": 3}
# Exudyn's default of Newton's method; with the finer steps near the ground it would leave more of
# an error in a flight than the steps do.
_USUAL, _TIGHT = 1e-8, 1e-10
# A step may be shortened, down to a share, to end where a sphere touches down or leaves, and is
# back at its full length some steps later. By default it would stay short after a step that took
# Newton's method many iterations, as very short ones do for their rounding.
_SHORTEST_SHARE = 1e-5
# A touch is met well enough where the error of the contact force is that of a shortest step's way
# at this speed; if even a shortest step misses it, the solver gives up [m/s].
_FASTEST_IMPACT = 100.0
# Forces of stops that begin or cease in a step; by default 1 N or N·m are let pass, and a joint may
# be pulled by the stop that it leaves.
_KINK = 0.0
# Of places some metres off, and so of what a damper makes of them in a step: Newton's method
# cannot get below it, and tries for ever where all is at rest.
_ROUNDING = 1e-15
_NEAR_GROUND = """\
near_ground = steps_of_a_frame({count})
stepping = near_ground.timeIntegration
stepping.adaptiveStep = True
stiffness = max(mbs.GetObject(number)["contactStiffness"] for number in contacts)
stepping.discontinuous.iterationTolerance = {fastest} * stiffness * stepping.minimumStepSize
damping = max(mbs.GetObject(number)["contactDamping"] for number in contacts)
noise = {rounding} * damping * stepping.numberOfSteps / stepping.endTime
stepping.newton.absoluteTolerance = max(stepping.newton.absoluteTolerance, noise)
"""
_NEXT_FRAME = """
def next_frame():  # in finer steps if a sphere may touch the ground
    data, kinds = mbs.systemData, exu.ConfigurationType
    before = data.GetSystemState(kinds.Initial)
    if not may_touch(settings.timeIntegration.endTime):
        step_frame()
        if gaps().min() > 0.0:
            return
        # Driven down harder than foreseen.
        data.SetSystemState(before, kinds.Initial)
        data.SetSystemState(before, kinds.Current)
    step_frame(near_ground)"""
# From this many bodies on the sparse factorisation is faster.
_SPARSE_FROM = 8


@dataclass(frozen=True)
class Stepping:
    """Everything the solver is told."""

    method: str
    frame: float
    substeps: int
    linear_solver: str
    spectral_radius: float
    modified_newton: bool
    division: int = 0
    """Finer steps of a step near the ground; 0 where the scene has no contact."""
    braked: bool = False
    """Whether joints have friction or limits, whose laws have kinks that Newton's method may go
    back and forth between: a step in which it does not end is taken in shorter ones."""

    def listing(self, mechanism: Mechanism) -> str:
        """Write the program that makes `settings`, and `next_frame` to call once a frame."""
        redundant = has_redundant_constraints(mechanism)
        return f"""


def steps_of_a_frame(count):
    settings = exu.SimulationSettings()
    settings.solution.file.write = False
    settings.solution.sensors.active = False
    stepping = settings.timeIntegration
    stepping.endTime = {self.frame!r}
    stepping.numberOfSteps = count
    stepping.adaptiveStep = {self.braked}
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
{self._near_ground()}

def step_frame(settings=settings):
    mbs.SolveDynamic(
        settings, solverType=exu.DynamicSolverType.{SOLVERS[self.method]}, updateInitialValues=True
    )

{_NEXT_FRAME if self.division else "next_frame = step_frame"}
"""

    def _near_ground(self) -> str:
        """Write `near_ground`, the settings of a frame in which a sphere may touch."""
        return (
            _NEAR_GROUND.format(
                count=self.substeps * self.division,
                fastest=_FASTEST_IMPACT,
                rounding=_ROUNDING,
            )
            if self.division
            else ""
        )

    def _linear_solver(self, mechanism: Mechanism, redundant: bool) -> str:
        if redundant:
            return "EigenDense"
        if self.linear_solver != "auto":
            return self.linear_solver
        return "EigenSparse" if mechanism.body_count >= _SPARSE_FROM else "EigenDense"


def has_redundant_constraints(mechanism: Mechanism) -> bool:
    """Tell whether constraint rows hang on each other at the reference pose.

    Exudyn's solvers then need its dense solver that ignores a singular Jacobian.
    """
    if not (mechanism.loops or mechanism.distances):
        return False
    rows = sum(_ROWS[joint.kind] for joint in mechanism.joints) + len(mechanism.distances)
    return 6 * mechanism.body_count - rows != degrees_of_freedom(mechanism)

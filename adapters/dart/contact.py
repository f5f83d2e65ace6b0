"""Spheres on the ground plane: the calls that build them, and what DART does silently to them.

DART takes the smaller friction of a pair and the product of its restitutions, so the ground gets
the pair's friction and a restitution of 1. Measured on 6.20:

- Its own solver (Dantzig) bounds friction by a box along x and y, which at 45° holds √2 times too
  much; `NsgsFrictionSolver` has the round cone.
- All its detectors give the overlap of sphere and plane to rounding, at any distance from the
  origin, and miss none, but they differ in where the point of contact lies: at the sphere's lowest
  point (ode, bullet), on the plane (dart) or half-way (fcl).
- A rebound below 0.1 m/s does not happen and one above 100 m/s is cut; both limits are compiled in.
- What is reflected has gravity's share of the step h in it, so that an impact at v delivers about
  e + 2 g h / v. With e = 0.93 and steps of 1 ms the last bounces, 1 mm high, never die out; with
  0.5 ms they do.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import dartpy
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate.adapter import first_failures
from mbds_xsim.simulate.claims import ContactLaw

CONTACT_LAW = ContactLaw(
    normal="rigid: impulses of one step, velocities at contacts solved together",
    restitution="a coefficient of each body, from 0.1 to 100 m/s of rebound",
    friction="a box along x and y (Dantzig), or a round cone (NSGS)",
    mixing="the smaller friction, the product of restitutions",
    adapter="The spheres carry the pair's coefficients and the ground restitution 1, so that both "
    "rules give back the pair's. At matched, contacts are found by `ode` and solved by NSGS, whose "
    "cone is round, and what its solver leaves open or gives up on is a failure. What is reflected "
    "has gravity's share of a step in it, so that the matched steps are short; rebounds above "
    "100 m/s, which DART cuts, are a failure.",
)
"""What contact is in the engine."""

DETECTORS = ("fcl", "ode", "bullet", "dart")
SOLVERS = ("dantzig", "nsgs")
# Coefficients that DART takes for none.
_NONE = 1e-3
_FASTEST_REBOUND = 100.0
# Of it, as what falls gains speed between frame and impact.
_NEARLY = 0.99
_SOLVER = """\
options = dart.constraint.NsgsFrictionSolver.Options()
options.tolerance = {tolerance!r}
options.maxSweeps = {sweeps}
world.getConstraintSolver().setBoxedLcpSolver(dart.constraint.NsgsFrictionSolver(options))"""
# Of the velocity that gravity adds in a step, allowed as violation of the contact law. DART's own
# tolerance of 1e-5 m/s leaves to chance how four wheels share a car's weight: its regularisation,
# which makes them share evenly, is as weak as that.
_TOLERANCE = 5e-6
# Of the solver over the contacts of a step. DART's 100 leave four wheels 3 mm/s open now and then;
# hardly any step takes more.
_SWEEPS = 1000
_EARTH = 9.81
# Violation of the contact law that counts as a failure [m/s].
_WRONG = 1e-3


def _detection(detector: str) -> str:
    """Write the call that has contacts found by one of DART's detectors."""
    if hasattr(dartpy.simulation.World, "setCollisionDetector"):
        kind = f"dart.simulation.CollisionDetectorType.{detector.upper()}"
        return f"world.setCollisionDetector({kind})"
    kind = f"dart.collision.{detector.upper()}CollisionDetector()"  # before 6.20
    return f"world.getConstraintSolver().setCollisionDetector({kind})"


def contact_statements(
    mechanism: Mechanism, step: float, detector: str, solver: str
) -> Iterator[str]:
    """Write the calls that put spheres on `bodies` and a ground into `world`; none without.

    Raises:
        Unsupported: DART takes a coefficient that is not 0 for 0.
    """
    ground = mechanism.scene.ground
    if ground is None:
        return
    for what, value in (("friction", ground.friction), ("restitution", ground.restitution)):
        if 0.0 < value <= _NONE:
            msg = f"ground.{what}: got {value}, DART takes {_NONE} and less for 0"
            raise Unsupported(msg)
    yield _detection(detector)
    if solver == "nsgs":
        pull = float(np.linalg.norm(mechanism.scene.gravity)) or _EARTH
        yield _SOLVER.format(tolerance=_TOLERANCE * pull * step, sweeps=_SWEEPS)
    yield "ground = dart.dynamics.Skeleton()"
    yield "_, plane = ground.createWeldJointAndBodyNodePair()"
    yield "shapes = [plane.createShapeNode(dart.dynamics.PlaneShape([0.0, 0.0, 1.0], 0.0))]"
    for body, centre, radius in zip(
        mechanism.sphere_body.tolist(),
        mechanism.sphere_offset.tolist(),
        mechanism.sphere_radius.tolist(),
        strict=True,
    ):
        x, y, z = centre
        yield f"shapes += [bodies[{body}].createShapeNode(dart.dynamics.SphereShape({radius!r}))]"
        yield f"shapes[-1].setRelativeTransform(at({x!r}, {y!r}, {z!r}))"
    yield "for shape in shapes:"
    yield "    shape.createCollisionAspect()"
    yield "    shape.createDynamicsAspect()"
    yield f"    shape.getDynamicsAspect().setFrictionCoeff({ground.friction!r})"
    yield f"    shape.getDynamicsAspect().setRestitutionCoeff({ground.restitution!r})"
    yield "shapes[0].getDynamicsAspect().setRestitutionCoeff(1.0)"
    yield "world.addSkeleton(ground)"


def pairs(shapes: list[Any]) -> Array | None:
    """Radius, friction and restitution of each sphere on the ground by DART's rules, (sphere, 3).

    The ground is the first of the shapes.
    """
    if not shapes:
        return None
    plane, *spheres = [shape.getDynamicsAspect() for shape in shapes]
    return np.array(
        [
            (
                shape.getShape().getRadius(),
                min(plane.getFrictionCoeff(), sphere.getFrictionCoeff()),
                plane.getRestitutionCoeff() * sphere.getRestitutionCoeff(),
            )
            for shape, sphere in zip(shapes[1:], spheres, strict=True)
        ]
    )


def centers(shapes: list[Any]) -> Array | None:
    """Centres of the spheres in W as the model stands [m], shape (sphere, 3)."""
    if not shapes:
        return None
    return np.array([shape.getWorldTransform().translation() for shape in shapes[1:]])


class ContactSolver:
    """Tells whether the solver did solve; where it did not, DART goes on without a word."""

    def __init__(self, world: Any) -> None:
        solver = world.getConstraintSolver().getBoxedLcpSolver()
        # Dantzig keeps no record.
        self._solver = solver if hasattr(solver, "getStats") else None

    def restart(self) -> None:
        """Forget what has been."""
        if self._solver is not None:
            self._solver.resetStats()

    def trouble(self) -> str | None:
        """Say what went wrong since the restart."""
        if self._solver is None:
            return None
        stats = self._solver.getStats()
        if stats.numFailed:
            return "DART's contact solver failed and a pyramid took the place of the friction cone"
        if stats.maxViolation > _WRONG:
            return f"contacts solved to {stats.maxViolation:.2g} m/s only"
        return None


def contact_failures(
    mechanism: Mechanism, bodies: BodyStates, frame: float
) -> tuple[Failure | None, ...]:
    """Say of each trajectory where a contact was first lost or a rebound may have been cut.

    Args:
        mechanism: The scene's.
        bodies: States, shape (trajectory, frame, body, …); NaN is passed over.
        frame: Interval between frames [s].
    """
    height, approach = _spheres(mechanism, bodies)
    overlap = mechanism.sphere_radius - height
    ground = mechanism.scene.ground
    rebound = ground.restitution * approach if ground else 0.0 * approach
    # What is two frames from the ground may reach it before the next one.
    cut = (rebound > _NEARLY * _FASTEST_REBOUND) & (-overlap < 2.0 * approach * frame)
    wrong = np.asarray(cut | (overlap > mechanism.sphere_radius))

    def reason(row: int, frame: int) -> str:
        sphere = wrong[row, frame].argmax()
        deep, fast = overlap[row, frame, sphere], approach[row, frame, sphere]
        if not cut[row, frame, sphere]:
            return f"contact sphere {sphere} is {deep:.3g} m in the ground"
        limit = f"DART cuts rebounds to {_FASTEST_REBOUND:g} m/s"
        return f"contact sphere {sphere} hits the ground at {fast:.4g} m/s: {limit}"

    return first_failures(np.asarray(wrong.any(axis=-1)), reason, earliest=1)


def _spheres(mechanism: Mechanism, bodies: BodyStates) -> tuple[Array, Array]:
    """Heights of the spheres' centres [m] and their speeds downwards [m/s], (…, sphere)."""
    at = mechanism.sphere_body
    arm = rotation.rotate(bodies.native[..., at, :], mechanism.sphere_offset)
    turning = np.cross(bodies.angular_velocity[..., at, :], arm)
    height = mechanism.sphere_heights(bodies.position, bodies.native)
    return height, -bodies.velocity[..., at, 2] - turning[..., 2]

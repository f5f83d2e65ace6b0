"""Spheres on the ground plane and on each other: the calls that build them, and what DART does
silently to them.

DART takes the smaller friction of a pair and the product of its restitutions, so the ground gets
the pair's friction and a restitution of 1; where bodies collide with each other, spheres have their
friction and the root of their restitution, and the ground what is then missing. Measured on 6.20:

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

import itertools
import math
from collections.abc import Iterator
from typing import Any

import dartpy
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.collisions import Collisions, passed
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Ground
from mbds_xsim.scene.state import Failure
from mbds_xsim.simulate.adapter import first_failures
from mbds_xsim.simulate.claims import ContactLaw

CONTACT_LAW = ContactLaw(
    normal="rigid: impulses of one step, velocities at contacts solved together",
    restitution="a coefficient of each body, from 0.1 to 100 m/s of rebound",
    friction="a box along x and y (Dantzig), or a round cone (NSGS)",
    mixing="the smaller friction, the product of restitutions",
    adapter="The spheres carry the pair's coefficients and the ground restitution 1, so that both "
    "rules give back the pair's; with collisions, spheres carry theirs and the root of the "
    "restitution. At matched, contacts are found by `ode` and solved by NSGS, whose "
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
        Unsupported: DART takes a coefficient that is not 0 for 0, or another one for it.
    """
    ground, collisions = mechanism.scene.ground, mechanism.scene.collisions
    if not mechanism.scene.contacts:
        return
    (plane_friction, friction), (plane_rebound, rebound) = _parted(ground, collisions)
    yield _detection(detector)
    if solver == "nsgs":
        pull = float(np.linalg.norm(mechanism.scene.gravity)) or _EARTH
        yield _SOLVER.format(tolerance=_TOLERANCE * pull * step, sweeps=_SWEEPS)
    yield "shapes = []"
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
    yield f"    shape.getDynamicsAspect().setFrictionCoeff({friction!r})"
    yield f"    shape.getDynamicsAspect().setRestitutionCoeff({rebound!r})"
    if ground is not None:
        yield from (
            "ground = dart.dynamics.Skeleton()",
            "_, plane = ground.createWeldJointAndBodyNodePair()",
            "floor = plane.createShapeNode(dart.dynamics.PlaneShape([0.0, 0.0, 1.0], 0.0))",
            "floor.createCollisionAspect()",
            "floor.createDynamicsAspect()",
            f"floor.getDynamicsAspect().setFrictionCoeff({plane_friction!r})",
            f"floor.getDynamicsAspect().setRestitutionCoeff({plane_rebound!r})",
            "world.addSkeleton(ground)",
        )
    if collisions is not None:
        yield from _filtered(mechanism)


def _filtered(mechanism: Mechanism) -> Iterator[str]:
    """Let bodies collide that may, by a list of those that may not."""
    met = {frozenset(pair) for pair in mechanism.sphere_body[mechanism.sphere_pairs].tolist()}
    carriers = np.unique(mechanism.sphere_body).tolist()
    yield "skeleton.enableSelfCollisionCheck()"
    yield "skeleton.enableAdjacentBodyCheck()"
    yield "apart = world.getConstraintSolver().getCollisionOption().collisionFilter"
    for pair in itertools.combinations(carriers, 2):
        if frozenset(pair) not in met:
            yield f"apart.addBodyNodePairToBlackList(bodies[{pair[0]}], bodies[{pair[1]}])"


def _parted(
    ground: Ground | None, collisions: Collisions | None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Give what the ground and spheres have of friction, then of restitution.

    Raises:
        Unsupported: No such two give both pairs their coefficients.
    """
    for where, law in (("ground", ground), ("collisions", collisions)):
        for what in ("friction", "restitution") if law else ():
            if 0.0 < (value := getattr(law, what)) <= _NONE:
                msg = f"{where}.{what}: got {value}, DART takes {_NONE} and less for 0"
                raise Unsupported(msg)
    if collisions is None:
        assert ground is not None
        return (ground.friction, ground.friction), (1.0, ground.restitution)
    own = math.sqrt(collisions.restitution)
    if ground is None:
        return (0.0, collisions.friction), (0.0, own)
    if ground.friction > collisions.friction or ground.restitution > own:
        msg = (
            f"dart: collisions: got friction {collisions.friction:g} and restitution "
            f"{collisions.restitution:g}, allowed is as much friction as the ground's, "
            f"{ground.friction:g}, as the smaller one of two bodies counts, and a restitution from "
            f"{ground.restitution**2:g} on, the ground's squared, as their product does"
        )
        raise Unsupported(msg)
    return (ground.friction, collisions.friction), (ground.restitution / (own or 1.0), own)


def contacts(shapes: list[Any], floor: Any) -> Array | None:
    """Radius, friction and restitution of each sphere on the ground by DART's rules, (sphere, 3).

    Coefficients are NaN where there is no ground, None.
    """
    if not shapes:
        return None
    laws = [_law(shape, floor) if floor else (np.nan, np.nan) for shape in shapes]
    radii = [shape.getShape().getRadius() for shape in shapes]
    return np.column_stack([radii, laws])


def collisions(shapes: list[Any], mechanism: Mechanism) -> Array:
    """Friction and restitution of each pair of spheres by DART's rules, (pair, 2)."""
    found = [_law(shapes[one], shapes[other]) for one, other in mechanism.sphere_pairs.tolist()]
    return np.array(found).reshape(-1, 2)


def _law(*shapes: Any) -> tuple[float, float]:
    one, other = (shape.getDynamicsAspect() for shape in shapes)
    return (
        min(one.getFrictionCoeff(), other.getFrictionCoeff()),
        one.getRestitutionCoeff() * other.getRestitutionCoeff(),
    )


def centers(shapes: list[Any]) -> Array | None:
    """Centres of the spheres in W as the model stands [m], shape (sphere, 3)."""
    if not shapes:
        return None
    return np.array([shape.getWorldTransform().translation() for shape in shapes])


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
    gap, approach, back, names = _touches(mechanism, bodies)
    # What is two frames from a touch may come to it before the next one.
    cut = (back * approach > _NEARLY * _FASTEST_REBOUND) & (gap < 2.0 * approach * frame)
    lost = passed(mechanism, bodies.position, bodies.native)

    def reason(row: int, frame: int) -> str:
        if lost[row, frame]:
            deepest = int(np.nanargmin(gap[row, frame]))
            one, other = names[deepest]
            return f"{one} is {-gap[row, frame, deepest]:.3g} m in {other}"
        touch = cut[row, frame].argmax()
        limit = f"DART cuts rebounds to {_FASTEST_REBOUND:g} m/s"
        one, other = names[touch]
        return f"{one} hits {other} at {approach[row, frame, touch]:.4g} m/s: {limit}"

    return first_failures(np.asarray(lost | cut.any(axis=-1)), reason, earliest=1)


def _touches(
    mechanism: Mechanism, bodies: BodyStates
) -> tuple[Array, Array, Array, list[tuple[str, str]]]:
    """Gaps [m] of what may touch, and approaches [m/s], (…, touch); restitutions; names."""
    scene, at, radius = mechanism.scene, mechanism.sphere_body, mechanism.sphere_radius
    place = bodies.points(at, mechanism.sphere_offset)
    speed = bodies.speeds(at, mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    apart = place[..., one, :] - place[..., other, :]
    distance = rotation.norm(apart)
    between = distance - radius[one] - radius[other]
    closing = rotation.dot(speed[..., other, :] - speed[..., one, :], apart / distance[..., None])
    spheres = [f"contact sphere {k}" for k in range(len(at))]
    names = [(spheres[i], spheres[j]) for i, j in mechanism.sphere_pairs.tolist()]
    back = [scene.collisions.restitution if scene.collisions else 0.0] * len(names)
    if scene.ground is None:
        return between, closing, np.array(back), names
    names = [(sphere, "the ground") for sphere in spheres] + names
    back = [scene.ground.restitution] * len(at) + back
    gap = np.concatenate([place[..., 2] - radius, between], axis=-1)
    return gap, np.concatenate([-speed[..., 2], closing], axis=-1), np.array(back), names

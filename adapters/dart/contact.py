"""Spheres on the ground plane and on each other: the calls that build them, and DART's rules.

DART takes the smaller friction of a pair and the product of its restitutions. So spheres carry the
pair's coefficients, and the ground the pair's friction and a restitution of 1. Where bodies also
collide with each other, spheres carry the collisions' friction and the square root of their
restitution, and the ground its own friction and the missing factor of its restitution. Measured on
6.20:

- Its own solver (Dantzig) bounds friction by a box along x and y, which at 45° allows √2 times too
  much; `NsgsFrictionSolver` has the round cone.
- All its detectors find every overlap of sphere and plane, exact to rounding at any distance from
  the origin, but they place the point of contact differently: at the sphere's lowest point
  (ode, bullet), on the plane (dart) or half-way (fcl).
- A rebound below 0.1 m/s does not happen and one above 100 m/s is cut; both limits are compiled in.
- The reflected velocity includes the part that gravity adds in the step h, so an impact at v has a
  restitution of about e + 2 g h / v. With e = 0.93 and steps of 1 ms the last bounces, 1 mm high,
  never die out; with 0.5 ms they do.
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
    normal="rigid: impulses within one step, solved for all contacts together",
    restitution="a coefficient of each body, for rebounds from 0.1 to 100 m/s",
    friction="a box along x and y (Dantzig), or a round cone (NSGS)",
    mixing="the smaller friction, the product of restitutions",
    adapter="The spheres carry the pair's coefficients and the ground has restitution 1, so both "
    "mixing rules return the pair's. Between bodies, each sphere carries the square root of the "
    "restitution. Matched settings find contacts with `ode` and solve them with NSGS, whose cone "
    "is round; contacts that the solver leaves unsolved are a failure. DART reflects a speed that "
    "includes one step of gravity, so the matched steps are short. DART limits rebounds to "
    "100 m/s; faster ones are a failure.",
)

DETECTORS = ("fcl", "ode", "bullet", "dart")
SOLVERS = ("dantzig", "nsgs")
# DART treats coefficients up to this one as 0.
_NONE = 1e-3
_FASTEST_REBOUND = 100.0
# Share of it that counts as reached: a falling body gains speed between frame and impact.
_NEARLY = 0.99
_SOLVER = """\
options = dart.constraint.NsgsFrictionSolver.Options()
options.tolerance = {tolerance!r}
options.maxSweeps = {sweeps}
world.getConstraintSolver().setBoxedLcpSolver(dart.constraint.NsgsFrictionSolver(options))"""
# Allowed violation of the contact law, as a share of the velocity that gravity adds in a step.
# DART's own tolerance of 1e-5 m/s leaves to chance how four wheels share a car's weight: the
# regularisation that makes them share evenly is as weak as that.
_TOLERANCE = 5e-6
# Most sweeps of the solver over the contacts of a step. DART's 100 sometimes leave an error of
# 3 mm/s at four wheels; hardly any step takes more.
_SWEEPS = 1000
_EARTH = 9.81
# Violation of the contact law that counts as a failure [m/s].
_WRONG = 1e-3


def _detection(detector: str) -> str:
    """Return the call that selects one of DART's collision detectors."""
    if hasattr(dartpy.simulation.World, "setCollisionDetector"):
        kind = f"dart.simulation.CollisionDetectorType.{detector.upper()}"
        return f"world.setCollisionDetector({kind})"
    kind = f"dart.collision.{detector.upper()}CollisionDetector()"  # before 6.20
    return f"world.getConstraintSolver().setCollisionDetector({kind})"


def contact_statements(
    mechanism: Mechanism, step: float, detector: str, solver: str
) -> Iterator[str]:
    """Yield the calls that put spheres on `bodies` and a ground into `world`, if the scene has any.

    Raises:
        Unsupported: DART would replace a coefficient, by 0 or by another value.
    """
    ground, collisions = mechanism.scene.ground, mechanism.scene.collisions
    if not mechanism.scene.contacts:
        return
    (plane_friction, friction), (plane_restitution, restitution) = _split(ground, collisions)
    yield _detection(detector)
    if solver == "nsgs":
        gravity = float(np.linalg.norm(mechanism.scene.gravity)) or _EARTH
        yield _SOLVER.format(tolerance=_TOLERANCE * gravity * step, sweeps=_SWEEPS)
    yield "shapes = []"
    columns = mechanism.sphere_body, mechanism.sphere_offset, mechanism.sphere_radius
    for body, (x, y, z), radius in zip(*(each.tolist() for each in columns), strict=True):
        yield f"shapes += [bodies[{body}].createShapeNode(dart.dynamics.SphereShape({radius!r}))]"
        yield f"shapes[-1].setRelativeTransform(at({x!r}, {y!r}, {z!r}))"
    yield "for shape in shapes:"
    yield "    shape.createCollisionAspect()"
    yield "    shape.createDynamicsAspect()"
    yield f"    shape.getDynamicsAspect().setFrictionCoeff({friction!r})"
    yield f"    shape.getDynamicsAspect().setRestitutionCoeff({restitution!r})"
    if ground is not None:
        yield from (
            "ground = dart.dynamics.Skeleton()",
            "_, plane = ground.createWeldJointAndBodyNodePair()",
            "floor = plane.createShapeNode(dart.dynamics.PlaneShape([0.0, 0.0, 1.0], 0.0))",
            "floor.createCollisionAspect()",
            "floor.createDynamicsAspect()",
            f"floor.getDynamicsAspect().setFrictionCoeff({plane_friction!r})",
            f"floor.getDynamicsAspect().setRestitutionCoeff({plane_restitution!r})",
            "world.addSkeleton(ground)",
        )
    if collisions is not None:
        yield from _collision_filter(mechanism)


def _collision_filter(mechanism: Mechanism) -> Iterator[str]:
    """Yield the calls that enable collisions of bodies, and exclude the pairs that cannot touch."""
    pairs = {frozenset(pair) for pair in mechanism.sphere_body[mechanism.sphere_pairs].tolist()}
    carriers = np.unique(mechanism.sphere_body).tolist()
    yield "skeleton.enableSelfCollisionCheck()"
    yield "skeleton.enableAdjacentBodyCheck()"
    yield "apart = world.getConstraintSolver().getCollisionOption().collisionFilter"
    for pair in itertools.combinations(carriers, 2):
        if frozenset(pair) not in pairs:
            yield f"apart.addBodyNodePairToBlackList(bodies[{pair[0]}], bodies[{pair[1]}])"


def _split(
    ground: Ground | None, collisions: Collisions | None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the friction of ground and spheres, then their restitution.

    Raises:
        Unsupported: No such values give ground and collisions their coefficients.
    """
    for where, law in (("ground", ground), ("collisions", collisions)):
        for name in ("friction", "restitution") if law else ():
            if 0.0 < (value := getattr(law, name)) <= _NONE:
                raise Unsupported(f"{where}.{name}: got {value}, DART treats {_NONE} and less as 0")
    if collisions is None:
        assert ground is not None
        return (ground.friction, ground.friction), (1.0, ground.restitution)
    root = math.sqrt(collisions.restitution)
    if ground is None:
        return (0.0, collisions.friction), (0.0, root)
    if ground.friction > collisions.friction or ground.restitution > root:
        raise Unsupported(
            f"dart: collisions: got friction {collisions.friction:g} and restitution "
            f"{collisions.restitution:g}, allowed is a friction of at least the "
            f"ground's, {ground.friction:g}, since the smaller of two counts, and a restitution of "
            f"at least the ground's squared, {ground.restitution**2:g}, since the product counts"
        )
    return (ground.friction, collisions.friction), (ground.restitution / (root or 1.0), root)


def contact_readback(shapes: list[Any], floor: Any, mechanism: Mechanism) -> dict[str, Array]:
    """Return the fields of `Readback` on contact, with coefficients as DART's rules mix them.

    Those with the ground are NaN without one (`floor` is None).
    """
    between = [_law(shapes[one], shapes[other]) for one, other in mechanism.sphere_pairs.tolist()]
    fields = {"collision": np.array(between).reshape(-1, 2)}
    if shapes:
        laws = [_law(shape, floor) if floor else (np.nan, np.nan) for shape in shapes]
        radii = [shape.getShape().getRadius() for shape in shapes]
        places = [shape.getWorldTransform().translation() for shape in shapes]
        fields |= {"contact": np.column_stack([radii, laws]), "sphere": np.array(places)}
    return fields


def _law(*shapes: Any) -> tuple[float, float]:
    one, other = (shape.getDynamicsAspect() for shape in shapes)
    return (
        min(one.getFrictionCoeff(), other.getFrictionCoeff()),
        one.getRestitutionCoeff() * other.getRestitutionCoeff(),
    )


class ContactSolver:
    """Monitor of the contact solver, whose failures DART itself does not report."""

    def __init__(self, world: Any) -> None:
        solver = world.getConstraintSolver().getBoxedLcpSolver()
        # Dantzig keeps no record.
        self._solver = solver if hasattr(solver, "getStats") else None

    def restart(self) -> None:
        """Reset the statistics."""
        if self._solver is not None:
            self._solver.resetStats()

    def trouble(self) -> str | None:
        """Describe what went wrong since the restart; None if nothing did."""
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
    """Return each trajectory's first failure: a lost contact, or a rebound that DART may have cut.

    Args:
        mechanism: Mechanism of the scene.
        bodies: States, shape (trajectory, frame, body, …); NaN is ignored.
        frame: Interval between frames [s].
    """
    gap, approach, restitution, names = _touches(mechanism, bodies)
    # A sphere less than two frames away from a touch may touch before the next frame.
    cut = (restitution * approach > _NEARLY * _FASTEST_REBOUND) & (gap < 2.0 * approach * frame)
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
    """Return gaps [m], closing speeds [m/s] (…, touch), restitutions and names of touches."""
    scene, body, radius = mechanism.scene, mechanism.sphere_body, mechanism.sphere_radius
    place = bodies.points(body, mechanism.sphere_offset)
    speed = bodies.speeds(body, mechanism.sphere_offset)
    one, other = mechanism.sphere_pairs.T
    apart = place[..., one, :] - place[..., other, :]
    distance = rotation.norm(apart)
    pair_gap = distance - radius[one] - radius[other]
    closing = rotation.dot(speed[..., other, :] - speed[..., one, :], apart / distance[..., None])
    spheres = [f"contact sphere {k}" for k in range(len(body))]
    names = [(spheres[i], spheres[j]) for i, j in mechanism.sphere_pairs.tolist()]
    restitution = [scene.collisions.restitution if scene.collisions else 0.0] * len(names)
    if scene.ground is None:
        return pair_gap, closing, np.array(restitution), names
    names = [(sphere, "the ground") for sphere in spheres] + names
    restitution = [scene.ground.restitution] * len(body) + restitution
    gap = np.concatenate([place[..., 2] - radius, pair_gap], axis=-1)
    return gap, np.concatenate([-speed[..., 2], closing], axis=-1), np.array(restitution), names

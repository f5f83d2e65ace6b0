"""The native model as a program: a listing that builds it, and a script that runs it to the end.

The adapter executes the listing to build its model. The script that follows is only for users: it
adds shapes, the start, springs and steps, and prints the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint
from mbds_xsim.scene.shapes import TENSION, pull_call, shapes

_PAIR = {"fixed": "Weld", "hinge": "Revolute", "slider": "Prismatic", "ball": "Ball"}
# Least distance of the two pins that close a hinge, over the scene's length.
_LEAST_REACH = 0.1
_HEAD = """\
import dartpy as dart
import numpy as np


def at(x, y, z):
    place = dart.math.Isometry3()
    place.set_translation([x, y, z])
    return place


world = dart.simulation.World()
if hasattr(world, "getDeactivationOptions"):  # releases without never let bodies rest
    deactivation = world.getDeactivationOptions()
    deactivation.mEnabled = False
    world.setDeactivationOptions(deactivation)
skeleton = dart.dynamics.Skeleton()
bodies, joints, shapes = {}, {}, []"""
_SHAPES = """

def show(body, radius, *points):
    shape = dart.dynamics.MultiSphereConvexHullShape([(radius, point) for point in points])
    bodies[body].createShapeNode(shape).createVisualAspect()

"""
_SPRINGS = f"""

def motion(body, point):
    if body is None:
        return np.array(point), np.zeros(3)
    place = body.getWorldTransform()
    return place.translation() + place.rotation() @ point, body.getLinearVelocity(point)
{TENSION}    for end, point, sign in zip(ends, points, (1.0, -1.0)):
        if end is not None:
            end.addExtForce(sign * tension * along, point)


def load():
    skeleton.clearExternalForces()
    skeleton.clearInternalForces()"""
_VIEW = """
# To watch it: viewer = dart.gui.osg.Viewer()
# viewer.addWorldNode(dart.gui.osg.RealTimeWorldNode(world)); viewer.run()"""
_RESULT = """
for body in sorted(bodies):  # centre of mass, rotation matrix, velocity, angular velocity
    place = bodies[body].getWorldTransform()
    rates = bodies[body].getCOMLinearVelocity(), bodies[body].getAngularVelocity()
    print(body, *(part.tolist() for part in (place.translation(), place.rotation(), *rates)))
"""


def build_listing(
    mechanism: Mechanism, step: float, error_reduction: float, contact: Iterable[str]
) -> str:
    """Return the program that defines `world`, `skeleton`, `bodies`, `joints` and `shapes`.

    Bodies are keyed by their number in the scene, joints by the body they carry; the statements
    of `contact` put shapes on them. The model stays in the reference pose, from which constraints
    take their anchor points.
    """
    return "\n".join([_HEAD, *_model(mechanism, step, error_reduction, contact), ""])


def _model(
    mechanism: Mechanism, step: float, error_reduction: float, contact: Iterable[str]
) -> Iterator[str]:
    yield f"world.setGravity({_vector(np.array(mechanism.scene.gravity))})"
    yield f"world.setTimeStep({step!r})"
    for link in mechanism.links:
        yield from _body(mechanism, link, step)
        # With rotors, the toolkit replaces DART's stops; see `stops`.
        if link.joint and link.joint.limits and not mechanism.rotors:
            yield f"joints[{link.body}].setLimitEnforcement(True)"
    yield from contact
    yield "world.addSkeleton(skeleton)"
    for link in mechanism.links:
        if link.joint is None:
            place = [0.0, 0.0, 0.0, *mechanism.com[link.body].tolist()]
            yield f"joints[{link.body}].setPositions({place!r})"
    if mechanism.loops:
        yield "solver = world.getConstraintSolver()"
        for kind in ("Ball", "Weld"):
            yield (
                f"dart.constraint.{kind}JointConstraint"
                f".setErrorReductionParameter({error_reduction!r})"
            )
    for joint in mechanism.loops:
        yield f"# {joint.name!r} closes a loop"
        yield from _closure(mechanism, joint)


def _body(mechanism: Mechanism, link: Link, step: float) -> Iterator[str]:
    k, joint = link.body, link.joint
    parent = "None" if link.parent == WORLD_INDEX else f"bodies[{link.parent}]"
    kind = "Free" if joint is None else _PAIR[joint.kind]
    carrier = f" on {joint.name!r}" if joint is not None else ""
    yield f"# {mechanism.scene.bodies[k].name!r}{carrier}"
    yield f"joints[{k}], bodies[{k}] = skeleton.create{kind}JointAndBodyNodePair({parent})"
    yield f"bodies[{k}].setName('body{k}')"
    yield (
        f"bodies[{k}].setInertia(dart.dynamics.Inertia("
        f"{float(mechanism.mass[k])!r}, np.zeros(3), np.array({mechanism.inertia[k].tolist()!r})))"
    )
    if joint is None:
        return
    for end, point in (("Parent", joint.in_parent), ("Child", joint.in_child)):
        x, y, z = point.tolist()
        yield f"joints[{k}].setTransformFrom{end}BodyNode(at({x!r}, {y!r}, {z!r}))"
    if joint.kind in ("hinge", "slider"):
        yield f"joints[{k}].setAxis({_vector(joint.axis)})"
    if joint.complies or joint.armature:
        # DART's dampers d are implicit: in a step h they act as an additional inertia d h and as a
        # torque of -d times the rate. So a damper can represent a rotor's inertia; a load undoes
        # its torque.
        damping = joint.damping + joint.armature / step
        yield f"joints[{k}].setSpringStiffness(0, {joint.stiffness!r})"
        yield f"joints[{k}].setDampingCoefficient(0, {damping!r})"
        yield f"joints[{k}].setRestPosition(0, {joint.rest!r})"
    if joint.friction:
        yield f"joints[{k}].setCoulombFriction(0, {joint.friction!r})"
    if joint.limits:
        for side, limit in zip(("Lower", "Upper"), joint.limits, strict=True):
            yield f"joints[{k}].setPosition{side}Limit(0, {limit!r})"


def _closure(mechanism: Mechanism, joint: PlacedJoint) -> Iterator[str]:
    ends = ", ".join(f"bodies[{k}]" for k in (joint.parent, joint.child) if k != WORLD_INDEX)
    if joint.kind == "fixed":
        yield f"solver.addConstraint(dart.constraint.WeldJointConstraint({ends}))"
        return
    # Pin a hinge at two points of its axis: RevoluteJointConstraint would pump energy in.
    half = 0.5 * _reach(mechanism, joint) * joint.axis
    pins = (joint.anchor - half, joint.anchor + half) if joint.kind == "hinge" else (joint.anchor,)
    for pin in pins:
        yield f"solver.addConstraint(dart.constraint.BallJointConstraint({ends}, {_vector(pin)}))"


def _reach(mechanism: Mechanism, joint: PlacedJoint) -> float:
    """Return the distance of the two pins [m]: the bodies' size, so that impulses are similar."""
    arms = [joint.in_child] if joint.parent == WORLD_INDEX else [joint.in_child, joint.in_parent]
    # Both bodies may be centred on the hinge: one pin alone would make a ball joint of it.
    least = _LEAST_REACH * mechanism.scene.length
    return float(np.linalg.norm(arms, axis=1).max(initial=least))


def _vector(v: Array) -> str:
    return repr([float(x) for x in v])


def script(mechanism: Mechanism, q: Array, u: Array, step: str, count: int) -> Iterator[str]:
    """Yield the lines of the script that follows the listing.

    Args:
        mechanism: Mechanism of the scene.
        q: Generalised coordinates at the start.
        u: Generalised velocities at the start.
        step: The engine's call for one step; empty if it has none.
        count: Number of steps.
    """
    yield _SHAPES.rstrip("\n") + "\n\n"
    for shape in shapes(mechanism):
        points = ", ".join(map(repr, shape.points))
        yield f"show({shape.body}, {shape.radius!r}, {points})"
    bodies = mechanism.carried
    yield f"skeleton.setPositions({q.tolist()!r})"
    yield f"skeleton.setVelocities({u.tolist()!r})"
    loaded = mechanism.springs or mechanism.drives or mechanism.rotors
    if loaded:
        yield _SPRINGS
        for drive in mechanism.drives:
            at = f"joints[{bodies[drive.joint.index]}]"
            yield f"    angle, rate = {at}.getPosition(0), {at}.getVelocity(0)"
            yield f"    {at}.setForce(0, {at}.getForce(0) + {drive.formula()})"
        for joint in mechanism.rotors:
            at = f"joints[{bodies[joint.index]}]"
            torque = f"{joint.armature!r} / world.getTimeStep() * {at}.getVelocity(0)"
            yield f"    {at}.setForce(0, {at}.getForce(0) + {torque})"
        for spring in mechanism.springs:
            yield pull_call(spring, "bodies[{}]".format, spring.in_body)
        yield "\n"
    yield _VIEW
    if mechanism.rotors and mechanism.limited:
        yield "# Stops are left out: the toolkit sets the dampers that hold joints in each step."
    if step:
        yield f"for _ in range({count}):"
        yield from ["    load()"] if loaded else []
        yield f"    {step}"
    else:
        yield "# The steps are the toolkit's: RK4 on skeleton.computeForwardDynamics()."
    yield _RESULT

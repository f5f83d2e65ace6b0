"""The native model as a program: the calls that build it, as text that is run to build it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.mechanism import WORLD_INDEX, Mechanism, PlacedJoint, PointPair

__all__ = ["bodies_listing"]

Array = NDArray[np.float64]

# Exudyn wants names that no other item has, so the scene's names are comments.
_HEAD = """\
import exudyn as exu
import numpy as np
from exudyn.utilities import RigidBodyInertia

container = exu.SystemContainer()
mbs = container.AddSystem()
ground = mbs.CreateGround()
bodies, joints, forces, torques = [], [], [], []"""

_CALLS = {
    "fixed": "CreateGenericJoint",
    "hinge": "CreateRevoluteJoint",
    "slider": "CreatePrismaticJoint",
    "ball": "CreateSphericalJoint",
}


def bodies_listing(mechanism: Mechanism) -> str:
    """Write the program that leaves `mbs` assembled, one rigid body of six coordinates a body.

    `joints` are in scene order; `forces` has a load a body, `torques` the loads (child, parent or
    None) of each hinge, both in the order of a batch's inputs.
    """
    return "\n".join([_HEAD, *_statements(mechanism), "mbs.Assemble()", ""])


def _statements(mechanism: Mechanism) -> Iterator[str]:
    for k in range(mechanism.body_count):
        yield _body(mechanism, k)
    for joint in mechanism.joints:
        yield _joint(joint)
    for link in mechanism.distances:
        yield f"mbs.CreateDistanceConstraint({_ends(link)}, distance={link.length!r})"
    for spring in mechanism.springs:
        yield (
            f"mbs.CreateSpringDamper({_ends(spring)}, referenceLength={spring.length!r}, "
            f"stiffness={spring.stiffness!r}, damping={spring.damping!r})"
        )
    for k in range(mechanism.body_count):
        yield f"forces.append(mbs.CreateForce(itemNumber=bodies[{k}]))"
    for joint in mechanism.hinges:
        # The axis is fixed in both bodies, so loads in their frames turn with it.
        pair = ", ".join(
            f"mbs.CreateTorque(itemNumber={_item(end)}, bodyFixed=True)"
            if end != WORLD_INDEX
            else "None"
            for end in (joint.child, joint.parent)
        )
        yield f"torques.append(({pair}))"


def _body(mechanism: Mechanism, k: int) -> str:
    # A rotation vector is what every solver of Exudyn takes: the explicit ones refuse Euler
    # parameters. It does not run into its singularity at 2π, the Lie-group update wraps it.
    return (
        f"# {mechanism.scene.bodies[k].name!r}\n"
        "bodies.append(mbs.CreateRigidBody("
        f"referencePosition={mechanism.com[k].tolist()!r}, "
        f"inertia=RigidBodyInertia(mass={float(mechanism.mass[k])!r}, "
        f"inertiaTensor=np.array({mechanism.inertia[k].tolist()!r}), "
        "com=np.zeros(3), inertiaTensorAtCOM=True), "
        f"gravity={list(mechanism.scene.gravity)!r}, "
        "nodeType=exu.NodeType.RotationRotationVector))"
    )


def _joint(joint: PlacedJoint) -> str:
    axis = f", axis={joint.axis.tolist()!r}" if joint.axis.any() else ""
    return (
        f"# {joint.name!r}\n"
        f"joints.append(mbs.{_CALLS[joint.kind]}("
        f"itemNumbers=[{_item(joint.parent)}, {_item(joint.child)}], "
        f"position={joint.anchor.tolist()!r}{axis}))"
    )


def _ends(pair: PointPair) -> str:
    first, second = (point.tolist() for point in pair.in_body)
    return (
        f"itemNumbers=[{', '.join(map(_item, pair.bodies))}], "
        f"localPosition0={first!r}, localPosition1={second!r}"
    )


def _item(body: int) -> str:
    return "ground" if body == WORLD_INDEX else f"bodies[{body}]"

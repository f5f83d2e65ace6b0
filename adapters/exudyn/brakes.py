"""Dry friction, stops, gears, rotors and servos on joint coordinates, as Exudyn objects.

Friction and stops are as hard as a step h resolves, given the inertia at a coordinate: m with all
other joints free, M with all held. A stop is a damper d = 2m/h, with the largest m of many poses. A
joint of this inertia loses its rate in one step. One of less inertia needs several and stays past
its limit meanwhile, however its rate changes sign. The stop is also a spring d²/4M, with the
largest M, so it never overtakes the damper. As the damper also pulls, there is no rebound. Friction
is proportional to the rate up to F h/m, with m at the scene's start; at that rate it would stop the
joint in one step.

Closed loops may hold a joint to bodies that neither inertia counts, so m and M of a stop are at
least the inertia with loops closed, at the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.joint_inertia import closed_inertias, moved_inertias, poses
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint

_FIXED = (
    "fixed = mbs.AddMarker(items.MarkerNodeCoordinate("
    "nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0))"
)
_COUNTER = """

def counter(joint):  # of a hinge's turns; it starts at the hinge's angle at the start
    node = mbs.AddNode(items.NodeGenericData(numberOfDataCoordinates=1, initialCoordinates=[0]))
    counters.append((joint, node))
    return node

"""
_SATURATED = """

def saturated(limit):
    def force(mbs, time, item, place, rate, stiffness, damping, push):
        return min(max(stiffness * place + damping * rate - push, -limit), limit)

    return force

"""
_MEMORY = (
    "nodeNumber=mbs.AddNode(items.NodeGenericData(numberOfDataCoordinates=3, "
    "initialCoordinates=[0, 0, 0]))"
)
_LIMITS = ("limitStopsLower", "limitStopsUpper")
_KINDS = {"hinge": "Rotation", "slider": "Translation"}
# Times M: a joint that moves more is at a dead centre, and elsewhere moves less.
_SINGULAR = 1e3


def counters_listing(mechanism: Mechanism) -> Iterator[str]:
    """Yield lines that make `counters`: joints, by place in the scene, and nodes of their turns."""
    if any(joint.kind == "hinge" for joint in (*mechanism.counted, *mechanism.rotors)):
        yield "counters = []"
        yield _COUNTER


def brakes_listing(mechanism: Mechanism, step: float) -> Iterator[str]:
    """Yield lines that make `brakes`: for joints with friction, then for those with limits.

    A joint with both gets two, as one such object of Exudyn can have only one of them.

    Args:
        mechanism: Mechanism of the scene.
        step: Step of the solver [s].
    """
    frictional, limited = mechanism.frictional, mechanism.limited
    joints = (*frictional, *limited)
    if joints or mechanism.drives:
        yield _FIXED
    if not joints:
        return
    least, most = moved_inertias(mechanism, joints, poses(mechanism))
    laws = [_friction(*pair, step) for pair in zip(frictional, least[0].tolist(), strict=False)]
    inertias = least[:, len(frictional) :].max(axis=0), most[:, len(frictional) :].max(axis=0)
    if limited and (mechanism.loops or mechanism.distances):
        whole = closed_inertias(mechanism, limited)
        whole[whole > _SINGULAR * inertias[1]] = 0.0
        inertias = np.maximum(inertias[0], whole), np.maximum(inertias[1], whole)
    small, large = (values.tolist() for values in inertias)
    laws += [_stops(*each, step) for each in zip(limited, small, large, strict=True)]
    for joint, law in zip(joints, laws, strict=True):
        parameters = ", ".join(f"{key}={value!r}" for key, value in law.items())
        yield (
            f"brakes.append(mbs.AddObject(items.CoordinateSpringDamperExt(markerNumbers=[fixed, "
            f"{_coordinate(joint)}], {_MEMORY}, {parameters})))"
        )


def drives_listing(mechanism: Mechanism) -> Iterator[str]:
    """Yield lines that make `drives`; their offsets are the pushes of their targets."""
    if mechanism.drives:
        yield _SATURATED
    for drive in mechanism.drives:
        servo, push = drive.servo, float(drive.pushes(1)[0])
        yield (
            f"drives.append(mbs.AddObject(items.CoordinateSpringDamper(markerNumbers=[fixed, "
            f"{_coordinate(drive.joint)}], stiffness={servo.stiffness!r}, "
            f"damping={servo.damping!r}, offset={push!r}, "
            f"springForceUserFunction=saturated({_number(drive.limit)}))))"
        )


def _number(value: float) -> str:
    return repr(value) if np.isfinite(value) else "np.inf"


def couplings_listing(mechanism: Mechanism) -> Iterator[str]:
    """Yield lines that make `couplings`."""
    for each in mechanism.couplings:
        ends = f"{_coordinate(each.leader)}, {_coordinate(each.follower)}"
        yield (
            f"couplings.append(mbs.AddObject(items.CoordinateConstraint(markerNumbers=[{ends}], "
            f"factor1={1.0 / each.ratio!r}, offset={each.offset / each.ratio!r})))"
        )


def rotors_listing(mechanism: Mechanism) -> Iterator[str]:
    """Yield lines that make `rotors`: masses with one coordinate, whose rate is a joint's."""
    for joint in mechanism.rotors:
        yield (
            "rotors.append(mbs.AddObject(items.ObjectMass1D("
            f"mass={joint.armature!r}, nodeNumber=mbs.AddNode(items.Node1D()))))"
        )
        marker = (
            "mbs.AddMarker(items.MarkerNodeCoordinate("
            "nodeNumber=mbs.GetObject(rotors[-1])['nodeNumber'], coordinate=0))"
        )
        yield (
            "mbs.AddObject(items.CoordinateConstraint("
            f"markerNumbers=[{_coordinate(joint)}, {marker}], velocityLevel=True))"
        )


def read_brakes(brakes: Sequence[Mapping[str, Any]], mechanism: Mechanism) -> tuple[Array, Array]:
    """Read back friction, shape (joint,), and limits, shape (joint, 2), from `brakes`."""
    count = len(mechanism.frictional)
    friction = np.array([brake["dynamicFrictionForce"] for brake in brakes[:count]])
    limits = [[brake[key] for key in _LIMITS] for brake in brakes[count:]]
    return friction, np.array(limits).reshape(-1, len(_LIMITS))


def item(body: int) -> str:
    """Return the listing's name of a body or the world."""
    return "ground" if body == WORLD_INDEX else f"bodies[{body}]"


def joined_items(joint: PlacedJoint) -> str:
    """Return the listing's names of the two bodies of a joint."""
    return f"{item(joint.parent)}, {item(joint.child)}"


def _coordinate(joint: PlacedJoint) -> str:
    turns = f"nodeNumber=counter({joint.index}), " if joint.kind == "hinge" else ""
    return (
        f"mbs.AddMarker(items.MarkerBodiesRelative{_KINDS[joint.kind]}Coordinate("
        f"bodyNumbers=[{joined_items(joint)}], {turns}localPosition0={joint.in_parent.tolist()!r}, "
        f"localPosition1={joint.in_child.tolist()!r}, axis0={joint.axis.tolist()!r}))"
    )


def _friction(joint: PlacedJoint, least: float, step: float) -> dict[str, float | bool]:
    zone = joint.friction * step / least
    return {"dynamicFrictionForce": joint.friction, "frictionProportionalZone": zone}


def _stops(joint: PlacedJoint, least: float, most: float, step: float) -> dict[str, float | bool]:
    assert joint.limits is not None
    damping = 2.0 * least / step
    law = {"limitStopsDamping": damping, "limitStopsStiffness": damping**2 / (4.0 * most)}
    return {"useLimitStops": True} | law | dict(zip(_LIMITS, joint.limits, strict=True))

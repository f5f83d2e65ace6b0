"""What acts on coordinates of joints in Exudyn's terms: dry friction, stops, gears and servos.

Friction and stops are as hard as a step h resolves, by what a coordinate moves at the scene's
start, m with all other joints free, M with all held. A stop is a damper d of 2m/h, which takes a
rate in a few steps however little it moves, and a spring of d²/4M, which never overtakes it; as the
damper also pulls, there is no rebound. Friction is in proportion to the rate up to F h/m, at which
it would stop the joint in a step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Array
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism, PlacedJoint
from mbds_xsim.scene.stiffness import moved_inertias

_FIXED = (
    "fixed = mbs.AddMarker(items.MarkerNodeCoordinate("
    "nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0))"
)
_SATURATED = """

def saturated(limit):
    def force(mbs, time, item, place, rate, stiffness, damping, push):
        return min(max(stiffness * place + damping * rate - push, -limit), limit)

    return force

"""
_KINDS = {"hinge": "Rotation", "slider": "Translation"}


def braked(mechanism: Mechanism) -> tuple[PlacedJoint, ...]:
    """Give the joints with friction or limits, in scene order."""
    return tuple(joint for joint in mechanism.joints if joint.friction or joint.limits)


def brakes_listing(mechanism: Mechanism, step: float) -> Iterator[str]:
    """Lines that make `brakes`, one a braked joint; none where there is none.

    Args:
        mechanism: Of the scene.
        step: Of the solver [s].
    """
    joints = braked(mechanism)
    if joints or mechanism.drives:
        yield _FIXED
    least, most = (values.tolist() for values in moved_inertias(mechanism, joints))
    for joint, free, whole in zip(joints, least, most, strict=True):
        yield (
            f"brakes.append(mbs.AddObject(items.CoordinateSpringDamperExt(markerNumbers=[fixed, "
            f"{_coordinate(joint)}], nodeNumber={_data(3)}, {_law(joint, free, whole, step)})))"
        )


def drives_listing(mechanism: Mechanism) -> Iterator[str]:
    """Lines that make `drives`, whose offsets are what their targets exert."""
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
    """Lines that make `couplings`."""
    for each in mechanism.couplings:
        ends = f"{_coordinate(each.leader)}, {_coordinate(each.follower)}"
        yield (
            f"couplings.append(mbs.AddObject(items.CoordinateConstraint(markerNumbers=[{ends}], "
            f"factor1={1.0 / each.ratio!r}, offset={each.offset / each.ratio!r})))"
        )


def held(names: Mapping[str, Any], mechanism: Mechanism, key: str, joints: Any) -> Array:
    """Read a value of the brakes of some joints back."""
    objects = zip(braked(mechanism), names["brakes"], strict=True)
    found = {joint.index: names["mbs"].GetObject(number)[key] for joint, number in objects}
    return np.array([found[joint.index] for joint in joints])


def _coordinate(joint: PlacedJoint) -> str:
    bodies = ", ".join(
        "ground" if body == WORLD_INDEX else f"bodies[{body}]"
        for body in (joint.parent, joint.child)
    )
    turns = f"nodeNumber={_data(1)}, " if joint.kind == "hinge" else ""
    return (
        f"mbs.AddMarker(items.MarkerBodiesRelative{_KINDS[joint.kind]}Coordinate("
        f"bodyNumbers=[{bodies}], {turns}localPosition0={joint.in_parent.tolist()!r}, "
        f"localPosition1={joint.in_child.tolist()!r}, axis0={joint.axis.tolist()!r}))"
    )


def _data(count: int) -> str:
    return (
        f"mbs.AddNode(items.NodeGenericData(numberOfDataCoordinates={count}, "
        f"initialCoordinates={[0] * count}))"
    )


def _law(joint: PlacedJoint, least: float, most: float, step: float) -> str:
    law: dict[str, float | bool] = {}
    if joint.friction:
        law["dynamicFrictionForce"] = joint.friction
        law["frictionProportionalZone"] = joint.friction * step / least
    if joint.limits:
        damping = 2.0 * least / step
        law |= {"useLimitStops": True, "limitStopsDamping": damping}
        law["limitStopsStiffness"] = damping**2 / (4.0 * most)
        law |= dict(zip(("limitStopsLower", "limitStopsUpper"), joint.limits, strict=True))
    return ", ".join(f"{key}={value!r}" for key, value in law.items())

"""Fates of all attributes of USD Physics, in one table; `fates` has those of XML formats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mbds_xsim.scene.imported import Fate

from .fates import COLLISION, Entry, by_key, grouped

_TABLE = by_key((
    ("kept", True, "as the library of OpenUSD parses it",
     "physics:mass physics:density physics:centerOfMass physics:diagonalInertia "
     "physics:principalAxes physics:gravityDirection physics:gravityMagnitude physics:axis "
     "physics:localPos0 physics:localRot0 physics:localPos1 physics:localRot1 physics:body0 "
     "physics:body1 physics:rigidBodyEnabled physics:jointEnabled physics:kinematicEnabled "
     "physics:excludeFromArticulation physics:minDistance physics:maxDistance "
     "limit:physics:low limit:physics:high"),
    ("dropped", True, COLLISION,
     "physics:collisionEnabled physics:staticFriction physics:dynamicFriction "
     "physics:restitution"),
    ("dropped", False, COLLISION, "physics:filteredPairs physics:filteredGroups "
     "physics:invertFilteredGroups physics:mergeGroup collection physics:approximation "
     "physics:simulationOwner"),
    ("dropped", True, "the model starts in the reference pose, at rest",
     "physics:velocity physics:angularVelocity"),
    ("dropped", True, "it is not of a hinge or slider, or PhysicsDriveAPI is not applied", "drive"),
    ("dropped", True, "joints do not break", "physics:breakForce physics:breakTorque"),
    ("dropped", False, "a setting of an engine, not of the mechanism", "physics:startsAsleep"),
    ("dropped", True, "not yet in the scene description",
     "physics:coneAngle0Limit physics:coneAngle1Limit"),
))  # fmt: skip
_CONTACT = "decides how shapes meet the ground"
_TOUCHING = by_key((
    ("kept", True, _CONTACT,
     "physics:collisionEnabled physics:dynamicFriction physics:restitution collection "
     "physics:filteredPairs physics:filteredGroups physics:invertFilteredGroups "
     "physics:mergeGroup"),
    ("dropped", True, "the ground has the dynamic one alone", "physics:staticFriction"),
))  # fmt: skip
"""Rows that replace those above if shapes touch the ground."""
_SIZES = "radius height size axis"
_SHAPE = {
    True: by_key([("kept", True, _CONTACT, f"material {_SIZES}")]),
    False: by_key([("kept", True, "its mass, where its body states none", _SIZES)]),
}
"""Attributes of collision shapes, by whether they touch the ground."""
_LIMITS = ("physics:lowerLimit", "physics:upperLimit")
_DRIVE_JOINTS = ("PhysicsRevoluteJoint", "PhysicsPrismaticJoint", "PhysicsJoint")
"""Types of joints whose drives are reported one by one."""
_SIMULATORS = ("physx", "mjc", "newton", "isaac")


def fates_of(stage: Any, *, limited: bool, touching: bool) -> Iterator[Fate]:
    """Walk a stage and return the fates of all authored properties.

    Args:
        stage: The stage.
        limited: Whether limits are reported joint by joint.
        touching: Whether shapes touch the ground, and are reported one by one.
    """
    from pxr import Usd

    table = _TABLE | _TOUCHING if touching else _TABLE
    found = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        kind, place = str(prim.GetTypeName()) or "Prim", prim.GetName()
        solid = "PhysicsCollisionAPI" in prim.GetAppliedSchemas()
        for attribute in prim.GetAuthoredProperties():
            name = attribute.GetName()
            if not ((name in _LIMITS and limited) or _is_of_drive(prim, name)):
                entry = _fate(table | _SHAPE[touching] if solid else table, name)
                found.append((kind, entry, name, prim.GetPath(), place))
    return grouped(found)


def _is_of_drive(prim: Any, name: str) -> bool:
    """Whether a property belongs to a drive that the library parses."""
    first, _, rest = name.partition(":")
    applied = f"PhysicsDriveAPI:{rest.partition(':')[0]}" in prim.GetAppliedSchemas()
    return first == "drive" and applied and prim.GetTypeName() in _DRIVE_JOINTS


def _fate(table: Mapping[str, Entry], name: str) -> Entry:
    first, _, rest = name.partition(":")
    general = f"{first}:{rest.partition(':')[2]}"  # limit:rotX:physics:low
    for key in (name, general, first):
        if key in table:
            return table[key]
    if name in _LIMITS:
        return ("kept", True, "none, or without bounds")
    if first in ("physics", "limit") or first.startswith(_SIMULATORS):
        return ("dropped", True, "unknown to this reader")
    if first == "xformOp" or name == "xformOpOrder":
        return ("kept", True, "as the library of OpenUSD composes it")
    return ("dropped", False, "drawn only")

"""Limits that a model's start keeps, as far as nothing ties its joints; others are dropped."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.imported import Fate
from mbds_xsim.scene.joint_space import joint_coordinate
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.sampling_terms import Pose
from mbds_xsim.scene.scene import Scene

_PAST = "its start, which a loop or a coupling decides, is past them"


def kept_limits(scene: Scene, label: tuple[str, str]) -> tuple[Scene, list[Fate]]:
    """Give the scene without limits that its start breaks, and what becomes of these.

    Args:
        scene: With the draws of its starts, which are within the limits.
        label: Element and attribute of limits in the format.
    """
    broken = {*_broken(scene)}
    if not broken:
        return scene, []
    joints = (
        msgspec.structs.replace(joint, limits=None) if joint.name in broken else joint
        for joint in scene.joints
    )
    element, attribute = label
    fate = Fate(element, (attribute,), "dropped", _PAST, True, tuple(sorted(broken)), len(broken))
    return msgspec.structs.replace(scene, joints=tuple(joints)), [fate]


def _broken(scene: Scene) -> Iterator[str]:
    drawn = {name for draw in scene.sampling if isinstance(draw, Pose) for name in draw.joints}
    mechanism = Mechanism.of(scene)
    tied = [joint for joint in mechanism.limited if joint.name not in drawn]
    start = assemble(mechanism) if tied else None
    for joint in tied:
        assert start is not None
        if joint.beyond(joint_coordinate(joint, start.position, start.native)) > 0.0:
            yield joint.name

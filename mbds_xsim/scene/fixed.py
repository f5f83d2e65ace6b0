"""Contact spheres that nothing can move."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Index
from mbds_xsim.scene.scene import WORLD, Scene


def fixed_spheres(scene: Scene) -> Index:
    """Return contact spheres on bodies that fixed joints hold to the world, shape (any,).

    They cannot move, so the ground cannot hit them.
    """
    welded: dict[str, list[str]] = {}
    for joint in scene.joints:
        if joint.kind == "fixed":
            welded.setdefault(joint.parent, []).append(joint.child)
            welded.setdefault(joint.child, []).append(joint.parent)
    held, new = {WORLD}, [WORLD]
    while new:
        near = [body for body in welded.get(new.pop(), ()) if body not in held]
        held.update(near)
        new += near
    fixed = [k for k, sphere in enumerate(scene.contacts) if sphere.body in held]
    return np.array(fixed, dtype=np.int64)

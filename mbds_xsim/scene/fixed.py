"""Contact spheres that nothing can move."""

from __future__ import annotations

import numpy as np

from mbds_xsim.base.arrays import Index
from mbds_xsim.scene.scene import WORLD, Scene


def fixed_spheres(scene: Scene) -> Index:
    """Return contact spheres on bodies that fixed joints hold to the world, shape (any,).

    They cannot move, so the ground cannot hit them.
    """
    held, joints = {WORLD}, [joint for joint in scene.joints if joint.kind == "fixed"]
    for _ in joints:
        for joint in joints:
            if held & {joint.parent, joint.child}:
                held |= {joint.parent, joint.child}
    fixed = [k for k, sphere in enumerate(scene.contacts) if sphere.body in held]
    return np.array(fixed, dtype=np.int64)

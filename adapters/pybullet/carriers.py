"""Links that carry the contact spheres of a body beyond those that a shape of Bullet can hold.

They are welded to the body, have its frames and no mass, and come last in their multibody.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mbds_xsim.base.arrays import Index
from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism

from .client import BARE_LINK

MOST_SPHERES = 16
"""Most spheres of a shape: MAX_COMPOUND_COLLISION_SHAPES of Bullet's SharedMemoryPublic.h."""


def carrier_counts(mechanism: Mechanism) -> Index:
    """Return the number of such links of every body, shape (body,)."""
    spheres = np.bincount(mechanism.sphere_body, minlength=mechanism.body_count)
    return np.maximum(spheres - 1, 0) // MOST_SPHERES


def sinking(mechanism: Mechanism) -> str:
    """Describe a body some of whose spheres would pass through others; "" if there is none.

    Bullet treats a link that is welded to a fixed base's first link as static, so that it does not
    touch what is static, too (ConvertURDF2BulletInternal stops its search there): the ground,
    bodies that are welded to the world, and others like it.
    """
    counts, first, fixed = carrier_counts(mechanism), set[int](), {WORLD_INDEX}
    why = dict[int, str]()
    for body, parent, joint in ((link.body, link.parent, link.joint) for link in mechanism.links):
        if joint is None:
            continue
        name, spheres = mechanism.scene.bodies[body].name, np.sum(mechanism.sphere_body == body)
        if joint.kind == "fixed" and parent in fixed:
            fixed.add(body)
        elif joint.kind != "fixed" and parent == WORLD_INDEX:
            first.add(body)
            if counts[body]:
                most = f"PyBullet takes {MOST_SPHERES} if a joint ties it to the world"
                why[body] = f"{name!r} has {spheres} contact spheres, {most}"
        elif joint.kind == "fixed" and parent in first:
            first.add(body)
            if spheres:
                to, what = mechanism.scene.bodies[parent].name, "the ground, or others like it"
                why[body] = f"PyBullet lets no sphere of {name!r} touch {what}; put them on {to!r}"
    pairs = mechanism.sphere_body[mechanism.sphere_pairs]
    static = pairs[np.isin(pairs, [*fixed, *why]).all(axis=1)]
    grounded = mechanism.scene.ground is not None
    return next((text for body, text in why.items() if grounded or body in static), "")


def carriers(
    links: Sequence[Mapping[str, Any]], shapes: Sequence[Sequence[int]], base_turn: list[float]
) -> list[dict[str, Any]]:
    """Return these links as `createMultiBody` takes them, each on the body that it carries for.

    Args:
        links: The same for the links of bodies.
        shapes: Shapes of the base and of these links; all but the first of each need a link.
        base_turn: Rotation of the base's inertial frame, xyzw.
    """
    held = [{**BARE_LINK, "linkInertialFrameOrientations": base_turn}, *links]
    inertial = "linkInertialFramePositions", "linkInertialFrameOrientations"
    return [
        {
            **BARE_LINK,
            **{key: held[place][key] for key in inertial},
            "linkCollisionShapeIndices": shape,
            "linkParentIndices": place,
        }
        for place, own in enumerate(shapes)
        for shape in own[1:]
    ]

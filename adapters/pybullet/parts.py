"""The spanning tree cut into the multibodies that Bullet can hold."""

from __future__ import annotations

from dataclasses import dataclass

from mbds_xsim.base.errors import Unsupported
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint

# Bullet's server passes states in arrays of 128 coordinates, 7 of them the base's; beyond them
# it reads and writes elsewhere (MAX_DEGREE_OF_FREEDOM in SharedMemoryPublic.h).
COORDINATE_LIMIT = 128 - 7

FREEDOMS = {"ball": 3, "hinge": 1, "slider": 1, "fixed": 0}
"""Rates of a link's joint."""
_COORDINATES = {"ball": 4, "hinge": 1, "slider": 1, "fixed": 1}
# Joints that a constraint can replace, best first.
_CUT_ORDER = {"ball": 0, "hinge": 1, "fixed": 2}


@dataclass(frozen=True)
class Multibody:
    """One multibody."""

    base: int
    """The body that is its base; −1: a fixed base at the world's origin."""
    links: tuple[Link, ...]
    """Parents before children; their order is Bullet's."""

    @property
    def geared(self) -> list[tuple[PlacedJoint, int]]:
        """Joints with rotors, and bodies they carry: rotors are links behind the bodies'."""
        joints = [(link.joint, link.body) for link in self.links]
        return [(joint, body) for joint, body in joints if joint and joint.armature]

    @property
    def coordinate_count(self) -> int:
        """Rates of the base, of all joints and of rotors."""
        base = 0 if self.base == WORLD_INDEX else 6
        joints = sum(FREEDOMS[link.joint.kind] for link in self.links if link.joint)
        return base + joints + len(self.geared)


def split(mechanism: Mechanism) -> tuple[tuple[Multibody, ...], tuple[PlacedJoint, ...]]:
    """Give the parts, and the tree joints that have to be closed as constraints instead.

    What hangs on the world by one joint, and every free body with what it carries, is a part of
    its own: a constraint then works on few coordinates. Larger ones are cut further.

    Raises:
        Unsupported: A body carries more joints that cannot be cut than a multibody can hold.
    """
    cut = _cuts(mechanism)
    root: dict[int, int] = {}
    for link in mechanism.links:
        starts = link.parent == WORLD_INDEX or link.body in cut
        root[link.body] = link.body if starts else root[link.parent]
    parts = []
    for first in (link for link in mechanism.links if root[link.body] == link.body):
        fixed = first.joint is not None and first.body not in cut
        parts.append(
            Multibody(
                base=WORLD_INDEX if fixed else first.body,
                links=tuple(
                    link
                    for link in mechanism.links
                    if root[link.body] == first.body and (fixed or link is not first)
                ),
            )
        )
    joints = [link.joint for link in mechanism.links if link.body in cut and link.joint is not None]
    return tuple(parts), tuple(joints)


def _cuts(mechanism: Mechanism) -> set[int]:
    """Bodies to be cut off their tree parents, found from the tips inwards."""
    load: dict[int, int] = {}
    carried: dict[int, list[Link]] = {link.body: [] for link in mechanism.links}
    cut: set[int] = set()
    for link in reversed(mechanism.links):
        own = 0 if link.joint is None else _COORDINATES[link.joint.kind]
        own += bool(link.joint and link.joint.armature)
        outer = carried[link.body]
        load[link.body] = own + sum(load[child.body] for child in outer)
        while load[link.body] > COORDINATE_LIMIT:
            heaviest = _best_cut(mechanism, link, outer, load)
            outer.remove(heaviest)
            cut.add(heaviest.body)
            load[link.body] -= load[heaviest.body]
        if link.parent != WORLD_INDEX:
            carried[link.parent].append(link)
    return cut


def _best_cut(mechanism: Mechanism, link: Link, outer: list[Link], load: dict[int, int]) -> Link:
    choices = [
        child
        for child in outer
        if child.joint and child.joint.kind in _CUT_ORDER and not child.joint.is_loaded
    ]
    if not choices:
        name = mechanism.scene.bodies[link.body].name
        msg = (
            f"pybullet: body {name!r} carries more sliders, or joints with springs, dampers or "
            f"couplings, than the {COORDINATE_LIMIT} coordinates that a multibody can hold, and "
            "Bullet has no constraint to replace one"
        )
        raise Unsupported(msg)
    return min(
        choices,
        key=lambda child: (_CUT_ORDER[child.joint.kind] if child.joint else 0, -load[child.body]),
    )

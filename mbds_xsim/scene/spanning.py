"""The spanning tree: joints that carry bodies, joints that close loops, connected bodies."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mbds_xsim.scene.mechanism import JointKind, PlacedJoint

_WORLD = -1


def spanning_tree(
    body_count: int, joints: tuple[PlacedJoint, ...], cut: tuple[JointKind, ...]
) -> tuple[list[tuple[int, int, PlacedJoint | None]], tuple[PlacedJoint, ...]]:
    """Find Kruskal's minimum spanning forest, with links ordered from the roots outwards.

    Of joints of one kind, the last one listed closes the loop, but one without spring and damper
    sooner than one with them, since reduced coordinates have these in the tree. Joints with a
    rotor, friction, limits, a coupling or a drive stay in the tree before all others.

    Returns:
        Body, parent and joint from the parent (None if free) of each link; joints closing loops.
    """
    tree: list[PlacedJoint] = []
    loops: list[PlacedJoint] = []
    groups = _Groups(body_count + 1)  # the last one is the world

    def cut_last(joint: PlacedJoint) -> tuple[bool, int, bool]:
        return not joint.in_tree, -cut.index(joint.kind), not joint.complies

    for joint in sorted(joints, key=cut_last):
        (tree if groups.join(joint.parent, joint.child) else loops).append(joint)
    joints_at: dict[int, list[PlacedJoint]] = defaultdict(list)
    for joint in sorted(tree, key=lambda joint: joint.index):
        joints_at[joint.parent].append(joint)
        joints_at[joint.child].append(joint)
    links: list[tuple[int, int, PlacedJoint | None]] = []
    reached: set[int] = {_WORLD}
    queue = deque([_WORLD])
    roots = iter(range(body_count))
    while len(links) < body_count:
        if not queue:
            root = next(k for k in roots if k not in reached)
            links.append((root, _WORLD, None))
            reached.add(root)
            queue.append(root)
        here = queue.popleft()
        for joint in joints_at[here]:
            outwards = joint if joint.parent == here else joint.turned_round()
            if outwards.child not in reached:
                links.append((outwards.child, here, outwards))
                reached.add(outwards.child)
                queue.append(outwards.child)
    return links, tuple(sorted(loops, key=lambda joint: joint.index))


def connected(body_count: int, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Group the bodies that pairs connect, directly or through others but not through the world."""
    groups = _Groups(body_count)
    for a, b in pairs:
        if _WORLD not in (a, b):
            groups.join(a, b)
    members: dict[int, list[int]] = defaultdict(list)
    for body in range(body_count):
        members[groups.find(body)].append(body)
    return [tuple(bodies) for bodies in members.values()]


class _Groups:
    """Groups of numbers that are joined pair by pair; negative numbers count from the end."""

    def __init__(self, count: int) -> None:
        self._of = list(range(count))

    def find(self, number: int) -> int:
        """Return the number that stands for a number's group."""
        above = self._of[number]
        while above != self._of[above]:
            self._of[number] = self._of[above]
            number, above = above, self._of[above]
        return above

    def join(self, one: int, other: int) -> bool:
        """Join the groups of two numbers; return False if it is the same group already."""
        one, other = self.find(one), self.find(other)
        self._of[one] = other
        return one != other

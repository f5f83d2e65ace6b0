"""Which joints carry bodies, which close loops, and which bodies hang together."""

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
    """Kruskal's minimum spanning forest, then links ordered from the roots outwards.

    Of joints of one kind, the last listed closes the loop; those with a spring or damper stay in
    the tree if any can, as reduced coordinates have them there, and those that have a rotor or
    friction or limits or are coupled before all.

    Returns:
        Of each link body, parent and joint from the parent to it, and the joints that close loops.
    """
    group = list(range(body_count + 1))  # the last one is the world

    def find(k: int) -> int:
        while group[k] != k:
            group[k] = group[group[k]]
            k = group[k]
        return k

    tree, loops = [], []

    def cut_last(joint: PlacedJoint) -> tuple[bool, int, bool]:
        return not joint.in_tree, -cut.index(joint.kind), not joint.complies

    for joint in sorted(joints, key=cut_last):
        a, b = find(joint.parent % (body_count + 1)), find(joint.child % (body_count + 1))
        if a == b:
            loops.append(joint)
        else:
            group[a] = b
            tree.append(joint)
    at: dict[int, list[PlacedJoint]] = defaultdict(list)
    for joint in sorted(tree, key=lambda joint: joint.index):
        at[joint.parent].append(joint)
        at[joint.child].append(joint)
    links: list[tuple[int, int, PlacedJoint | None]] = []
    seen: set[int] = {_WORLD}
    queue = deque([_WORLD])
    roots = iter(range(body_count))
    while len(links) < body_count:
        if not queue:
            root = next(k for k in roots if k not in seen)
            links.append((root, _WORLD, None))
            seen.add(root)
            queue.append(root)
        here = queue.popleft()
        for joint in at[here]:
            outwards = joint if joint.parent == here else joint.turned_round()
            if outwards.child not in seen:
                links.append((outwards.child, here, outwards))
                seen.add(outwards.child)
                queue.append(outwards.child)
    return links, tuple(sorted(loops, key=lambda joint: joint.index))


def connected(body_count: int, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Group the bodies that pairs connect, directly or by way of others but not of the world."""
    label = list(range(body_count))
    for a, b in pairs:
        if _WORLD not in (a, b):
            old, new = label[b], label[a]
            label = [new if one == old else one for one in label]
    return [
        tuple(k for k, one in enumerate(label) if one == group) for group in dict.fromkeys(label)
    ]

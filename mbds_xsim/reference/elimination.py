"""Plan to eliminate closure rows on the way to the roots, so that cost grows with links only.

A row's load comes down the tree from its two ends. At the link where these meet, nothing further
out can change it any more: the row is eliminated there, and the link resists as if its loops were
closed. Rows that act on the same link are coupled, and so are the rows that an eliminated row was
coupled with. Few loops are open at once if a spanning tree goes along a mechanism and back. So of
several trees the one with the least work is taken.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Index, Mask
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism, PlacedJoint

FIRST, SECOND, BOTH = range(3)

_CLOSES = {"ball": 3, "hinge": 5, "slider": 5, "fixed": 6}  # rows of a joint
_DISTANCE = 1  # rows of a distance link
_PASSING = 8  # work of passing one row through a link, in couplings


class Elimination(NamedTuple):
    """Work at each link and then at the world.

    Lists of each link or row follow each other in one array; `…_start` has the first index of each.
    """

    on_start: Index
    """First index in the next three of the rows whose loads pass each link, shape (link + 1,)."""
    on_row: Index
    on_end: Index
    """End of the row whose load passes the link: `FIRST`, `SECOND`, or `BOTH`."""
    on_speed: Index
    """Index in `Workspace.response` of the row's effects on the link's speeds."""
    on_pair: Index
    """Couplings of each of these rows with those before it on its link, and then with itself."""
    pair_start: Index
    """First index in `on_pair` of the couplings of each link, shape (link + 1,)."""
    drop: Index
    """First and last index (exclusive) in the next two of the rows eliminated at each link and at
    the world, shape (link + 1, 2)."""
    drop_row: Index
    near_start: Index
    """First index in the next three of the rows coupled with each of these, shape (row + 1,)."""
    near_row: Index
    near_end: Index
    """End of the coupled row whose load passes that link; `FIRST` if the row ends there."""
    near_pair: Index
    fill_start: Index
    """First index of the couplings of these with those before them and themselves, (row + 1,)."""
    fill_pair: Index
    pair_row: Index
    """Rows of each coupling, shape (coupling, 2); couplings of rows with themselves come first."""
    speed_count: int


def plan_of(
    parent: Index, speeds: Index, ends: Index, coupled: Mask, *, keep_all: bool = False
) -> Elimination:
    """Plan the elimination of rows.

    Args:
        parent: Parent of each link; children have the larger numbers.
        speeds: Number of each link's speeds.
        ends: Links of the rows' two ends, shape (row, 2).
        coupled: Mask of the rows that act on coordinates of these links, shape (row,).
        keep_all: Whether no row is eliminated; the couplings are then those at the world.
    """
    world, couplings = len(parent), _Couplings(len(ends))
    on, leaving = _ways(parent, ends, coupled, keep_all)
    pairs: list[list[int]] = [[] for _ in range(world)]
    drop = np.zeros((world + 1, 2), dtype=np.int64)
    dropped: list[int] = []
    near, fill = [], []
    for link in (*range(world - 1, -1, -1), world):
        drop[link, 0] = len(dropped)
        ends_here, rows = dict(on[link]), set(leaving[link])
        while rows:
            row = min(rows, key=lambda each: (len(couplings.near[each]), each))
            rows.remove(row)
            others = couplings.release(row)
            dropped.append(row)
            near.append([(k, ends_here.get(k, FIRST), couplings.pair(row, k)) for k in others])
            fill.append(couplings.join(others))
        drop[link, 1] = len(dropped)
        if link < world:
            pairs[link] = couplings.join([row for row, _ in on[link]])
    width = [int(speeds[link]) for link in range(world) for _ in on[link]]
    on_row, on_end = _columns(on[:world], 2)
    near_row, near_end, near_pair = _columns(near, 3)
    return Elimination(
        on_start=_starts(on[:world]),
        on_row=on_row,
        on_end=on_end,
        on_speed=np.cumsum([0, *width])[:-1],
        on_pair=_columns(pairs, 1)[0],
        pair_start=_starts(pairs),
        drop=drop,
        drop_row=np.array(dropped, dtype=np.int64),
        near_start=_starts(near),
        near_row=near_row,
        near_end=near_end,
        near_pair=near_pair,
        fill_start=_starts(fill),
        fill_pair=_columns(fill, 1)[0],
        pair_row=np.array([*couplings.number], dtype=np.int64).reshape(-1, 2),
        speed_count=sum(width),
    )


class _Couplings:
    """Coupled rows, and the number of each coupling."""

    def __init__(self, count: int) -> None:
        self.near: list[set[int]] = [set() for _ in range(count)]
        self.number = {(k, k): k for k in range(count)}

    def pair(self, one: int, other: int) -> int:
        return self.number.setdefault((max(one, other), min(one, other)), len(self.number))

    def join(self, rows: list[int]) -> list[int]:
        """Couple rows with each other; return the numbers of these couplings, row by row."""
        for row in rows:
            self.near[row].update(other for other in rows if other != row)
        return [self.pair(one, other) for q, one in enumerate(rows) for other in rows[: q + 1]]

    def release(self, row: int) -> list[int]:
        """Return the rows that a row is coupled with, and uncouple it from them."""
        others = sorted(self.near[row])
        for other in others:
            self.near[other].discard(row)
        return others


def _ways(
    parent: Index, ends: Index, coupled: Mask, keep_all: bool = False
) -> tuple[list[list[tuple[int, int]]], list[list[int]]]:
    """Return the rows whose loads pass each link, with their ends, and those eliminated there."""
    world = len(parent)
    on: list[list[tuple[int, int]]] = [[] for _ in range(world + 1)]
    leaving: list[list[int]] = [[] for _ in range(world + 1)]
    for row, pair in enumerate(ends.tolist()):
        first, second = (_path(parent, end) for end in pair)
        inner = [path[1:] if coupled[row] else path for path in (first, second)]
        meet = next((link for link in inner[0] if link in inner[1]), world)
        if not keep_all:
            leaving[meet].append(row)
        for link in {*first, *second}:
            if keep_all or link > meet or meet == world:
                sides = [side for side, path in enumerate((first, second)) if link in path]
                on[link].append((row, sides[0] if len(sides) == 1 else BOTH))
    return on, leaving


def _path(parent: Index, link: int) -> list[int]:
    """Links from one to its root."""
    path = []
    while link < len(parent):
        path.append(link)
        link = int(parent[link])
    return path


def _starts(lists: Sequence[Sequence[object]]) -> Index:
    return np.cumsum([0, *map(len, lists)])


def _columns(lists: Sequence[Sequence[object]], count: int) -> Index:
    """Join lists of numbers, or of as many in a tuple; return what stands in each place."""
    table = np.array([each for one in lists for each in one], dtype=np.int64)
    return np.ascontiguousarray(table.reshape(-1, count).T)


def with_short_loops(mechanism: Mechanism) -> Mechanism:
    """Return a mechanism with the spanning tree in which closing its loops costs least.

    The candidates are its own tree and two depth-first trees, which try the joints of each body
    forwards or backwards. Joints that only a tree can have (`PlacedJoint.in_tree`) stay in it.
    """
    if not mechanism.loops:
        return mechanism
    trees = [mechanism, *(_far(mechanism, turn) for turn in (1, -1))]
    able = [t for t in trees if not any(joint.in_tree for joint in t.loops)]
    return min(able, key=_work)


def _far(mechanism: Mechanism, turn: int) -> Mechanism:
    """Build a tree depth first: follow joints, and turn back where all neighbours are known."""
    at: dict[int, list[PlacedJoint]] = defaultdict(list)
    for joint in mechanism.joints:
        at[joint.parent].append(joint)
        at[joint.child].append(joint.turned_round())
    links: list[Link] = []
    visited: set[int] = set()
    for root in (WORLD_INDEX, *range(mechanism.body_count)):
        if root in visited:
            continue
        visited.add(root)
        if root != WORLD_INDEX:
            links.append(Link(root, WORLD_INDEX, None))
        ways = [iter(at[root][::turn])]
        while ways:
            onwards = next((each for each in ways[-1] if each.child not in visited), None)
            if onwards is None:
                ways.pop()
                continue
            visited.add(onwards.child)
            links.append(Link(onwards.child, onwards.parent, onwards))
            ways.append(iter(at[onwards.child][::turn]))
    used = {link.joint.index for link in links if link.joint is not None}
    loops = tuple(joint for joint in mechanism.joints if joint.index not in used)
    return dataclasses.replace(mechanism, links=tuple(links), loops=loops)


def _work(mechanism: Mechanism) -> int:
    """Estimate the cost of closing the loops, in couplings."""
    number = {link.body: k for k, link in enumerate(mechanism.links)}
    world = len(number)
    parent = np.array([number.get(link.parent, world) for link in mechanism.links])
    ends = [((j.parent, j.child), _CLOSES[j.kind]) for j in mechanism.loops]
    ends += [(pair.bodies, _DISTANCE) for pair in mechanism.distances]
    each = [number.get(body, world) for pair, _ in ends for body in pair]
    pairs = np.array(each, dtype=np.int64).reshape(-1, 2)
    on, _ = _ways(parent, pairs, np.zeros(len(ends), dtype=bool))
    rows = [sum(ends[row][1] for row, _ in here) for here in on]
    return sum(count * (count + _PASSING) for count in rows)

"""Where closure rows are eliminated on the way to the roots, so that cost grows with links alone.

A row's load comes down the tree from its two ends. At the link where these meet nothing further
out can change it any more: it is eliminated there, and the link resists as if its loops were
closed. Rows that act on one link together are coupled, and so are those that an eliminated row was
coupled with. Few loops are open at once where a spanning tree goes along a mechanism and back, so
of several trees that is taken in which the least is to be done.
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
_DISTANCE = 1  # the same of a distance link
_PASSING = 8  # times a coupling: work that a row makes at a link by itself


class Elimination(NamedTuple):
    """What is done link by link; behind the links stands the world."""

    on_start: Index
    """Where the rows whose loads come through each link begin in the next three, (link + 1,)."""
    on_row: Index
    on_end: Index
    """Whose load comes through: `FIRST`, `SECOND`, or `BOTH`."""
    on_speed: Index
    """Where it is kept what the row does to the link's speeds."""
    on_pair: Index
    """Couplings of each of these rows with those before it on its link and itself, in turn."""
    pair_start: Index
    """Where those of each link begin, shape (link + 1,)."""
    drop: Index
    """Where the rows that are eliminated at each link and at the world begin in the next two, and
    where they end, shape (link + 1, 2)."""
    drop_row: Index
    near_start: Index
    """Where the rows that each is coupled with begin in the next three, shape (row + 1,)."""
    near_row: Index
    near_end: Index
    """Whose load comes through that link; `FIRST` where the row ends there."""
    near_pair: Index
    fill_start: Index
    """Where the couplings of these with those before them and themselves begin, (row + 1,)."""
    fill_pair: Index
    pair_row: Index
    """Rows of each coupling, shape (coupling, 2); those of rows with themselves come first."""
    speed_count: int


def plan_of(
    parent: Index, speeds: Index, ends: Index, coupled: Mask, *, kept: bool = False
) -> Elimination:
    """Plan the elimination of rows.

    Args:
        parent: Link that each link hangs from; children have the larger numbers.
        speeds: Number of each link's speeds.
        ends: Links of the rows' two ends, shape (2, row).
        coupled: Rows that act on the coordinates of these links, shape (row,).
        kept: Whether no row is eliminated: the couplings are those at the world then.
    """
    world, couplings = len(parent), _Couplings(ends.shape[1])
    on, leaving = _ways(parent, ends, coupled, kept)
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
    ways = [way for link in range(world) for way in on[link]]
    width = [int(speeds[link]) for link in range(world) for _ in on[link]]
    return Elimination(
        on_start=_starts(on[:world]),
        on_row=_column(ways, 0),
        on_end=_column(ways, 1),
        on_speed=np.cumsum([0, *width])[:-1],
        on_pair=_flat(pairs),
        pair_start=_starts(pairs),
        drop=drop,
        drop_row=np.array(dropped, dtype=np.int64),
        near_start=_starts(near),
        near_row=_column([each for rows in near for each in rows], 0),
        near_end=_column([each for rows in near for each in rows], 1),
        near_pair=_column([each for rows in near for each in rows], 2),
        fill_start=_starts(fill),
        fill_pair=_flat(fill),
        pair_row=np.array([*couplings.number], dtype=np.int64).reshape(-1, 2),
        speed_count=sum(width),
    )


class _Couplings:
    """Which rows are coupled, and the number of each coupling."""

    def __init__(self, count: int) -> None:
        self.near: list[set[int]] = [set() for _ in range(count)]
        self.number = {(k, k): k for k in range(count)}

    def pair(self, one: int, other: int) -> int:
        return self.number.setdefault((max(one, other), min(one, other)), len(self.number))

    def join(self, rows: list[int]) -> list[int]:
        """Couple rows with each other; give the numbers of these couplings, row by row."""
        for row in rows:
            self.near[row].update(other for other in rows if other != row)
        return [self.pair(one, other) for q, one in enumerate(rows) for other in rows[: q + 1]]

    def release(self, row: int) -> list[int]:
        """Give the rows that one is coupled with, and take it from them."""
        others = sorted(self.near[row])
        for other in others:
            self.near[other].discard(row)
        return others


def _ways(
    parent: Index, ends: Index, coupled: Mask, kept: bool = False
) -> tuple[list[list[tuple[int, int]]], list[list[int]]]:
    """Give the rows that come through each link, with their ends, and those eliminated there."""
    world = len(parent)
    on: list[list[tuple[int, int]]] = [[] for _ in range(world + 1)]
    leaving: list[list[int]] = [[] for _ in range(world + 1)]
    for row, pair in enumerate(ends.T.tolist()):
        first, second = (_path(parent, end) for end in pair)
        inner = [path[1:] if coupled[row] else path for path in (first, second)]
        meet = next((link for link in inner[0] if link in inner[1]), world)
        if not kept:
            leaving[meet].append(row)
        for link in {*first, *second}:
            if kept or link > meet or meet == world:
                sides = [side for side, path in enumerate((first, second)) if link in path]
                on[link].append((row, sides[0] if len(sides) == 1 else BOTH))
    return on, leaving


def _path(parent: Index, link: int) -> list[int]:
    """Links from one to its root."""
    found = []
    while link < len(parent):
        found.append(link)
        link = int(parent[link])
    return found


def _starts(lists: Sequence[Sequence[object]]) -> Index:
    return np.cumsum([0, *map(len, lists)])


def _flat(lists: list[list[int]]) -> Index:
    return np.array([each for one in lists for each in one], dtype=np.int64)


def _column(rows: Sequence[tuple[int, ...]], k: int) -> Index:
    return np.array([row[k] for row in rows], dtype=np.int64)


def with_short_loops(mechanism: Mechanism) -> Mechanism:
    """Give a mechanism the spanning tree in which closing its loops costs least.

    Besides its own these are the two that go as far as they can before they turn back, by the
    first joint of each body or the last. Joints with rotors, dry friction or couplings stay.
    """
    if not mechanism.loops:
        return mechanism
    trees = [mechanism, *(_far(mechanism, turn) for turn in (1, -1))]
    able = [t for t in trees if not any(joint.in_tree for joint in t.loops)]
    return min(able, key=_work)


def _far(mechanism: Mechanism, turn: int) -> Mechanism:
    """Follow joints from body to body, and turn back where all neighbours are known."""
    at: dict[int, list[PlacedJoint]] = defaultdict(list)
    for joint in mechanism.joints:
        at[joint.parent].append(joint)
        at[joint.child].append(joint.turned_round())
    links: list[Link] = []
    seen: set[int] = set()
    for root in (WORLD_INDEX, *range(mechanism.body_count)):
        if root in seen:
            continue
        seen.add(root)
        if root != WORLD_INDEX:
            links.append(Link(root, WORLD_INDEX, None))
        ways = [iter(at[root][::turn])]
        while ways:
            onwards = next((each for each in ways[-1] if each.child not in seen), None)
            if onwards is None:
                ways.pop()
                continue
            seen.add(onwards.child)
            links.append(Link(onwards.child, onwards.parent, onwards))
            ways.append(iter(at[onwards.child][::turn]))
    used = {link.joint.index for link in links if link.joint is not None}
    loops = tuple(joint for joint in mechanism.joints if joint.index not in used)
    return dataclasses.replace(mechanism, links=tuple(links), loops=loops)


def _work(mechanism: Mechanism) -> int:
    """Estimate what closing the loops costs, in couplings."""
    number = {link.body: k for k, link in enumerate(mechanism.links)}
    world = len(number)
    parent = np.array([number.get(link.parent, world) for link in mechanism.links])
    ends = [((j.parent, j.child), _CLOSES[j.kind]) for j in mechanism.loops]
    ends += [(pair.bodies, _DISTANCE) for pair in mechanism.distances]
    each = [number.get(body, world) for pair, _ in ends for body in pair]
    pairs = np.array(each, dtype=np.int64).reshape(-1, 2).T
    on, _ = _ways(parent, pairs, np.zeros(len(ends), dtype=bool))
    rows = [sum(ends[row][1] for row, _ in here) for here in on]
    return sum(count * (count + _PASSING) for count in rows)

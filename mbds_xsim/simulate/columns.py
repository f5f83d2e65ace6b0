"""Columns of an engine's coordinates and velocities that hold the motions of links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene.joint_space import LinkStates
from mbds_xsim.scene.mechanism import Mechanism


def link_kinds(mechanism: Mechanism) -> list[str]:
    """Return the kind of each link's joint, "free" without one."""
    return [link.joint.kind if link.joint else "free" for link in mechanism.links]


def links_of(kinds: Sequence[str], *some: str) -> Index:
    """Return the links of some kinds, kind by kind."""
    return np.array([k for one in some for k, kind in enumerate(kinds) if kind == one], np.int64)


class LinkColumns:
    """Conversion between links and an engine's coordinates and velocities, column by column.

    Hinges and sliders have one column each. Columns of what an engine has in another form than
    `LinkStates` are left out, or converted by the adapter.

    Args:
        kinds: Kind of each link, from `link_kinds` or an adapter's own.
        first: First columns of each link, among coordinates and velocities; any without columns.
        sizes: Numbers of coordinates and of velocities.
        turn: Offset of the quaternions from the first column, by kind.
        spin: The same of the angular velocities.
        shift: Offsets of free bodies' positions and velocities.
        order: Places of w, x, y and z in a quaternion.
    """

    def __init__(
        self,
        kinds: Sequence[str],
        first: tuple[Index, Index],
        sizes: tuple[int, int],
        *,
        turn: Mapping[str, int],
        spin: Mapping[str, int],
        shift: tuple[int, int],
        order: Sequence[int] = (0, 1, 2, 3),
    ) -> None:
        self._sizes, self._count = sizes, len(kinds)
        scalar = {"hinge": 0, "slider": 0}
        self._places = [
            (side, field, links, first[side][links, None] + offset + np.array(parts))
            for side, field, offsets, parts in (
                (0, "coordinate", scalar, (0,)),
                (1, "rate", scalar, (0,)),
                (0, "rotation", turn, order),
                (1, "angular_velocity", spin, (0, 1, 2)),
                (0, "position", {"free": shift[0]}, (0, 1, 2)),
                (1, "velocity", {"free": shift[1]}, (0, 1, 2)),
            )
            for kind, offset in offsets.items()
            if len(links := links_of(kinds, kind))
        ]

    def of_links(self, links: LinkStates) -> tuple[Array, Array]:
        """Return coordinates (…, nq) and velocities (…, nv), 0 where no link has its own."""
        q, u = (np.zeros((*links.coordinate.shape[:-1], size)) for size in self._sizes)
        for side, field, rows, at in self._places:
            (q, u)[side][..., at] = _parts(links, field)[..., rows, :]
        return q, u

    def to_links(self, q: Array, u: Array) -> LinkStates:
        """Convert coordinates (…, nq) and velocities (…, nv) to states of links."""
        links = LinkStates.still((*q.shape[:-1], self._count))
        for side, field, rows, at in self._places:
            _parts(links, field)[..., rows, :] = (q, u)[side][..., at]
        return links


def _parts(links: LinkStates, field: str) -> Array:
    values: Array = getattr(links, field)
    return values[..., None] if field in ("coordinate", "rate") else values

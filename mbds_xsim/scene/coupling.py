"""A gear: a joint whose coordinate follows that of another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError

if TYPE_CHECKING:
    from mbds_xsim.scene.mechanism import PlacedJoint

Finite = Annotated[float, bounds.finite]


class Coupling(Neutral):
    """A rigid massless gear: coordinate = `ratio` · coordinate of another joint + `offset`."""

    joint: str
    """Hinge or slider that follows; it can follow only one joint."""
    follows: str
    """Hinge or slider that is followed."""
    ratio: Finite = 1.0
    """Coordinate change per change of the other: [rad/rad], [rad/m], [m/rad] or [m/m]; not 0."""
    offset: Finite = 0.0
    """Coordinate when the other joint's is 0 [rad or m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ratio == 0:
            msg = f"coupling of {self.joint!r}: got the ratio 0, allowed is any other number"
            raise SceneError(msg)

    @property
    def name(self) -> str:
        """Name that describes the coupling."""
        return f"{self.joint} follows {self.follows}"


@dataclass(frozen=True, eq=False)
class PlacedCoupling:
    """A coupling between two placed joints of the spanning tree."""

    name: str
    follower: PlacedJoint
    leader: PlacedJoint
    ratio: float
    offset: float


def trains(couplings: Iterable[PlacedCoupling]) -> dict[str, list[PlacedCoupling]]:
    """Return what each joint leads: a coupling of every joint that follows it, also by a chain.

    Couplings of a chain are replaced by those of each of its joints with the first, which follows
    none: b = r a + o and c = s b + p make c = r s a + (p + s o).
    """
    above, whole = {each.follower.name: each for each in couplings}, dict[str, PlacedCoupling]()
    led = defaultdict(list)
    for name in above:
        chain = [name]
        while (up := above[chain[-1]].leader.name) in above and chain[-1] not in whole:
            chain.append(up)
        for each in reversed(chain):
            own = above[each]
            if lead := whole.get(own.leader.name):
                offset, ratio = own.offset + own.ratio * lead.offset, own.ratio * lead.ratio
                own = replace(own, leader=lead.leader, ratio=ratio, offset=offset)
            whole[each] = own
        led[whole[name].leader.name].append(whole[name])
    return dict(led)


def check_couplings(couplings: tuple[Coupling, ...]) -> None:
    """Raise SceneError if a joint follows several others or, through a chain, itself."""
    leaders: dict[str, str] = {}
    for k, coupling in enumerate(couplings):
        if coupling.joint in leaders:
            fault = f"couplings[{k}].joint: got {coupling.joint!r} again"
            raise SceneError(f"{fault}, allowed is one coupling for each joint")
        leaders[coupling.joint] = leader = coupling.follows
        while leader in leaders and leader != coupling.joint:
            leader = leaders[leader]
        if leader == coupling.joint:
            fault = f"couplings[{k}].follows: got {coupling.follows!r}"
            raise SceneError(f"{fault}, so {coupling.joint!r} would follow itself")
        leaders[coupling.joint] = leader  # the last of the chain, which later ones need not go down

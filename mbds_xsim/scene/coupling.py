"""A gear: a joint whose coordinate follows that of another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError

if TYPE_CHECKING:
    from mbds_xsim.scene.mechanism import PlacedJoint

Finite = Annotated[float, bounds.finite]


class Coupling(Neutral):
    """A rigid gear without mass: coordinate = `ratio` times that of another joint + `offset`."""

    joint: str
    """A hinge or slider, which follows one other at most."""
    follows: str
    """Another one."""
    ratio: Finite = 1.0
    """Coordinate per coordinate of the other: [rad/rad], [rad/m], [m/rad] or [m/m]; not 0."""
    offset: Finite = 0.0
    """Coordinate where the other's is 0 [rad or m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ratio == 0:
            msg = f"coupling of {self.joint!r}: got the ratio 0, allowed is any other number"
            raise SceneError(msg)

    @property
    def name(self) -> str:
        """Name it by what it does."""
        return f"{self.joint} follows {self.follows}"


@dataclass(frozen=True, eq=False)
class PlacedCoupling:
    """A joint of the spanning tree whose coordinate follows another's."""

    name: str
    follower: PlacedJoint
    leader: PlacedJoint
    ratio: float
    offset: float


def check_couplings(couplings: tuple[Coupling, ...]) -> None:
    """Raise SceneError where a joint follows several others, or, in the end, itself."""
    followed: dict[str, str] = {}
    for k, coupling in enumerate(couplings):
        if coupling.joint in followed:
            got = f"couplings[{k}].joint: got {coupling.joint!r} again"
            raise SceneError(f"{got}, allowed is that a joint follows one other")
        followed[coupling.joint] = at = coupling.follows
        while at in followed and at != coupling.joint:
            at = followed[at]
        if at == coupling.joint:
            got = f"couplings[{k}].follows: got {coupling.follows!r}"
            raise SceneError(f"{got}, by which {coupling.joint!r} follows itself")

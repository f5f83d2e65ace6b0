"""The ground's restitution and friction, from all impacts of a run together.

An engine has one law of impact for all (see `eccentric`), and what its steps leave of it differs
from impact to impact. So their mean tells the coefficients far better than any of them does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.checks.course import course_of
from mbds_xsim.checks.finding import Finding, Record
from mbds_xsim.checks.ground import pushes_of
from mbds_xsim.checks.impacts import Impacts, fast_impacts_of

Array = NDArray[np.float64]

_ENOUGH = 8  # impacts; fewer tell nothing
_SEEN = 2.0  # impacts with full slip, at least, for friction
_ERRORS = 4.0  # standard errors
_RESTITUTION = 0.02  # that springs of a few steps leave (MuJoCo: 9e-3)
_FRICTION = 0.03  # of μ, the same (MuJoCo: 1.5e-2)
_MORE = 0.05  # friction by which the law is differentiated, as a share
_SLIPS = 0.05  # of the arriving speed: a rebound with less slip may have stuck
_BLUR = 3e-3  # of the arriving speed, below which a rebound is as good as explained


@dataclass(frozen=True, eq=False)
class Shown:
    """What impacts show, by the rigid and by the compliant law; axes are (law, impact)."""

    restitution: Array
    """Above the scene's."""
    weight: Array
    """What an impact counts."""
    product: Array
    """Of what the law leaves of friction, with what a larger μ would add."""
    square: Array
    """Of what a larger μ would add."""

    @property
    def known(self) -> Shown:
        """Those of which every number is finite."""
        values = list(vars(self).values())
        finite = np.isfinite(values).all(axis=(0, 1))
        return Shown(*(value[:, finite] for value in values))

    @staticmethod
    def joined(parts: list[Shown]) -> Shown:
        """Put the impacts of several groups of bodies or trajectories together."""
        fields = ("restitution", "weight", "product", "square")
        return Shown(*(np.concatenate([getattr(p, k) for p in parts], axis=1) for k in fields))


@dataclass(frozen=True)
class Pool:
    """The coefficients that impacts show together, as deviations from the scene's."""

    impacts: int
    law: str
    restitution: float
    restitution_allowed: float
    friction: float
    """As a share of μ."""
    friction_allowed: float

    @staticmethod
    def of(shown: Shown) -> Pool | None:
        """Average by the law that impacts scatter less about; None with few impacts.

        What a law cannot follow, such as an impact in which it does no work, is left out.
        """
        shown = shown.known
        count = shown.weight.shape[1]
        if count < _ENOUGH:
            return None
        total = shown.weight.sum(axis=1)
        mean = (shown.weight * shown.restitution).sum(axis=1) / total
        off = shown.weight * (shown.restitution - mean[:, None])
        error = np.sqrt((off**2).sum(axis=1)) / total
        square = shown.square.sum(axis=1)
        seen = square > _SEEN
        share = np.where(seen, shown.product.sum(axis=1) / np.maximum(square, _SEEN), 0.0)
        left = shown.product - share[:, None] * shown.square
        spread = np.where(seen, np.sqrt((left**2).sum(axis=1)) / np.maximum(square, _SEEN), np.inf)
        k = int((error * spread if seen.all() else error).argmin())
        return Pool(
            impacts=count,
            law=("rigid", "compliant")[k],
            restitution=float(mean[k]),
            restitution_allowed=float(_RESTITUTION + _ERRORS * error[k]),
            friction=float(share[k]),
            friction_allowed=float(_FRICTION + _ERRORS * spread[k]),
        )

    @property
    def used(self) -> tuple[float, float]:
        """Restitution and friction over what is allowed."""
        return (
            abs(self.restitution) / self.restitution_allowed,
            abs(self.friction) / self.friction_allowed,
        )

    def __str__(self) -> str:
        return (
            f"{self.impacts} impacts by the {self.law} law: restitution off by "
            f"{self.restitution:+.4f}, allowed {self.restitution_allowed:.4f}; friction by a share "
            f"of {self.friction:+.4f}, allowed {self.friction_allowed:.4f}"
        )


def impact_coefficients(record: Record) -> Finding | None:
    """Compare the coefficients that all impacts of a run show together with the scene's.

    Deviations over what is allowed: 0.02 of restitution and a share of 0.03 of friction, with four
    standard errors. None where less than eight impacts beside centres of mass are seen.
    """
    shown = shown_of(record)
    pool = None if shown is None else Pool.of(shown)
    if pool is None:
        return None
    parts = record.at_end(np.broadcast_to(pool.used, (len(record.finite), 2)))
    names = ("restitution", "friction")
    return Finding.of("impact coefficients", "1", parts, budget=1.0, names=names, note=str(pool))


def shown_of(record: Record) -> Shown | None:
    """Collect what the impacts of all groups that are no balls show; None without such groups."""
    groups = [push for push in pushes_of(record) if not push.ball]
    if not groups:
        return None
    return Shown.joined([_shown(record, fast_impacts_of(record, push)) for push in groups])


def _shown(record: Record, hits: Impacts) -> Shown:
    laws = (_by_rigid(record, hits), _by_compliant(record, hits))
    return Shown(*(np.stack(values) for values in zip(*laws, strict=True)))


def _by_rigid(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """Friction is known of impacts that leave a slip, which it opposes."""
    ground = record.ground
    speed = np.linalg.norm(hits.rebound, axis=1)
    slips = (speed > _SLIPS * hits.arriving).astype(float)
    against = -hits.rebound / np.maximum(speed, np.finfo(float).tiny)[:, None]
    along = np.einsum("ki,ki->k", hits.impulse[:, :2], against)
    share = along / ((ground.friction or 1.0) * hits.impulse[:, 2]) - 1.0
    delivered = hits.leaving / hits.arriving
    return delivered - ground.restitution, np.ones(len(speed)), slips * share, slips


def _by_compliant(record: Record, hits: Impacts) -> tuple[Array, Array, Array, Array]:
    """The share of the rebound that the course does not explain is no restitution."""
    ground, mu = record.ground, record.ground.friction
    course, more = (course_of(record, hits, share * mu) for share in (1.0, 1.0 + _MORE))
    most = (mu or 1.0) * hits.impulse[:, 2:]
    left = (hits.impulse[:, :2] - course.friction) / most
    adds = (more.friction - course.friction) / (_MORE * most)
    blur = (course.velocity[:, 2] - hits.leaving) / hits.arriving
    return (
        course.restitution - ground.restitution - blur,
        1.0 / (blur**2 + _BLUR**2),
        np.einsum("ki,ki->k", left, adds),
        np.einsum("ki,ki->k", adds, adds),
    )

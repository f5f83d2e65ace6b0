"""What a check finds, and what it is given to look at."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.base.text import apart
from mbds_xsim.checks.coordinates import clear_of_stops
from mbds_xsim.checks.mismatch import EVERY_SECOND, Mismatch, mismatch_of, steady
from mbds_xsim.checks.spheres import Spheres, spheres_of
from mbds_xsim.scene.joint_space import BodyStates
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Ground, Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate.claims import Method

if TYPE_CHECKING:
    from mbds_xsim.checks.balance_kernel import Masses
    from mbds_xsim.checks.motion_kernel import FlatMotion

_EARTH = 9.81


@dataclass(frozen=True, eq=False)
class Record:
    """A batch with the motion that was recorded for it, as the checks read it."""

    scene: Scene
    batch: Batch
    trajectory: Trajectory
    method: Method | None = None
    """How it was made; None: unknown, as for a file from elsewhere."""
    step: float | None = None
    """Integration step [s]; None: the frame interval."""
    contact_time: float | None = None
    """Over which the engine declares to spread an impact [s]; None: unknown."""
    steps_compared: tuple[int, int] = EVERY_SECOND
    """First step, and every how many, over which displacements are held against velocities."""
    many: bool = False
    """Whether compiled kernels do what they can, which pays over thousands of trajectories; these
    have finite numbers only, and nothing meets the ground or a stop."""

    @functools.cached_property
    def mechanism(self) -> Mechanism:
        """The scene as arrays."""
        return Mechanism.of(self.scene)

    @functools.cached_property
    def finite(self) -> Mask:
        """Frames before the first number that is not finite, shape (trajectory, frame)."""
        if self.trajectory.finite.all():
            return np.ones(self.trajectory.position.shape[:2], dtype=bool)
        each = [np.isfinite(field).all(axis=(2, 3)) for field in vars(self._states).values()]
        return np.logical_and.accumulate(np.logical_and.reduce(each), axis=1)

    @functools.cached_property
    def _states(self) -> BodyStates:
        return BodyStates.of(self.mechanism, self.trajectory).each(np.asfortranarray)

    @functools.cached_property
    def bodies(self) -> BodyStates:
        """States with native rotations, NaN from the first frame that is not finite.

        In memory components are apart, then bodies, then frames: numpy has long rows to work on.
        """
        if self.finite.all():
            return self._states
        keep = self.finite[:, :, None, None]
        return self._states.each(lambda values: np.where(keep, values, np.nan))

    @functools.cached_property
    def motion(self) -> FlatMotion:
        """The same as kernels read it, of eight trajectories at least, some of them repeated."""
        from mbds_xsim.checks.motion_kernel import FlatMotion  # imports a compiler
        from mbds_xsim.reference.lanes import LANES

        fields, count = [*vars(self.bodies).values(), self.force], len(self.batch)
        if count < LANES:
            rows = np.resize(np.arange(count), LANES)
            fields, count = [np.asfortranarray(values[rows]) for values in fields], LANES
        frames, bodies = fields[0].shape[1:3]
        flat = (values.T.reshape(-1) for values in fields)
        return FlatMotion._make([*flat, bodies, frames, count])

    @property
    def masses(self) -> Masses:
        """What resists, as kernels read it."""
        from mbds_xsim.checks.balance_kernel import Masses  # imports a compiler

        mechanism = self.mechanism
        return Masses(mechanism.mass, mechanism.inertia, np.array(self.scene.gravity))

    @functools.cached_property
    def world(self) -> BodyStates:
        """The same with the world as a last body."""
        return self.bodies.with_world()

    @functools.cached_property
    def moved(self) -> Array:
        """Displacements of the centres of mass in each step [m], (trajectory, step, body, 3)."""
        return np.diff(self.bodies.position, axis=1)

    @functools.cached_property
    def force(self) -> Array:
        """Held forces [N], shape (trajectory, step, body, 3), laid out as the bodies."""
        return np.asfortranarray(self.batch.force[:, : self.steps])

    @functools.cached_property
    def torque(self) -> Array:
        """Held torques of hinges, and behind them pushes of drives, (trajectory, step, input)."""
        return with_pushes(self.mechanism.drives, self.batch.torque)

    @functools.cached_property
    def spheres(self) -> Spheres:
        """The contact spheres, shape (trajectory, frame, sphere)."""
        return spheres_of(self.mechanism, self.bodies)

    @functools.cached_property
    def clear(self) -> Mask:
        """Steps in which a contact sphere cannot reach the ground, (trajectory, step, sphere).

        At both ends it must be higher than it would fall, at its own speed and at what gravity and
        the body's rotation add to it, in a whole frame.
        """
        mechanism, frame = self.mechanism, self.frame
        spin = self.bodies.angular_velocity[:, :, mechanism.sphere_body]
        reach = np.linalg.norm(mechanism.sphere_offset, axis=-1)
        pull = self.pull + np.sum(spin**2, axis=-1) * reach
        high = self.spheres.gap > frame * (np.abs(self.spheres.climb) + frame * pull)
        return np.asarray(high[:, 1:] & high[:, :-1])

    def flying(self, group: tuple[int, ...] | None = None) -> Mask:
        """Find the steps in which no sphere of a group (or of all) can reach the ground.

        And no joint that holds the group on the world (or none at all) a stop; (trajectory, step).
        """
        owner = self.mechanism.sphere_body
        own = np.ones(len(owner), dtype=bool) if group is None else np.isin(owner, group)
        touching_nothing = self.clear[:, :, own].all(axis=2)
        return touching_nothing & clear_of_stops(self.mechanism, self.world, self.frame, group)

    @functools.cached_property
    def spin(self) -> Array:
        """Angular velocities in the native frames [rad/s], shape (trajectory, frame, body, 3)."""
        back = rotation.conjugate(self.bodies.native)
        return rotation.rotate(back, self.bodies.angular_velocity)

    @functools.cached_property
    def turning(self) -> Array:
        """Angular momenta about centres of mass in the native frames [kg·m²/s], shape as spin."""
        inertia, (x, y, z) = self.mechanism.inertia, np.moveaxis(self.spin, -1, 0)
        found = np.empty_like(self.spin)
        for k, row in enumerate(np.moveaxis(inertia, 1, 0)):  # einsum takes four times as long
            np.add(row[:, 0] * x + row[:, 1] * y, row[:, 2] * z, out=found[..., k])
        return found

    @functools.cached_property
    def mismatch(self) -> Mismatch:
        """What positions do between frames that velocities do not tell, outside contact."""
        return mismatch_of(
            self.mechanism,
            self.bodies,
            self.batch.force,
            self.torque,
            self.flying() & steady(self.mechanism, self.world, self.torque),
            frame=self.frame,
            lag=self.lag,
            steps=self.steps_compared,
            many=self.many,
        )

    def by_step(self, parts: Sequence[Array]) -> Array:
        """Put values of steps at the frames at their ends, 0 at the first: (…, frame, part)."""
        found = self._filled(0.0, len(parts))
        for k, part in enumerate(parts):
            found[:, 1:, k] = part
        return found

    def by_frame(self, parts: Sequence[Array]) -> Array:
        """Put values of frames side by side, shape (trajectory, frame, part)."""
        found = self._filled(0.0, len(parts))
        for k, part in enumerate(parts):
            found[..., k] = part
        return found

    def at_end(self, values: Array) -> Array:
        """Put values of trajectories at their last finite frames, (trajectory, frame, part)."""
        found = self._filled(np.nan, values.shape[-1])
        last = np.maximum(self.finite.sum(axis=1) - 1, 0)
        found[np.arange(len(found)), last] = values
        return found

    def _filled(self, value: float, parts: int) -> Array:
        """Make an array of shape (trajectory, frame, part), with the parts apart in memory."""
        return np.full((parts, *self.finite.T.shape), value).T

    @property
    def ground(self) -> Ground:
        """The ground of a scene that has one."""
        assert self.scene.ground is not None
        return self.scene.ground

    @property
    def pull(self) -> float:
        """Size of gravity [m/s²]."""
        return float(np.linalg.norm(self.scene.gravity))

    @property
    def usual_pull(self) -> float:
        """The same, but the earth's in scenes without: it sets scales there [m/s²]."""
        return self.pull or _EARTH

    @property
    def fall(self) -> float:
        """Speed that gravity adds in a frame [m/s]."""
        return self.frame * self.pull

    @property
    def lag(self) -> float:
        """Recorded velocities belong to frame time + lag, as the method declares [s]."""
        if self.method is None or self.step is None:
            return 0.0
        return self.method.velocity_lag * self.step

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return len(self.trajectory.time) - 1

    @property
    def frame(self) -> float:
        """Interval between frames [s]."""
        return self.scene.clock.frame

    @property
    def order(self) -> int:
        """Order of convergence that the method claims for the scene; 1 where none is known."""
        return 1 if self.method is None else self.method.order_for(self.scene)

    @property
    def energy_budget(self) -> float:
        """Budget of conserved quantities, relative, by the method's order."""
        budget = self.scene.budget
        return budget.energy if self.order >= 2 else budget.energy_first_order


class Figures(NamedTuple):
    """What a check calculates."""

    parts: Array
    """Values of several parts, named alike, shape (trajectory, frame, part)."""
    names: Iterable[str] = ()
    note: str = ""
    uncertainty: Array | float = 0.0
    """As in `Finding`."""


@dataclass(frozen=True)
class Check:
    """A check, which is called with a record."""

    calculate: Callable[[Record], Figures | None]
    name: str
    budget: str | float | Callable[[Record], float] | None
    unit: str

    def __call__(self, record: Record) -> Finding | None:
        """Give the finding on a record; None where there is no part to look at."""
        found = self.calculate(record)
        if found is None or not found.parts.shape[-1]:
            return None
        budget = self.budget
        if isinstance(budget, str):
            budget = float(getattr(record.scene.budget, budget))
        return Finding.of(
            self.name,
            self.unit,
            found.parts,
            budget=budget(record) if callable(budget) else budget,
            names=tuple(found.names),
            uncertainty=found.uncertainty,
            note=found.note,
        )

    def finding(self, record: Record) -> Finding:
        """Give the finding on a record that has something for the check to look at."""
        found = self(record)
        assert found is not None, f"{self.name} does not apply to {record.scene.name}"
        return found


def check(
    name: str, budget: str | float | Callable[[Record], float] | None, unit: str = "1"
) -> Callable[[Callable[[Record], Figures | None]], Check]:
    """Make a check of what calculates its figures.

    Args:
        name: As reports call it.
        budget: What the figure may reach: a field of the scene's budget, a number, or what gives
            it for a record; None: shown, not judged.
        unit: Of the figure.
    """
    return lambda calculate: Check(calculate, name, budget, unit)


@dataclass(frozen=True, eq=False)
class Finding:
    """One check on all trajectories of a batch."""

    check: str
    unit: str
    series: Array
    """What the check measures, 0 is ideal; NaN where there is nothing to see; shape (trajectory,
    frame)."""
    budget: float | None
    """What the figure may reach; None: shown, not judged."""
    uncertainty: Array
    """What the check itself cannot resolve, added to the budget; shape (trajectory,)."""
    where: tuple[str, ...]
    """Which joint, body or component the worst value belongs to, one a trajectory."""
    applies: Mask
    """Trajectories that the check is about, shape (trajectory,); others have no figure and pass."""
    note: str = ""

    @staticmethod
    def of(
        check: str,
        unit: str,
        parts: Array,
        *,
        budget: float | None,
        names: tuple[str, ...] = (),
        uncertainty: Array | float = 0.0,
        note: str = "",
    ) -> Finding:
        """Make a finding from values of several parts, named alike, (trajectory, frame, part)."""
        highest = np.fmax.reduce(parts, axis=1)
        worst = np.where(np.isnan(highest), -np.inf, highest).argmax(axis=1)
        return Finding(
            check,
            unit,
            # Part by part: reductions along a short axis are several times slower.
            functools.reduce(np.fmax, np.moveaxis(parts, -1, 0)),
            budget,
            np.broadcast_to(np.asarray(uncertainty, dtype=np.float64), len(parts)),
            tuple(names[k] if names else "" for k in worst),
            np.ones(len(parts), dtype=bool),
            note,
        )

    def among(self, rows: Mask) -> Finding:
        """Give a finding on some trajectories of a batch as one on the batch."""
        whole = np.full((len(rows), self.series.shape[1]), np.nan)
        whole[rows] = self.series
        uncertainty, where = np.zeros(len(rows)), np.full(len(rows), "", dtype=object)
        uncertainty[rows], where[rows] = self.uncertainty, self.where
        return replace(
            self, series=whole, uncertainty=uncertainty, where=tuple(where), applies=rows
        )

    @functools.cached_property
    def figure(self) -> Array:
        """Worst over the frames, NaN where there is none; shape (trajectory,)."""
        return np.take_along_axis(self.series, self.frame[:, None], axis=1)[:, 0]

    @functools.cached_property
    def frame(self) -> Index:
        """Frame of the worst value, shape (trajectory,)."""
        return np.where(np.isnan(self.series), -np.inf, self.series).argmax(axis=1)

    @functools.cached_property
    def passed(self) -> Mask:
        """Whether the figure keeps its budget; a trajectory without a figure does not."""
        if self.budget is None:
            return np.ones(len(self.figure), dtype=bool)
        return (self.figure <= self.budget + self.uncertainty) | ~self.applies

    def line(self, row: int) -> str:
        """Say in a line what a trajectory has of what is allowed."""
        allowed = np.inf if self.budget is None else self.budget
        figure, budget = apart(self.figure[row], allowed, lambda x, n: f"{x:.{n}g}", 3)
        where = f" ({self.where[row]})" if self.where[row] else ""
        return f"{self.check}: {figure} {self.unit}, allowed {budget}{where}"

    @property
    def worst(self) -> int:
        """Row of the trajectory that comes off worst: no figure at all, else the largest."""
        excess: NDArray[Any] = self.figure - self.uncertainty
        excess = np.where(np.isnan(excess), np.inf, excess)
        return int(np.where(self.applies, excess, -np.inf).argmax())

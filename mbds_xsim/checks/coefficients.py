"""Do inputs, gravity and masses count as much as the scene says?

In a step outside contact energy changes by the work of the inputs, and by nothing else. Were an
input, gravity or a mass otherwise by a share ε, the step's balance would be off by -ε times its
part in it. So what is left of the balances is regressed on each part. What a method leaves of its
own hardly looks like any of them, so that shares show that are far below the budget of energy.

A wrong model is wrong in all trajectories that it makes. Shares of single trajectories are averaged
by what they are known to, and single steps of all trajectories with one another, so that what a
chaotic motion hides shows in a shard.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.conservation import energy_of, flights_of, gain_of, input_work, work_of_forces
from mbds_xsim.checks.coordinates import coordinate_of, hinge_rates, hinge_turns
from mbds_xsim.checks.eccentric import Pool, Shown, shown_of
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.flights import numbers
from mbds_xsim.checks.integrity import pair_distance, pair_rate
from mbds_xsim.checks.joint_work import delayed_springs, losses
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import joint_rate

SURE = 3e-3
"""Share that methods and solvers may leave."""

_ERRORS = 6.0  # standard errors (measured: 3.0)
_ERRORS_OF_BODIES = 20.0  # the same of a single mass: what methods leave is most like these (12.6)
_LIGHT = 1e-5  # of all mass: what methods leave looks like more or less of so small a part of it
_OWN = 1e-3  # of a body's exchange of kinetic and potential energy
_LATE = 0.03  # of a step, by which methods of order 1 take what bodies exchange (measured: 7e-3)
_ALONE = 0.5  # of what a body gains, that at least something else must lose
_UNKNOWN = 0.5  # of a step, by which velocities of an unknown method may lag
_FEW = 10.0  # steps that count; fewer tell nothing
_NEAR = 4  # steps to either side that tell how well a step is balanced
_CLOSE = 3  # the same, of a single step
_FAINT = 1e-9  # of the largest, below which what is left over is rounding
_SEEN = 6.0  # times what neighbours leave: less of an input is not looked for in a single step
_NONE = 3.0  # times nearer to no input than to the input
_ENOUGH = 4  # trajectories
_SHARPEST = 1e-4  # standard error; no trajectory counts for more
_HALF = 0.5  # of the inputs of a step, at least, that must be missing


@dataclass(frozen=True, eq=False)
class BalancePart:
    """A part of the steps' balances: inputs, gravity or a mass."""

    name: str
    share: Array
    """By which it counts otherwise than it should [1], shape (trajectory,)."""
    error: Array
    """Standard error of the share."""
    counting: Array
    """Number of steps that count."""
    errors: float
    """Standard errors that are no finding."""

    @property
    def known(self) -> Mask:
        """Whether enough steps count."""
        return np.asarray(self.counting >= _FEW)


@check("coefficients", 1.0)
def coefficients(record: Record) -> Figures | None:
    """Measure by how much inputs, gravity and masses count otherwise than they should.

    Over what is allowed: 3e-3 and some standard errors of the regression. Inputs are those of the
    frame, and besides of the one before and after. In single steps it is measured how much nearer
    energy and momentum come to a motion without its inputs. None where nothing flies.
    """
    if record.steps < 1 or not record.flying().any():
        return None
    parts = parts_of(record)
    sure = SURE
    if record.method is None or record.step is None:
        sure += _UNKNOWN * (record.step or record.frame) / record.frame
    allowed = [sure + part.errors * part.error for part in parts]
    shares = [
        np.where(part.known, np.abs(part.share) / most, 0.0)
        for part, most in zip(parts, allowed, strict=True)
    ]
    ends = record.at_end(np.stack(shares, axis=-1))
    found = np.concatenate([ends, record.by_step([steps_of(record).nearer / _NONE])], axis=-1)
    found[~record.finite] = np.nan
    seen = [f"{part.name} {np.median(most):.2g}" for part, most in zip(parts, allowed, strict=True)]
    note = f"allowed in half of the trajectories: {', '.join(seen[:2] + seen[3:])}"
    return Figures(found, [*(part.name for part in parts), "inputs of a step"], note)


@functools.lru_cache(maxsize=1)
def parts_of(record: Record) -> list[BalancePart]:
    """Regress what is left of the balances on each part of them.

    The inputs' part is that of energy and of the momenta that no support touches, others that of
    energy alone.
    """
    left, weight = _weighed(_timely(record, _left(record))[..., None])
    here = _work(record, 0)
    products = weight * left[..., 0] * here
    squares = weight * here**2
    for balance, flights in flights_of(record):
        gain = gain_of(record, balance)
        rest, counts = _weighed(np.where(flights[..., None], gain.left, np.nan))
        products += counts * np.einsum("tsc,tsc->ts", rest, gain.given)
        squares += counts * np.einsum("tsc,tsc->ts", gain.given, gain.given)
    found = [_part("inputs", products, squares, _ERRORS)]
    for name, part, errors, faint in _parts(record, here, left):
        vague = weight * np.abs(part) * faint
        found.append(_part(name, weight * left[..., 0] * part, weight * part**2, errors, vague))
    return found


def _timely(record: Record, left: Array) -> Array:
    """Take off what springs lose, or gain, that a method of first order takes a step off."""
    if record.order > 1 or not record.step:
        return left
    lost = delayed_springs(record)
    seen = np.isfinite(left) & np.isfinite(lost)
    product, square = (np.where(seen, lost * other, 0.0).sum(axis=1) for other in (left, lost))
    delay = product / np.maximum(square, np.finfo(float).tiny)
    return left - np.clip(delay, -record.step, record.step)[:, None] * lost


def _weighed(left: Array) -> tuple[Array, Array]:
    """What is left of a balance, 0 where it does not hold, and what a step counts, (…, step)."""
    known = np.asarray(np.isfinite(left).all(axis=-1))
    left = np.where(known[..., None], left, 0.0)
    size = np.einsum("tsc,tsc->ts", left, left)
    near = _around(size, _NEAR) / np.maximum(_around(known.astype(float), _NEAR), 1.0)
    floor = np.maximum(_FAINT * np.max(size, axis=1, keepdims=True), np.finfo(float).tiny)
    return left, known / np.maximum(near, floor)


def _part(
    name: str, products: Array, squares: Array, errors: float, vague: Array | float = 0.0
) -> BalancePart:
    """Sum up a part's products with what is left, and its squares, of all steps.

    Taken off the share is what may be left of other parts.
    """
    products, squares = numbers(products), numbers(squares)
    total = np.maximum(squares.sum(axis=1), np.finfo(float).tiny)
    share = -products.sum(axis=1) / total
    rest = np.sqrt(np.sum((products + share[:, None] * squares) ** 2, axis=1))
    of_all = squares / total[:, None]
    counting = of_all.any(axis=1) / np.maximum(np.sum(of_all**2, axis=1), np.finfo(float).eps)
    beside = numbers(np.broadcast_to(vague, squares.shape)).sum(axis=1) / total
    share = np.sign(share) * np.maximum(np.abs(share) - beside, 0.0)
    return BalancePart(name, share, rest / total, np.asarray(counting), errors)


def _parts(
    record: Record, here: Array, left: Array
) -> Iterator[tuple[str, Array, float, Array | float]]:
    """Names of other parts, what they give in each step [J], and errors that are no finding.

    And what a method may leave of all that bodies, rotors, springs and dampers exchange, which a
    part may look like [J].

    Args:
        record: Of the motion.
        here: Work of the inputs in each step [J].
        left: Of the balance of each step [J], shape (trajectory, step, 1).
    """
    yield "inputs a frame late", _work(record, -1) - here, _ERRORS, 0.0
    yield "inputs a frame early", _work(record, 1) - here, _ERRORS, 0.0
    bodies = record.mechanism.body_count
    every = energy_of(record)
    energy = every.by_body
    change = np.diff(energy, axis=1)
    moving, lifted = change[..., :bodies], change[..., bodies:]
    faint = _FAINT * every.scale[:, None]
    gravity = lifted.sum(axis=-1)
    late = _LATE * (record.step or 0.0) / record.frame if record.order == 1 else 0.0
    exchanged = np.concatenate([energy, every.others, losses(record)[0][..., None]], axis=-1)
    exchange = late * np.abs(np.diff(exchanged, axis=1)).sum(axis=-1)
    yield "gravity", np.where(np.abs(gravity) < faint, 0.0, gravity), _ERRORS, exchange
    # A body that keeps its own energy tells nothing of its mass: what changes is the method's.
    least = np.maximum(_OWN * (np.abs(moving) + np.abs(lifted)), faint[..., None])
    whole = np.where(np.abs(moving + lifted) < least, 0.0, moving + lifted)
    # Nor does one that gains what nothing else loses: however heavy, it should not.
    whole = np.where(np.abs(left - whole) < _ALONE * np.abs(whole), 0.0, whole)
    mass = record.mechanism.mass
    for k in np.flatnonzero(mass >= _LIGHT * mass.sum()):
        yield f"mass of {record.scene.bodies[k].name}", whole[..., k], _ERRORS_OF_BODIES, exchange


def _work(record: Record, shift: int) -> Array:
    """Work of the inputs of other frames in each step [J], shape (trajectory, step)."""
    if shift == 0:
        return np.diff(input_work(record), axis=1)
    work = work_of_forces(record)[1 + shift]
    if record.mechanism.hinges:
        frames = np.clip(np.arange(record.steps) + shift, 0, record.steps - 1)
        work = work + np.einsum("tsh,tsh->ts", record.batch.torque[:, frames], hinge_turns(record))
    return work


def _left(record: Record) -> Array:
    """Energy that each step gains beside its inputs [J], NaN in contact, (trajectory, step).

    Energies of lagging velocities lag by the powers of what acts in the step.
    """
    energy = energy_of(record).total + losses(record)[0] - input_work(record)
    left = np.diff(energy, axis=1)
    if record.lag:
        left = left - record.lag * _power_gained(record)
    return np.where(record.flying() & record.steady, left, np.nan)


def _power_gained(record: Record) -> Array:
    """Change of the power of a step's inputs, gravity and springs [W], (trajectory, step)."""
    mechanism, steps = record.mechanism, slice(record.steps)
    load = record.force + mechanism.mass[:, None] * np.array(record.scene.gravity)
    gained = np.einsum("tsbi,tsbi->ts", np.diff(record.bodies.velocity, axis=1), load)
    if mechanism.hinges:
        rates = np.diff(hinge_rates(record), axis=1)
        gained += np.einsum("tsh,tsh->ts", rates, record.batch.torque[:, steps])
    if mechanism.springs:
        states, springs = record.world, mechanism.springs
        rate = pair_rate(states, springs)
        stretch = pair_distance(states, springs) - [spring.length for spring in springs]
        tension = stretch * [spring.stiffness for spring in springs]
        tension = tension + rate * [spring.damping for spring in springs]
        gained -= np.diff((tension * rate).sum(axis=-1), axis=1)
    for joint in mechanism.compliant:
        rate = joint_rate(joint, record.world)
        gained += np.diff(joint.effort(coordinate_of(record, joint), rate) * rate, axis=1)
    for k, drive in enumerate(mechanism.drives, len(mechanism.hinges)):
        rate, angle = joint_rate(drive.joint, record.world), coordinate_of(record, drive.joint)
        push = record.torque[:, steps, k]
        begin, end = (
            drive.effort(push, angle[:, s], rate[:, s]) * rate[:, s]
            for s in (slice(-1), slice(1, None))
        )
        gained += end - begin
    for joint in mechanism.frictional:
        gained -= joint.friction * np.diff(np.abs(joint_rate(joint, record.world)), axis=1)
    return gained


@dataclass(frozen=True, eq=False)
class Steps:
    """Balances of single steps, counted by what the steps around leave; (trajectory, step)."""

    left: Array
    """What is left of all balances together."""
    without: Array
    """What would be, had the step no inputs."""
    inputs: Array
    """What the inputs give to them."""

    @property
    def nearer(self) -> Array:
        """How much nearer a step is to one without inputs; 0 where they are not 6 times seen."""
        ratio = self.left / np.maximum(self.without, np.finfo(float).tiny)
        return np.where(self.inputs > _SEEN, ratio, 0.0)

    @property
    def share(self) -> Array:
        """By which the step's inputs are too small, by least squares."""
        lost = (self.left**2 + self.inputs**2 - self.without**2) / 2.0
        return np.asarray(lost) / np.maximum(self.inputs**2, np.finfo(float).tiny)


@functools.lru_cache(maxsize=1)
def steps_of(record: Record) -> Steps:
    """Take energy and the momenta that no support touches together."""
    balances = [(_left(record)[..., None], _work(record, 0)[..., None])]
    for balance, flights in flights_of(record):
        gain = gain_of(record, balance)
        balances.append((np.where(flights[..., None], gain.left, np.nan), gain.given))
    squares = np.zeros((3, len(record.finite), record.steps))
    for left, given in balances:
        left = np.where(np.isfinite(left), left, 0.0)
        given = np.where(np.isfinite(given), given, 0.0)
        sizes = np.stack([_size(each) for each in (left, left + given, given)])
        most = np.max(sizes[2], axis=1, keepdims=True, initial=0.0)
        scale = np.maximum(_besides(sizes[0], _CLOSE), _FAINT * most + np.finfo(float).tiny)
        squares += np.where(most > 0.0, sizes / scale, 0.0) ** 2
    return Steps(*np.sqrt(squares))


def _size(values: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("tsc,tsc->ts", values, values)))


def _around(values: Array, reach: int) -> Array:
    """Sum over a step and those around it, shape (trajectory, step)."""
    padded = np.pad(values, ((0, 0), (reach + 1, reach)))
    total = np.cumsum(padded, axis=1)
    return np.maximum(total[:, 2 * reach + 1 :] - total[:, : -2 * reach - 1], 0.0)


def _besides(values: Array, reach: int) -> Array:
    """Largest of the steps around a step, without it."""
    padded, count = np.pad(values, ((0, 0), (reach, reach))), values.shape[1]
    others = [k for k in range(2 * reach + 1) if k != reach]
    return np.asarray(np.max([padded[:, k : k + count] for k in others], axis=0))


@dataclass(frozen=True, eq=False)
class BalanceEvidence:
    """Of some trajectories, what their balances say."""

    names: tuple[str, ...]
    """Of the parts."""
    errors: tuple[float, ...]
    """Standard errors that are no finding."""
    share: Array
    """Shape (part, trajectory); NaN where too few steps count."""
    error: Array
    missing: Array
    """Of the inputs of each step, shape (trajectory, step)."""
    weight: Array
    """How well that is known, shape (trajectory, step)."""
    impacts: Shown | None
    """What single impacts show; None without contact, or of balls alone."""


def evidence_of(record: Record) -> BalanceEvidence | None:
    """Collect what coefficients found; None where nothing flies, or the method is unknown."""
    if record.method is None or not record.flying().any():
        return None
    parts, steps = parts_of(record), steps_of(record)
    return BalanceEvidence(
        names=tuple(part.name for part in parts),
        errors=tuple(part.errors for part in parts),
        share=np.stack([np.where(part.known, part.share, np.nan) for part in parts]),
        error=np.stack([np.maximum(part.error, _SHARPEST) for part in parts]),
        missing=steps.share,
        weight=np.minimum(steps.inputs, 1.0 / _SHARPEST) ** 2,
        impacts=shown_of(record),
    )


def shared_faults(found: Iterable[BalanceEvidence | None]) -> list[str]:
    """Say in a line each what the trajectories have together that no sound engine has."""
    kept = [each for each in found if each is not None]
    if not kept:
        return []
    share, error = (
        np.concatenate([getattr(each, name) for each in kept], axis=1)
        for name in ("share", "error")
    )
    missing, weight = (
        np.concatenate([getattr(each, name) for each in kept]) for name in ("missing", "weight")
    )
    impacts = [each.impacts for each in kept if each.impacts is not None]
    return [*_of_parts(kept[0], share, error), *_of_steps(missing, weight), *_of_impacts(impacts)]


def _of_parts(parts: BalanceEvidence, share: Array, error: Array) -> Iterator[str]:
    known = np.isfinite(share)
    mean, spread = _mean(np.nan_to_num(share), np.where(known, error**-2, 0.0))
    for k, name in enumerate(parts.names):
        allowed, count = SURE + parts.errors[k] * spread[k], int(known[k].sum())
        if count >= _ENOUGH and abs(mean[k]) > allowed:
            yield (
                f"{name}: off by a share of {abs(mean[k]):.2g} in {count} trajectories, "
                f"allowed {allowed:.2g}"
            )


def _of_steps(missing: Array, weight: Array) -> Iterator[str]:
    mean, spread = _mean(missing.T, weight.T)
    enough = (weight > 1.0).sum(axis=0) >= _ENOUGH
    for step in np.flatnonzero(enough & (mean - _ERRORS * spread > _HALF))[:1]:
        yield f"inputs of step {step}: {mean[step]:.2g} of them are missing in all trajectories"


def _of_impacts(found: list[Shown]) -> Iterator[str]:
    pool = Pool.of(Shown.joined(found)) if found else None
    if pool is not None and max(pool.used) > 1.0:
        yield str(pool)


def _mean(values: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted mean over the last axis, and its standard error, from weights and from scatter."""
    total = np.maximum(weight.sum(axis=-1), 1e-9)
    mean = (weight * values).sum(axis=-1) / total
    scatter = np.sqrt(((weight * (values - mean[..., None])) ** 2).sum(axis=-1)) / total
    return mean, np.maximum(scatter, np.sqrt(1.0 / total))

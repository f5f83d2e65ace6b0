"""Do inputs, gravity and masses have the size that the scene says?

Outside contact the energy changes in a step by the work of the inputs, and by nothing else. If an
input, gravity or a mass were off by a share ε, the step's balance would be off by -ε times its part
in it. So the residual of the balances is regressed on each part. The errors of a method hardly
resemble any of them, so that shares far below the budget of energy show.

A wrong model is wrong in all of its trajectories. Shares of single trajectories are averaged with
weights by their accuracy, and single steps over all trajectories, so that a fault hidden by
chaotic motion shows in a shard.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mbds_xsim.base.arrays import Array, Mask
from mbds_xsim.checks.conservation import energy_of, flights_of, gain_of, input_work, work_of_forces
from mbds_xsim.checks.coordinates import coordinate_of, hinge_turns
from mbds_xsim.checks.eccentric import ImpactEvidence, Pool, impact_evidence_of
from mbds_xsim.checks.finding import Figures, check
from mbds_xsim.checks.flights import numbers
from mbds_xsim.checks.integrity import pair_distance, pair_rate
from mbds_xsim.checks.joint_work import delayed_springs, losses
from mbds_xsim.checks.record import Record
from mbds_xsim.scene.joint_space import joint_rate

SURE = 3e-3
"""Share by which sound methods and solvers may be off."""

_ERRORS = 6.0  # allowed standard errors (measured: 3.0)
_ERRORS_OF_BODIES = 20.0  # the same for single masses, which errors of methods resemble most (12.6)
_LIGHT = 1e-5  # share of all mass; errors of methods look like changes of smaller parts
_OWN = 1e-3  # least gain, as a share of a body's exchange of kinetic and potential energy
_LATE = 0.03  # share of a step by which methods of order 1 delay exchanges (measured: 7e-3)
_ALONE = 0.5  # least share of a body's gain that something else must lose
_UNKNOWN = 0.5  # share of a step by which velocities of an unknown method may lag
_FEW = 10.0  # least number of steps that count
_NEAR = 4  # steps to either side that show how well a step is balanced
_CLOSE = 3  # the same for the test of single steps
_FAINT = 1e-9  # share of the largest residual; smaller ones are rounding
_ROUNDED = 1e-12  # the same of the energy scale
_SLIGHT = 1e-5  # range of the weights' energies over the energy scale; a smaller one is no matter
_LEAST = 6.0  # times the residual of neighbours; smaller inputs of single steps are not tested
_NONE = 3.0  # times nearer to a motion without the input than to one with it
_ENOUGH = 4  # least number of trajectories
_SHARPEST = 1e-4  # least standard error, so that no trajectory dominates
_HALF = 0.5  # least share of a step's inputs that must be missing


@dataclass(frozen=True, eq=False)
class BalancePart:
    """A part of the steps' balances: inputs, gravity or a mass."""

    name: str
    share: Array
    """Share by which it is off [1], shape (trajectory,)."""
    error: Array
    """Standard error of the share."""
    counting: Array
    """Effective number of steps that count."""
    errors: float
    """Number of standard errors allowed."""

    @property
    def known(self) -> Mask:
        """Whether enough steps count."""
        return np.asarray(self.counting >= _FEW)


@check("coefficients", 1.0)
def coefficients(record: Record) -> Figures | None:
    """Measure how far inputs, gravity and masses are off, over what is allowed.

    Allowed are 3e-3 and some standard errors of the regression. Inputs of the frame before and
    after are parts, too. For single steps the figure is how much nearer energy and momentum come
    to a motion without the step's inputs. None if nothing flies.
    """
    if record.steps < 1 or not record.flying().any():
        return None
    parts = parts_of(record)
    sure = SURE
    if record.method is None or record.step is None:
        sure += _UNKNOWN * (record.step or record.frame) / record.frame
    limits = [sure + part.errors * part.error for part in parts]
    shares = [
        np.where(part.known, np.abs(part.share) / most, 0.0)
        for part, most in zip(parts, limits, strict=True)
    ]
    ends = record.at_end(np.stack(shares, axis=-1))
    figures = np.concatenate([ends, record.by_step([steps_of(record).nearer / _NONE])], axis=-1)
    figures[~record.finite] = np.nan
    lines = [f"{part.name} {np.median(most):.2g}" for part, most in zip(parts, limits, strict=True)]
    note = f"allowed in half of the trajectories: {', '.join(lines[:2] + lines[3:])}"
    return Figures(figures, [*(part.name for part in parts), "inputs of a step"], note)


@functools.lru_cache(maxsize=1)
def parts_of(record: Record) -> list[BalancePart]:
    """Regress the residual of the balances on each part of them.

    Inputs are regressed in energy and in the momenta that no support touches, other parts in energy
    alone.
    """
    residual, weight = _weighed(_timely(record, _residual(record))[..., None])
    here = _work(record, 0)
    products = weight * residual[..., 0] * here
    squares = weight * here**2
    for momentum, inputs in _momenta(record):
        rest, counts = _weighed(momentum)
        products += counts * np.einsum("tsc,tsc->ts", rest, inputs)
        squares += counts * np.einsum("tsc,tsc->ts", inputs, inputs)
    parts = [_part("inputs", products, squares, _ERRORS)]
    for name, part, errors, faint in _parts(record, here, residual):
        vague = weight * np.abs(part) * faint
        parts.append(_part(name, weight * residual[..., 0] * part, weight * part**2, errors, vague))
    return parts


def _momenta(record: Record) -> Iterator[tuple[Array, Array]]:
    """Yield residuals of momenta, NaN where nothing flies, and impulses, (trajectory, step, …)."""
    for balance, flights in flights_of(record):
        gain = gain_of(record, balance)
        yield np.where(flights[..., None], gain.residual, np.nan), gain.inputs


def _timely(record: Record, residual: Array) -> Array:
    """Subtract what springs lose or gain as a method of first order shifts them by up to a step."""
    if record.order > 1 or not record.step:
        return residual
    loss = delayed_springs(record)
    known = np.isfinite(residual) & np.isfinite(loss)
    product, square = (np.where(known, loss * other, 0.0).sum(axis=1) for other in (residual, loss))
    delay = product / np.maximum(square, np.finfo(float).tiny)
    return residual - np.clip(delay, -record.step, record.step)[:, None] * loss


def _weighed(residual: Array) -> tuple[Array, Array]:
    """Return a balance's residual, 0 where it does not hold, and weights of steps, (…, step)."""
    known = np.asarray(np.isfinite(residual).all(axis=-1))
    residual = np.where(known[..., None], residual, 0.0)
    size = np.einsum("tsc,tsc->ts", residual, residual)
    near = _around(size, _NEAR) / np.maximum(_around(known.astype(float), _NEAR), 1.0)
    floor = np.maximum(_FAINT * np.max(size, axis=1, keepdims=True), np.finfo(float).tiny)
    return residual, known / np.maximum(near, floor)


def _part(
    name: str, products: Array, squares: Array, errors: float, vague: Array | float = 0.0
) -> BalancePart:
    """Regress from a part's products with the residual, and its squares, in all steps.

    The share that errors of the method in other parts may cause is subtracted.
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
    record: Record, here: Array, residual: Array
) -> Iterator[tuple[str, Array, float, Array | float]]:
    """Yield other parts: name, energy in each step [J], standard errors allowed, and confusion [J].

    The confusion is the error a method may make in all that bodies, rotors, springs and dampers
    exchange, which a part may resemble.

    Args:
        record: Record of the motion.
        here: Work of the inputs in each step [J].
        residual: Residual of the balance of each step [J], shape (trajectory, step, 1).
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
    heights = numbers(gravity).cumsum(axis=1)
    gravity[np.ptp(heights, axis=1) < _SLIGHT * every.scale] = 0.0
    late = _LATE * (record.step or 0.0) / record.frame if record.order == 1 else 0.0
    exchanged = np.concatenate([energy, every.others, losses(record)[0][..., None]], axis=-1)
    exchange = late * np.abs(np.diff(exchanged, axis=1)).sum(axis=-1)
    yield "gravity", np.where(np.abs(gravity) < faint, 0.0, gravity), _ERRORS, exchange
    # A body that keeps its own energy shows nothing of its mass: changes are the method's errors.
    least = np.maximum(_OWN * (np.abs(moving) + np.abs(lifted)), faint[..., None])
    whole = np.where(np.abs(moving + lifted) < least, 0.0, moving + lifted)
    # Nor does one that gains energy that nothing else loses, which no mass explains.
    whole = np.where(np.abs(residual - whole) < _ALONE * np.abs(whole), 0.0, whole)
    mass = record.mechanism.mass
    for k in np.flatnonzero(mass >= _LIGHT * mass.sum()):
        yield f"mass of {record.scene.bodies[k].name}", whole[..., k], _ERRORS_OF_BODIES, exchange


def _work(record: Record, shift: int) -> Array:
    """Compute the work in each step of the inputs of a shifted frame [J], (trajectory, step).

    What is rounding counts as none: that of forces on bodies that cannot move.
    """
    if shift == 0:
        work = np.diff(input_work(record), axis=1)
    else:
        work = work_of_forces(record)[1 + shift]
        if record.mechanism.hinges:
            frames = np.clip(np.arange(record.steps) + shift, 0, record.steps - 1)
            torque = record.batch.torque[:, frames]
            work = work + np.einsum("tsh,tsh->ts", torque, hinge_turns(record))
    return np.where(np.abs(work) < _ROUNDED * energy_of(record).scale[:, None], 0.0, work)


def _residual(record: Record) -> Array:
    """Compute the energy gained in steps besides inputs [J], NaN in contact, (trajectory, step).

    Energies from lagging velocities lag, too, which the power of what acts in the step corrects.
    """
    energy = energy_of(record).total + losses(record)[0] - input_work(record)
    residual = np.diff(energy, axis=1)
    if record.lag:
        residual = residual - record.lag * _power_change(record)
    return np.where(record.flying() & record.steady, residual, np.nan)


def _power_change(record: Record) -> Array:
    """Compute the change of the power of all that acts in a step [W], shape (trajectory, step)."""
    mechanism, steps = record.mechanism, slice(record.steps)
    load = record.force + mechanism.mass[:, None] * np.array(record.scene.gravity)
    change = np.einsum("tsbi,tsbi->ts", np.diff(record.bodies.velocity, axis=1), load)
    if mechanism.hinges:
        rates = np.stack([joint_rate(joint, record.world) for joint in mechanism.hinges], axis=-1)
        change += np.einsum("tsh,tsh->ts", np.diff(rates, axis=1), record.batch.torque[:, steps])
    if mechanism.springs:
        states, springs = record.world, mechanism.springs
        rate = pair_rate(states, springs)
        stretch = pair_distance(states, springs) - [spring.length for spring in springs]
        tension = stretch * [spring.stiffness for spring in springs]
        tension = tension + rate * [spring.damping for spring in springs]
        change -= np.diff((tension * rate).sum(axis=-1), axis=1)
    for joint in mechanism.compliant:
        rate = joint_rate(joint, record.world)
        change += np.diff(joint.effort(coordinate_of(record, joint), rate) * rate, axis=1)
    for k, drive in enumerate(mechanism.drives, len(mechanism.hinges)):
        rate, angle = joint_rate(drive.joint, record.world), coordinate_of(record, drive.joint)
        push = record.torque[:, steps, k]
        begin, end = (
            drive.effort(push, angle[:, s], rate[:, s]) * rate[:, s]
            for s in (slice(-1), slice(1, None))
        )
        change += end - begin
    for joint in mechanism.frictional:
        change -= joint.friction * np.diff(np.abs(joint_rate(joint, record.world)), axis=1)
    return change


@dataclass(frozen=True, eq=False)
class Steps:
    """Balances of single steps, over the residuals of neighbouring steps; (trajectory, step)."""

    residual: Array
    """Residual of all balances together."""
    without: Array
    """Residual if the step had no inputs."""
    inputs: Array
    """Contribution of the inputs."""

    @property
    def nearer(self) -> Array:
        """Residual with the inputs over that without; 0 unless `inputs` are above 6."""
        ratio = self.residual / np.maximum(self.without, np.finfo(float).tiny)
        return np.where(self.inputs > _LEAST, ratio, 0.0)

    @property
    def share(self) -> Array:
        """Share of the step's inputs that is missing, by least squares."""
        product = (self.residual**2 + self.inputs**2 - self.without**2) / 2.0
        return np.asarray(product) / np.maximum(self.inputs**2, np.finfo(float).tiny)


@functools.lru_cache(maxsize=1)
def steps_of(record: Record) -> Steps:
    """Combine the balances of energy and of the momenta that no support touches."""
    energy = _residual(record)[..., None], _work(record, 0)[..., None]
    squares = np.zeros((3, len(record.finite), record.steps))
    vague = losses(record)[1]  # of the energy, which comes first
    for residual, inputs in (energy, *_momenta(record)):
        residual = np.where(np.isfinite(residual), residual, 0.0)
        inputs = np.where(np.isfinite(inputs), inputs, 0.0)
        vectors = residual, residual + inputs, inputs
        sizes = np.sqrt([np.einsum("tsc,tsc->ts", each, each) for each in vectors])
        most = np.max(sizes[2], axis=1, keepdims=True, initial=0.0)
        scale = np.maximum(_besides(sizes[0], _CLOSE), _FAINT * most + np.finfo(float).tiny)
        scale, vague = np.maximum(scale, vague), np.zeros_like(vague)
        squares += np.where(most > 0.0, sizes / scale, 0.0) ** 2
    return Steps(*np.sqrt(squares))


def _around(values: Array, reach: int) -> Array:
    """Sum over each step and its neighbours, shape (trajectory, step)."""
    padded = np.pad(values, ((0, 0), (reach + 1, reach)))
    total = np.cumsum(padded, axis=1)
    return np.maximum(total[:, 2 * reach + 1 :] - total[:, : -2 * reach - 1], 0.0)


def _besides(values: Array, reach: int) -> Array:
    """Return the largest value among the neighbours of each step, without the step itself."""
    padded, count = np.pad(values, ((0, 0), (reach, reach))), values.shape[1]
    others = [k for k in range(2 * reach + 1) if k != reach]
    return np.asarray(np.max([padded[:, k : k + count] for k in others], axis=0))


@dataclass(frozen=True, eq=False)
class BalanceEvidence:
    """Evidence from the balances of some trajectories."""

    parts: list[BalancePart]
    missing: Array
    """Missing share of the inputs of each step, shape (trajectory, step)."""
    weight: Array
    """Weight of the missing share, shape (trajectory, step)."""
    impacts: ImpactEvidence | None
    """Evidence from single impacts; None without contact, or with balls alone."""


def evidence_of(record: Record) -> BalanceEvidence | None:
    """Collect evidence about coefficients; None if nothing flies or the method is unknown."""
    if record.method is None or not record.flying().any():
        return None
    steps = steps_of(record)
    weight = np.minimum(steps.inputs, 1.0 / _SHARPEST) ** 2
    return BalanceEvidence(parts_of(record), steps.share, weight, impact_evidence_of(record))


def shared_faults(evidence: Iterable[BalanceEvidence | None]) -> list[str]:
    """Describe faults that all trajectories share and no sound engine shows, one line each."""
    known = [each for each in evidence if each is not None]
    if not known:
        return []
    same_parts = zip(*(each.parts for each in known), strict=True)
    lines = [line for parts in same_parts for line in _of_part(parts)]
    missing, weight = (
        np.concatenate([getattr(each, name) for each in known]) for name in ("missing", "weight")
    )
    lines += _of_steps(missing, weight)
    impacts = [each.impacts for each in known if each.impacts is not None]
    pool = Pool.of(ImpactEvidence.joined(impacts)) if impacts else None
    if pool is not None and max(pool.used) > 1.0:
        lines.append(str(pool))
    return lines


def _of_part(same: tuple[BalancePart, ...]) -> Iterator[str]:
    """Describe what one part shows in several groups of trajectories together, if it is off."""
    known, share, error = (
        np.concatenate([getattr(part, name) for part in same])
        for name in ("known", "share", "error")
    )
    known &= np.isfinite(share)
    weight = np.where(known, np.maximum(error, _SHARPEST) ** -2, 0.0)
    mean, spread = _mean(np.where(known, share, 0.0), weight)
    allowed, count = SURE + same[0].errors * spread, int(known.sum())
    if count >= _ENOUGH and abs(mean) > allowed:
        yield (
            f"{same[0].name}: relative error {abs(mean):.2g} in {count} trajectories, "
            f"allowed {allowed:.2g}"
        )


def _of_steps(missing: Array, weight: Array) -> Iterator[str]:
    mean, spread = _mean(missing.T, weight.T)
    enough = (weight > 1.0).sum(axis=0) >= _ENOUGH
    for step in np.flatnonzero(enough & (mean - _ERRORS * spread > _HALF))[:1]:
        yield f"inputs of step {step}: {mean[step]:.2g} of them are missing in all trajectories"


def _mean(values: Array, weight: Array) -> tuple[Array, Array]:
    """Return the weighted mean over the last axis, and the larger error, by weights or scatter."""
    total = np.maximum(weight.sum(axis=-1), 1e-9)
    mean = (weight * values).sum(axis=-1) / total
    scatter = np.sqrt(((weight * (values - mean[..., None])) ** 2).sum(axis=-1)) / total
    return mean, np.maximum(scatter, np.sqrt(1.0 / total))

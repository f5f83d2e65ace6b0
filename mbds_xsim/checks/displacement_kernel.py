"""Figures of `displacement` without contact, for eight trajectories at once.

Sums are those of `displacement`, in one pass from frame to frame instead of about a hundred over
whole arrays, so that numbers of a body stay in the nearest cache. Figures agree to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

from mbds_xsim.base.arrays import Array
from mbds_xsim.checks.motion_kernel import FlatMotion, conjugate, facing, vector
from mbds_xsim.reference.compiling import compiled, entered
from mbds_xsim.reference.lane_algebra import (
    add,
    add_to,
    cross,
    dot,
    hamilton,
    load3,
    rotated,
    sub,
    times,
)
from mbds_xsim.reference.lanes import (
    LANES,
    arctan2,
    cosine,
    larger,
    positive,
    root,
    sine,
    size,
    spread,
)
from mbds_xsim.reference.traced import load, put_eight, store

_TINY = 2.2250738585072014e-308
_SMALL = 1e-12

# Rows of lanes per step: residual, residual in the body's frame, gain of the velocity, whether
# anything moved, allowance for bending, weights; then, of both kinds, squares and products of the
# gains; the fastest body's gain.
RESIDUAL, OWN, GAIN, MOVED, BEND, WEIGHT, SQUARE, PRODUCT, FASTEST = 0, 3, 6, 9, 10, 11, 12, 14, 16
STEP = 17


class Rule(NamedTuple):
    """Constants of the figures' limits; `displacement` explains them."""

    frame: float
    lag: float
    """Lag of velocities over the frame interval."""
    bend: float
    late: float
    """Allowed share of the fastest body's gain."""
    share: float
    least: tuple[float, float]
    """Least speeds that set a scale [m/s], [rad/s]."""
    floor: float
    systematic: float
    errors: float
    steady: float
    slope: float
    faint: float


@entered
def displace(m: FlatMotion, rule: Rule, work: Array, figures: Array) -> None:
    """Write the figures, shape (part, frame, trajectory), flat; `work` has `STEP` rows per step."""
    for first in range(0, m.rows, LANES):
        t = min(first, m.rows - LANES)
        for s in range(m.frames - 1):
            for k in range(SQUARE, FASTEST):
                store(work, STEP * s + k, spread(0.0))
        for turns in range(2):
            floor = _prepare(m, rule, work, t, turns)
            for b in range(m.bodies):
                _store_residuals(m, rule, work, t, turns, b)
                _bend(m, rule, work)
                _judge(m, rule, work, figures, t, turns, b, floor)
        _delay(m, rule, work, figures, t)


@compiled
def _speed(m, turns, body, frame, t):
    if turns:
        return vector(m, m.spin, body, frame, t)
    return vector(m, m.velocity, body, frame, t)


@compiled
def _prepare(m, rule, work, t, turns):
    """Return the floor of a trajectory, and store the largest gain of each step."""
    fastest = spread(0.0)
    for s in range(m.frames - 1):
        store(work, STEP * s + FASTEST, spread(0.0))
    for b in range(m.bodies):
        before = _speed(m, turns, b, 0, t)
        fastest = larger(fastest, dot(before, before))
        for s in range(m.frames - 1):
            after = _speed(m, turns, b, s + 1, t)
            fastest = larger(fastest, dot(after, after))
            gain, at = sub(after, before), STEP * s + FASTEST
            store(work, at, larger(load(work, at), root(dot(gain, gain))))
            before = after
    least = rule.least[1] if turns else rule.least[0]
    return larger(rule.floor * larger(root(fastest), spread(least)), spread(_TINY))


@compiled
def _store_residuals(m, rule, work, t, turns, b):
    """Write the residual of each step, the velocity's gain, and whether the body moves."""
    place, turn = vector(m, m.position, b, 0, t), facing(m, b, 0, t)
    before = _speed(m, turns, b, 0, t)
    for s in range(m.frames - 1):
        at = STEP * s
        there, then = vector(m, m.position, b, s + 1, t), facing(m, b, s + 1, t)
        after = _speed(m, turns, b, s + 1, t)
        step, gain = sub(there, place), sub(after, before)
        if turns:
            residual = _turn_residual(rule, before, after, turn, then)
        else:
            residual = sub(times(1.0 / rule.frame, step), times(0.5, add(after, before)))
        residual = add(residual, times(rule.lag, gain))
        moved = size(step[0]) + size(step[1]) + size(step[2])
        moved = moved + size(then[0] - turn[0]) + size(then[1] - turn[1])
        moved = moved + size(then[2] - turn[2]) + size(then[3] - turn[3])
        store(work, at + RESIDUAL, residual)
        store(work, at + GAIN, gain)
        store(work, at + MOVED, moved)
        if turns:
            store(work, at + OWN, rotated(conjugate(turn), residual))
        place, turn, before = there, then, after


@compiled
def _turn_residual(rule, begin, end, turn, then):
    """Compute the recorded turn less that of the velocities, to third order, as a rate."""
    h = rule.frame
    predicted = sub(times(h / 2, add(begin, end)), times(h**2 / 12, cross(begin, end)))
    half = 0.5 * root(dot(predicted, predicted))
    divisor = positive(half, half, spread(1.0))
    share = 0.5 * positive(half, sine(divisor) / divisor, spread(1.0))
    undone = cosine(half), -share * predicted[0], -share * predicted[1], -share * predicted[2]
    q = hamilton(undone, hamilton(then, conjugate(turn)))
    # Rotation vector, of length π at most.
    sign = positive(-q[0], spread(-1.0), spread(1.0))
    axis = sign * q[1], sign * q[2], sign * q[3]
    length = root(dot(axis, axis))
    excess = length - _SMALL
    divisor = positive(excess, length, spread(1.0))
    stretch = positive(excess, 2.0 * arctan2(divisor, sign * q[0]) / divisor, spread(2.0))
    return times(stretch / h, axis)


@compiled
def _bend(m, rule, work):
    """Write the allowance for velocities that bend between the frames of each step."""
    steps = m.frames - 1
    for s in range(steps):  # the larger second difference of its two ends
        here = larger(_change(work, steps, s), _change(work, steps, s + 1))
        store(work, STEP * s + WEIGHT, here)
    for s in range(steps):  # the largest of the step and its neighbours; at an end the neighbour's
        inner = min(max(s, min(1, steps - 1)), max(steps - 2, 0))
        most = _window(work, steps, inner, WEIGHT)
        allowed = rule.bend * most + rule.late * _window(work, steps, s, FASTEST)
        moved = load(work, STEP * s + MOVED)
        store(work, STEP * s + BEND, positive(moved, allowed, spread(0.0)))


@compiled
def _window(work, steps, s, row):
    most = load(work, STEP * s + row)
    if s > 0:
        most = larger(most, load(work, STEP * (s - 1) + row))
    if s + 1 < steps:
        most = larger(most, load(work, STEP * (s + 1) + row))
    return most


@compiled
def _change(work, steps, frame):
    """Return the size of the second difference at a frame, extrapolated linearly at an end."""
    if steps < 2:
        return spread(0.0)
    if 0 < frame < steps:
        inside = _second(work, frame)
    else:
        near = 1 if frame == 0 else steps - 1
        beyond = min(2, steps - 1) if frame == 0 else max(steps - 2, 1)
        inside = sub(times(2.0, _second(work, near)), _second(work, beyond))
    return root(dot(inside, inside))


@compiled
def _second(work, frame):
    return sub(load3(work, STEP * frame + GAIN), load3(work, STEP * (frame - 1) + GAIN))


@compiled
def _judge(m, rule, work, figures, t, turns, b, floor):
    """Write the figures of a body, and add to the sums for the delay."""
    weights, bends = spread(0.0), spread(0.0)
    mean = own = (spread(0.0), spread(0.0), spread(0.0))
    part = (2 * turns * m.bodies + b) * m.frames
    for s in range(m.frames - 1):
        at = STEP * s
        rest, gain, bend = load3(work, at + RESIDUAL), load3(work, at + GAIN), load(work, at + BEND)
        allowed = bend + floor
        weight = 1.0 / (allowed * allowed)
        put_eight(figures, (part + s + 1) * m.rows + t, root(dot(rest, rest)) / allowed)
        store(work, at + WEIGHT, weight)
        weights, bends = weights + weight, bends + weight * bend
        mean = add(mean, times(weight, rest))
        if turns:
            own = add(own, times(weight, load3(work, at + OWN)))
        add_to(work, at + SQUARE + turns, weight * dot(gain, gain))
        add_to(work, at + PRODUCT + turns, weight * dot(gain, rest))
    inverse = 1.0 / larger(weights, spread(_TINY))
    part = ((2 * turns + 1) * m.bodies + b + 1) * m.frames - 1
    drift = _drift(m, rule, work, RESIDUAL, times(inverse, mean), inverse, inverse * bends, floor)
    put_eight(figures, part * m.rows + t, drift)
    if turns:
        drift = _drift(m, rule, work, OWN, times(inverse, own), inverse, inverse * bends, floor)
        put_eight(figures, (part + m.bodies * m.frames) * m.rows + t, drift)


@compiled
def _drift(m, rule, work, row, mean, inverse, bend, floor):
    """Return the size of a mean over its limit."""
    total = spread(0.0)
    for s in range(m.frames - 1):
        off, share = sub(load3(work, STEP * s + row), mean), inverse * load(work, STEP * s + WEIGHT)
        total = total + share * share * dot(off, off)
    limit = (rule.systematic + rule.share / 2) * bend + rule.errors * root(total)
    return root(dot(mean, mean)) / (limit + (rule.steady + rule.share) * floor)


@compiled
def _delay(m, rule, work, figures, t):
    """Write the slope of residuals over gains, relative to its limit."""
    square, product, rest = spread(0.0), spread(0.0), spread(0.0)
    for s in range(m.frames - 1):
        for k in range(2):
            square = square + load(work, STEP * s + SQUARE + k)
            product = product + load(work, STEP * s + PRODUCT + k)
    square = larger(square, spread(rule.faint))
    slope = product / square
    for s in range(m.frames - 1):
        for k in range(2):
            at = STEP * s + k
            off = load(work, at + PRODUCT) - slope * load(work, at + SQUARE)
            rest = rest + off * off
    allowed = rule.slope + rule.errors * (root(rest) / square)
    put_eight(figures, ((5 * m.bodies + 1) * m.frames - 1) * m.rows + t, size(slope) / allowed)

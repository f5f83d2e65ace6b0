"""Compiled kernels for energies, work and angular momenta of `conservation`, and joint gaps.

Each makes one pass over the frames, where numpy makes about thirty.
"""

from __future__ import annotations

from typing import NamedTuple

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.checks.motion_kernel import FlatMotion, conjugate, facing, force_on, spread3, vector
from mbds_xsim.reference.compiling import compiled, entered
from mbds_xsim.reference.lane_algebra import (
    add,
    add_to,
    cross,
    dot,
    load3,
    rotated,
    sub,
    times,
)
from mbds_xsim.reference.lanes import LANES, root, spread
from mbds_xsim.reference.traced import load, put_eight, store


class Masses(NamedTuple):
    """Masses and inertias of the bodies, and gravity."""

    mass: Array
    inertia: Array
    """Moments of inertia in the native frame, shape (body, 3, 3)."""
    gravity: Array


@entered
def find_energies(m: FlatMotion, masses: Masses, energies: Array) -> None:
    """Write kinetic, then gravitational energies, shape (2 · body, frame, trajectory), flat."""
    size, g = m.frames * m.rows, masses.gravity
    for b in range(m.bodies):
        mass = masses.mass[b]
        for first in range(0, size, LANES):
            i = min(first, size - LANES)
            v = vector(m, m.velocity, b, 0, i)
            own = rotated(conjugate(facing(m, b, 0, i)), vector(m, m.spin, b, 0, i))
            moving = mass * dot(v, v) + dot(own, _turning(masses, b, own))
            x = vector(m, m.position, b, 0, i)
            put_eight(energies, b * size + i, 0.5 * moving)
            put_eight(energies, (m.bodies + b) * size + i, -mass * dot(x, (g[0], g[1], g[2])))


@compiled
def _turning(masses, b, own):
    """Return the angular momentum about the centre of mass, in the native frame."""
    a = masses.inertia[b]
    return (
        a[0, 0] * own[0] + a[0, 1] * own[1] + a[0, 2] * own[2],
        a[1, 0] * own[0] + a[1, 1] * own[1] + a[1, 2] * own[2],
        a[2, 0] * own[0] + a[2, 1] * own[1] + a[2, 2] * own[2],
    )


@entered
def find_work(m: FlatMotion, work: Array) -> None:
    """Write the work in each step of the forces of the step before, the same and the one after.

    Shape (3, step, trajectory), flat; at the ends the forces of the step itself count.
    """
    steps = m.frames - 1
    for s in range(steps):
        for first in range(0, m.rows, LANES):
            t = min(first, m.rows - LANES)  # the last eight overlap others
            before = here = after = spread(0.0)
            for b in range(m.bodies):
                x = vector(m, m.position, b, s, t)
                moved = sub(vector(m, m.position, b, s + 1, t), x)
                before = before + dot(force_on(m, b, max(s - 1, 0), t), moved)
                here = here + dot(force_on(m, b, s, t), moved)
                after = after + dot(force_on(m, b, min(s + 1, steps - 1), t), moved)
            at = s * m.rows + t
            put_eight(work, at, before)
            put_eight(work, steps * m.rows + at, here)
            put_eight(work, 2 * steps * m.rows + at, after)


class Spinning(NamedTuple):
    """Bodies whose angular momentum is computed."""

    bodies: Index
    about: Array
    """Point of the world, shape (3,)."""
    fixed: bool
    """Whether momentum is about that point, not about the centre of mass."""
    frame: float
    lag: float


# Rows of lanes of each frame, or of the step to it: momentum, sum of its sizes, moments of forces
# and of gravity, error; then the point that momentum is about, and its velocity.
MOMENTUM, SIZE, INPUT, WEIGHT, BLUR = 0, 3, 4, 7, 10
SUMS = 11
_CENTRE, _DRIFT = SUMS, SUMS + 3
FRAME = SUMS + 6


@entered
def find_momenta(m: FlatMotion, masses: Masses, group: Spinning, work: Array, sums: Array) -> None:
    """Write momenta and moments, flat (`SUMS`, frame, trajectory); work: `FRAME` rows a frame."""
    g = masses.gravity
    for first in range(0, m.rows, LANES):
        t = min(first, m.rows - LANES)
        for row in range(FRAME * m.frames):
            store(work, row, spread(0.0))
        _place(m, masses, group, work, t)
        for k in range(len(group.bodies)):
            _add_body(m, masses, group, work, t, group.bodies[k])
        for f in range(m.frames):
            fall = cross(load3(work, FRAME * f + WEIGHT), spread3(g[0], g[1], g[2]))
            store(work, FRAME * f + WEIGHT, fall)
            for k in range(SUMS):
                put_eight(sums, (k * m.frames + f) * m.rows + t, load(work, FRAME * f + k))


@compiled
def _place(m, masses, group, work, t):
    """Write the point that momentum is about, and its velocity."""
    total = 0.0
    for k in range(len(group.bodies)):
        total += masses.mass[group.bodies[k]]
    for f in range(m.frames):
        if group.fixed:
            point = spread3(group.about[0], group.about[1], group.about[2])
            store(work, FRAME * f + _CENTRE, point)
    for k in range(0 if group.fixed else len(group.bodies)):
        b = group.bodies[k]
        share = masses.mass[b] / total
        for f in range(m.frames):
            at = FRAME * f
            add_to(work, at + _CENTRE, times(share, vector(m, m.position, b, f, t)))
            add_to(work, at + _DRIFT, times(share, vector(m, m.velocity, b, f, t)))


@compiled
def _add_body(m, masses, group, work, t, b):
    """Add a body's angular momentum, moments and error."""
    mass, h = masses.mass[b], group.frame / 60
    before = begin = previous = spread3(0.0, 0.0, 0.0)
    for f in range(m.frames):
        at = FRAME * f
        arm = sub(vector(m, m.position, b, f, t), load3(work, at + _CENTRE))
        speed = sub(vector(m, m.velocity, b, f, t), load3(work, at + _DRIFT))
        momentum = add(_spinning(m, masses, b, f, t), cross(arm, times(mass, speed)))
        add_to(work, at + MOMENTUM, momentum)
        add_to(work, at + SIZE, root(dot(momentum, momentum)))
        if f > 0:
            swept, bend = _swept(group, (before, begin), (arm, speed))
            push = force_on(m, b, f - 1, t)
            add_to(work, at + INPUT, cross(swept, push))
            add_to(work, at + WEIGHT, times(mass, swept))
            change = sub(bend, previous)
            off = h * root(dot(change, change))
            if f > 1 or m.frames == 2:
                add_to(work, at + BLUR, off * _loaded(masses, mass, push))
            if f == 2:  # the first step has no other before it
                more = off * _loaded(masses, mass, force_on(m, b, 0, t))
                add_to(work, FRAME + BLUR, more)
            previous = bend
        before, begin = arm, speed


@compiled
def _spinning(m, masses, b, f, t):
    turn = facing(m, b, f, t)
    own = rotated(conjugate(turn), vector(m, m.spin, b, f, t))
    return rotated(turn, _turning(masses, b, own))


@compiled
def _swept(group, begin, end):
    """Integrate an arm over a step by the cubic; also return its residual from a parabola."""
    h, moved = group.frame, sub(end[0], begin[0])
    mean = add(times(h / 2, add(end[0], begin[0])), times(h**2 / 12, sub(begin[1], end[1])))
    bend = sub(moved, times(h / 2, add(end[1], begin[1])))
    return add(mean, times(group.lag, moved)), bend


@compiled
def _loaded(masses, mass, push):
    g = masses.gravity
    load = push[0] + mass * g[0], push[1] + mass * g[1], push[2] + mass * g[2]
    return root(dot(load, load))


class Ends(NamedTuple):
    """Points of two bodies that joints hold together."""

    body: Index
    """Indices of the bodies, shape (2, joint); −1 is the world."""
    point: Array
    """Points from centres of mass, in native frames [m], shape (2, joint, 3)."""


@entered
def part_joints(m: FlatMotion, ends: Ends, gaps: Array) -> None:
    """Write distances and relative speeds of the points, flat (2, joint, frame, trajectory)."""
    size, joints = m.frames * m.rows, ends.body.shape[1]
    for j in range(joints):
        for first in range(0, size, LANES):
            i = min(first, size - LANES)
            near, leaving = _end(m, ends, 0, j, i)
            far, coming = _end(m, ends, 1, j, i)
            apart, parting = sub(far, near), sub(coming, leaving)
            put_eight(gaps, j * size + i, root(dot(apart, apart)))
            put_eight(gaps, (joints + j) * size + i, root(dot(parting, parting)))


@compiled
def _end(m, ends, k, j, i):
    b, p = ends.body[k, j], ends.point[k, j]
    if b < 0:
        return spread3(p[0], p[1], p[2]), spread3(0.0, 0.0, 0.0)
    arm = rotated(facing(m, b, 0, i), spread3(p[0], p[1], p[2]))
    speed = add(vector(m, m.velocity, b, 0, i), cross(vector(m, m.spin, b, 0, i), arm))
    return add(vector(m, m.position, b, 0, i), arm), speed

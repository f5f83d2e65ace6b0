"""Energies, work and angular momenta as `conservation` has them, and how far joints are apart.

In one pass over the frames each, where numpy makes some thirty.
"""

from __future__ import annotations

from typing import NamedTuple

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.checks.motion_kernel import FlatMotion, conjugate, facing, held, spread3, vector
from mbds_xsim.reference.lane_algebra import add, cross, dot, load3, rotated, store3, sub, times
from mbds_xsim.reference.lanes import LANES, compiled, entered, put_eight, root, spread


class Masses(NamedTuple):
    """What resists, of each body."""

    mass: Array
    inertia: Array
    """In the native frame, shape (body, 3, 3)."""
    gravity: Array


@entered
def find_energies(m: FlatMotion, masses: Masses, found: Array) -> None:
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
            put_eight(found, b * size + i, 0.5 * moving)
            put_eight(found, (m.bodies + b) * size + i, -mass * dot(x, (g[0], g[1], g[2])))


@compiled
def _turning(masses, b, own):
    """Give the angular momentum about the centre of mass, in the native frame."""
    a = masses.inertia[b]
    return (
        a[0, 0] * own[0] + a[0, 1] * own[1] + a[0, 2] * own[2],
        a[1, 0] * own[0] + a[1, 1] * own[1] + a[1, 2] * own[2],
        a[2, 0] * own[0] + a[2, 1] * own[1] + a[2, 2] * own[2],
    )


@entered
def find_work(m: FlatMotion, found: Array) -> None:
    """Write the work of the forces of the step before, of each step and of the one after.

    Shape (3, step, trajectory), flat; at the ends the forces of the step itself are taken.
    """
    steps = m.frames - 1
    for s in range(steps):
        for first in range(0, m.rows, LANES):
            t = min(first, m.rows - LANES)
            before = here = after = spread(0.0)
            for b in range(m.bodies):
                x = vector(m, m.position, b, s, t)
                moved = sub(vector(m, m.position, b, s + 1, t), x)
                before = before + dot(held(m, b, max(s - 1, 0), t), moved)
                here = here + dot(held(m, b, s, t), moved)
                after = after + dot(held(m, b, min(s + 1, steps - 1), t), moved)
            at = s * m.rows + t
            put_eight(found, at, before)
            put_eight(found, steps * m.rows + at, here)
            put_eight(found, 2 * steps * m.rows + at, after)


class Spinning(NamedTuple):
    """Bodies whose angular momentum is looked at."""

    bodies: Index
    about: Array
    """Point of the world, shape (3,)."""
    fixed: bool
    """Whether it is about that point, and not about the centre of mass."""
    frame: float
    lag: float


# Rows of lanes that a body has, of the frame before: arm, speed, what a parabola leaves.
ARM, SPEED, BEND = 0, 3, 6
BODY = 9
# Rows of what is found of each frame or of the step to it: momentum, sum of sizes, moments of
# forces, of gravity, error.
MOMENTUM, SIZE, GIVEN, WEIGHT, BLUR = 0, 3, 4, 7, 10
FOUND = 11


@entered
def find_momenta(m: FlatMotion, masses: Masses, group: Spinning, work: Array, found: Array) -> None:
    """Write shape (`FOUND`, frame, trajectory), flat, zeros at first; work has `BODY` a body."""
    for first in range(0, m.rows, LANES):
        t = min(first, m.rows - LANES)
        for f in range(m.frames):
            centre, drift = _about(m, masses, group, f, t)
            momentum, size = spread3(0.0, 0.0, 0.0), spread(0.0)
            moment, fall, blur, early = momentum, momentum, size, size
            for k in range(len(group.bodies)):
                b, at = group.bodies[k], BODY * k
                mass = masses.mass[b]
                arm = sub(vector(m, m.position, b, f, t), centre)
                speed = sub(vector(m, m.velocity, b, f, t), drift)
                one = add(_spinning(m, masses, b, f, t), cross(arm, times(mass, speed)))
                momentum, size = add(momentum, one), size + root(dot(one, one))
                if f > 0:
                    before = load3(work, at), load3(work, at + SPEED)
                    swept, bend = _swept(group, before, (arm, speed))
                    change = sub(bend, load3(work, at + BEND))
                    off = root(dot(change, change))
                    push = held(m, b, f - 1, t)
                    moment, fall = add(moment, cross(swept, push)), add(fall, times(mass, swept))
                    if f > 1 or m.frames == 2:
                        blur = blur + off * _loaded(masses, mass, push)
                    if f == 2:  # the first step has no other before it
                        early = early + off * _loaded(masses, mass, held(m, b, 0, t))
                    store3(work, at + BEND, bend)
                else:
                    store3(work, at + BEND, spread3(0.0, 0.0, 0.0))
                store3(work, at + ARM, arm)
                store3(work, at + SPEED, speed)
            _put3(m, found, MOMENTUM, f, t, momentum)
            _put(m, found, SIZE, f, t, size)
            _put3(m, found, GIVEN, f, t, moment)
            g = masses.gravity
            _put3(m, found, WEIGHT, f, t, cross(fall, spread3(g[0], g[1], g[2])))
            _put(m, found, BLUR, f, t, group.frame / 60 * blur)
            if f == 2:
                _put(m, found, BLUR, 1, t, group.frame / 60 * early)


@compiled
def _about(m, masses, group, f, t):
    """Give the point that momentum is about, and its velocity."""
    still = spread3(0.0, 0.0, 0.0)
    if group.fixed:
        return spread3(group.about[0], group.about[1], group.about[2]), still
    place, speed, total = still, still, 0.0
    for k in range(len(group.bodies)):
        total += masses.mass[group.bodies[k]]
    for k in range(len(group.bodies)):
        b = group.bodies[k]
        share = masses.mass[b] / total
        place = add(place, times(share, vector(m, m.position, b, f, t)))
        speed = add(speed, times(share, vector(m, m.velocity, b, f, t)))
    return place, speed


@compiled
def _spinning(m, masses, b, f, t):
    turn = facing(m, b, f, t)
    own = rotated(conjugate(turn), vector(m, m.spin, b, f, t))
    return rotated(turn, _turning(masses, b, own))


@compiled
def _swept(group, begin, end):
    """Integrate an arm over a step by the cubic, and give what a parabola leaves of it."""
    h, moved = group.frame, sub(end[0], begin[0])
    mean = add(times(h / 2, add(end[0], begin[0])), times(h**2 / 12, sub(begin[1], end[1])))
    bend = sub(moved, times(h / 2, add(end[1], begin[1])))
    return add(mean, times(group.lag, moved)), bend


@compiled
def _loaded(masses, mass, push):
    g = masses.gravity
    load = push[0] + mass * g[0], push[1] + mass * g[1], push[2] + mass * g[2]
    return root(dot(load, load))


@compiled
def _put(m, found, row, f, t, value):
    put_eight(found, (row * m.frames + f) * m.rows + t, value)


@compiled
def _put3(m, found, row, f, t, value):
    for k in range(3):
        _put(m, found, row + k, f, t, value[k])


class Ends(NamedTuple):
    """Points of two bodies that joints hold together."""

    body: Index
    """Shape (2, joint); −1 is the world."""
    point: Array
    """From centres of mass, in native frames [m], shape (2, joint, 3)."""


@entered
def part_joints(m: FlatMotion, ends: Ends, found: Array) -> None:
    """Write distances and speeds of the points, shape (2, joint, frame, trajectory), flat."""
    size, joints = m.frames * m.rows, ends.body.shape[1]
    for j in range(joints):
        for first in range(0, size, LANES):
            i = min(first, size - LANES)
            near, leaving = _end(m, ends, 0, j, i)
            far, coming = _end(m, ends, 1, j, i)
            apart, parting = sub(far, near), sub(coming, leaving)
            put_eight(found, j * size + i, root(dot(apart, apart)))
            put_eight(found, (joints + j) * size + i, root(dot(parting, parting)))


@compiled
def _end(m, ends, k, j, i):
    b, p = ends.body[k, j], ends.point[k, j]
    if b < 0:
        return spread3(p[0], p[1], p[2]), spread3(0.0, 0.0, 0.0)
    arm = rotated(facing(m, b, 0, i), spread3(p[0], p[1], p[2]))
    speed = add(vector(m, m.velocity, b, 0, i), cross(vector(m, m.spin, b, 0, i), arm))
    return add(vector(m, m.position, b, 0, i), arm), speed

"""Loads and inertias of bodies, with which the recursions of `tree_kernel` start."""

from __future__ import annotations

from mbds_xsim.reference.compiling import compiled
from mbds_xsim.reference.lane_algebra import (
    add,
    add_to,
    apply,
    apply_even,
    cross,
    dot,
    load3,
    load9,
    number3,
    product,
    sub,
    times,
    transposed,
    upper,
)
from mbds_xsim.reference.lanes import larger, root, spread
from mbds_xsim.reference.traced import load, store, traced
from mbds_xsim.reference.tree import SLIDER, Tree
from mbds_xsim.reference.tree_kernel import PLACES, F, H, J, M, N, R, V, W, Workspace, X, zero


@compiled
def still(t: Tree, work: Workspace):
    """Set all loads on bodies to zero."""
    for i in range(len(t.kind) + 1):
        store(work.link, i * PLACES + F, zero())
        store(work.link, i * PLACES + N, zero())


@compiled
def hold(t: Tree, work: Workspace, k, force, torque):
    """Set a lane's held forces (body, 3), torques about hinges and pushes of drives."""
    for i in range(len(t.kind)):
        for j in range(3):
            work.load[6 * i + j, k] = force[t.body[i], j]
    for j in range(len(torque)):
        work.torque[j, k] = torque[j]


@compiled
def act(t: Tree, work: Workspace, y):
    """Apply springs, laws of joints and torques to the bodies."""
    a = work.link
    still(t, work)
    for k in range(len(t.spring)):
        p, c = t.spring_ends[0, k] * PLACES, t.spring_ends[1, k] * PLACES
        first = apply(load9(a, p + R), number3(t.spring_points[0], k))
        second = apply(load9(a, c + R), number3(t.spring_points[1], k))
        line, rate = _between(a, p, c, first, second)
        length = root(dot(line, line))
        tension = t.spring[k, 1] * (length - t.spring[k, 0])
        tension = tension + t.spring[k, 2] * (dot(line, rate) / length)
        _pull(a, p, c, first, second, times(tension / length, line))
    for k in range(len(t.law)):
        p, c = t.law_ends[0, k] * PLACES, t.law_ends[1, k] * PLACES
        axis = apply(load9(a, p + R), number3(t.law_axis, k))
        rest, stiffness, damping = number3(t.law, k)
        if t.law_kind[k] == SLIDER:
            first = apply(load9(a, p + R), number3(t.law_points[0], k))
            second = apply(load9(a, c + R), number3(t.law_points[1], k))
            line, rate = _between(a, p, c, first, second)
            # The line is along the axis: turning with the parent does not change its length.
            tension = stiffness * (dot(axis, line) - rest) + damping * dot(axis, rate)
            tension = _driven(t, work, k, tension) + load(work.grip, k)
            _pull(a, p, c, first, second, times(tension, axis))
        else:
            rate = dot(axis, sub(load3(a, c + W), load3(a, p + W)))
            moment = stiffness * (load(y, t.angle_at[k]) - rest) + damping * rate
            moment = _driven(t, work, k, moment) + load(work.grip, k)
            _turn(a, p, c, times(-1.0 * moment, axis))
    for k in range(len(t.hinge_axis)):
        p, c = t.hinge_ends[0, k] * PLACES, t.hinge_ends[1, k] * PLACES
        axis = apply(load9(a, p + R), number3(t.hinge_axis, k))
        _turn(a, p, c, times(load(work.torque, k), axis))


@compiled
def _driven(t, work, k, load_of_law):
    """Subtract a drive's push from the load of its law, within its limit; keep other loads."""
    if t.pushed[k] < 0:
        return load_of_law
    most = spread(t.bound[k])
    return larger(-larger(load(work.torque, t.pushed[k]) - load_of_law, -most), -most)


@traced
def _between(a, p, c, first, second):
    """Return the line from a point of one body to a point of another, and its rate."""
    line = sub(add(sub(load3(a, c + X), load3(a, p + X)), second), first)
    rate = sub(
        add(load3(a, c + V), cross(load3(a, c + W), second)),
        add(load3(a, p + V), cross(load3(a, p + W), first)),
    )
    return line, rate


@traced
def _pull(a, p, c, first, second, pull):
    """Pull a point of the first body by a force, and a point of the second by its opposite."""
    back = times(-1.0, pull)
    add_to(a, p + F, pull)
    add_to(a, c + F, back)
    add_to(a, p + N, cross(first, pull))
    add_to(a, c + N, cross(second, back))


@traced
def _turn(a, p, c, moment):
    """Apply a moment to the second body, and its opposite to the first."""
    add_to(a, c + N, moment)
    add_to(a, p + N, times(-1.0, moment))


@compiled
def weigh(t: Tree, work: Workspace):
    """Start each body's articulated inertia with its own, and its bias with its loads."""
    a = work.link
    for i in range(len(t.kind)):
        b = i * PLACES
        turn, spin, mass = load9(a, b + R), load3(a, b + W), t.mass[i]
        inertia = _turned(turn, number3(t.moment, i))
        m, o = spread(mass), spread(0.0)
        store(a, b + M, (m, m, m, o, o, o))
        store(a, b + H, (o, o, o, o, o, o, o, o, o))
        store(a, b + J, inertia)
        force, moment = load3(work.load, 6 * i), load3(work.load, 6 * i + 3)
        force = add(force, times(mass, (t.gravity[0], t.gravity[1], t.gravity[2])))
        store(a, b + F, times(-1.0, add(force, load3(a, b + F))))
        bias = sub(cross(spin, apply_even(inertia, spin)), add(moment, load3(a, b + N)))
        store(a, b + N, bias)


@traced
def _turned(turn, moments):
    """Return the inertia of a body by its rotation matrix and principal moments."""
    scaled = tuple(moment * x for x, moment in zip(turn, 3 * moments, strict=True))
    return upper(product(scaled, transposed(turn)))

"""Articulated bodies on a spanning tree: O(n) recursions, eight states at once.

Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 7, with all vectors in W and every
body's twist at its centre of mass. Ball joints and free bodies have the absolute orientation and
angular velocity of their body as coordinates, so that they pass on a force and no moment. A hinge's
angle is kept as cosine and sine of its half, which need no trigonometry and no limited range.

A body's articulated inertia (M, H, J) gives the force F = M a + H α + f and the moment
N = Hᵀ a + J α + n that accelerations a and α need. At a joint, off by r from the centre, it is
H' = H + M [r]×, J' = J + Hᵀ [r]× − [r]× H'.

Links are in the order of `Mechanism.links`; the last one is the world. The numbers of all links are
kept in one array of lanes, at the offsets below.
"""

from __future__ import annotations

from typing import NamedTuple

from mbds_xsim.base.arrays import Array
from mbds_xsim.reference.compiling import compiled
from mbds_xsim.reference.lane_algebra import (
    add,
    add_to,
    apply,
    apply_even,
    cross,
    cross_matrix,
    crossed,
    dot,
    inverse_even,
    less_product,
    load3,
    load6,
    load9,
    number3,
    number9,
    outer,
    product,
    rotation_of,
    sub,
    times,
    transposed,
    upper,
    whole,
)
from mbds_xsim.reference.lanes import spread
from mbds_xsim.reference.traced import load, store, traced
from mbds_xsim.reference.tree import BALL, FIXED, FREE, HINGE, SLIDER, Tree

# Kinematics: place, matrix, angular and linear velocity; axis; arms from the centre of mass and
# from the parent's to the joint; linear and angular accelerations due to velocities.
X, R, W, V, AXIS, ARM, REACH, BEND, TWIST = 0, 3, 12, 15, 18, 21, 24, 27, 30
# Loads in W, later the bias; inertia.
F, N, M, H, J = 33, 36, 39, 45, 54
# For ball joints and free bodies: H' and the inverse of J', in place of H and J, which are not read
# any more, so that a link's numbers stay close together; J'⁻¹ H'ᵀ; for free bodies the inverse of
# the remaining M. For hinges and sliders: force and moment that their acceleration needs, and 1/D.
HJ, JI, G, MI = 45, 54, 60, 69
UF, UN, DI = 60, 63, 66
A, ALPHA = 75, 78
PLACES = 81


class Workspace(NamedTuple):
    """Arrays of lanes that kernels write into, each of shape (number, 8)."""

    link: Array
    """`PLACES` numbers of each link and of the world."""
    own: Array
    """Part of each speed's acceleration that is not due to the parent's."""
    load: Array
    """Held forces and moments in W, six numbers of each link and of the world."""
    torque: Array
    """Held torques about hinges, followed by the pushes of drives."""
    grip: Array
    """Dry friction of the joints with a law, against their coordinates."""
    rows: Array
    """Jacobians of closure rows (12), biases, residuals and squared sizes (3)."""
    loads: Array
    """Force and moment of each row on the way down from its first and from its second end (12)."""
    goals: Array
    """Bias of each row on the way down."""
    through: Array
    """Generalised loads of the rows that pass one link (6)."""
    response: Array
    """Rates of the speeds of the links that each row's load passes, per unit of that load."""
    couplings: Array
    """Couplings of rows, numbered as in `Elimination`; those with themselves become inverse."""
    multipliers: Array
    share: Array
    """Least independent share of a row, and largest contradiction of unloaded rows (2)."""


@compiled
def move(t: Tree, work: Workspace, y):
    """Place all bodies, and find their velocities and the accelerations due to these."""
    a = work.link
    for i in range(len(t.kind)):
        p, b, kind = t.parent[i] * PLACES, i * PLACES, t.kind[i]
        at, fast = t.at[i], t.speed_at[i]
        turn, spin = load9(a, p + R), load3(a, p + W)
        if kind == FREE:
            _turn_freely(a, b, y, at + 3, fast + 3)
            store(a, b + X, load3(y, at))
            store(a, b + V, load3(y, fast))
            continue
        reach, slide, bend = apply(turn, number3(t.in_parent, i)), zero(), zero()
        own = spin
        if kind == BALL:
            own = _turn_freely(a, b, y, at, fast)
        else:
            axis = apply(turn, number3(t.axis, i))
            store(a, b + AXIS, axis)
            if kind == HINGE:
                rate = times(load(y, fast), axis)
                own = add(spin, rate)
                store(a, b + TWIST, cross(spin, rate))
                store(a, b + R, product(turn, _hinged(t, i, load(y, at), load(y, at + 1))))
            else:
                store(a, b + R, product(turn, _constant(t.fixed, i)))
            if kind == SLIDER:
                reach = add(reach, times(load(y, at), axis))
                slide = times(load(y, fast), axis)
                bend = times(2.0, cross(spin, slide))
            store(a, b + W, own)
        arm = apply(load9(a, b + R), number3(t.in_child, i))
        swing, roll = cross(spin, reach), cross(own, arm)
        store(a, b + ARM, arm)
        store(a, b + REACH, reach)
        store(a, b + X, sub(add(load3(a, p + X), reach), arm))
        store(a, b + V, add(sub(add(load3(a, p + V), swing), roll), slide))
        store(a, b + BEND, add(bend, sub(cross(spin, swing), cross(own, roll))))


@compiled
def gather(a, speeds, b, p, fast, kind, armature, root):
    """Hand a link's inertia and bias down to its parent; children come before."""
    if kind in (BALL, FREE):
        _gather_ball(a, speeds, b, p, fast, kind, root)
    else:
        _gather_axis(a, speeds, b, p, fast, kind, armature, root)


@traced
def _at_joint(a, b):
    """Return H', J', f' and n' of a link at its joint."""
    m, h, arm = load6(a, b + M), load9(a, b + H), load3(a, b + ARM)
    bend = load3(a, b + BEND)
    hj = add(h, crossed(whole(m), arm))
    jj = add(load6(a, b + J), upper(crossed(transposed(h), arm)))
    jj = sub(jj, upper(cross_matrix(arm, hj)))
    f = add(load3(a, b + F), apply_even(m, bend))
    n = sub(add(load3(a, b + N), apply(transposed(h), bend)), cross(arm, f))
    return hj, jj, f, n


@compiled
def _gather_ball(a, speeds, b, p, fast, kind, root):
    if kind == FREE:
        hj, jj, f, n = load9(a, b + H), load6(a, b + J), load3(a, b + F), load3(a, b + N)
        fast += 3
    else:
        hj, jj, f, n = _at_joint(a, b)
    inverse = inverse_even(jj)
    g = product(whole(inverse), transposed(hj))
    store(a, b + HJ, hj)
    store(a, b + JI, inverse)
    store(a, b + G, g)
    own = apply_even(inverse, n)
    store(speeds, fast, own)
    if root and kind == BALL:
        return  # the world takes no inertia
    m, f = less_product(load6(a, b + M), hj, g), sub(f, apply(hj, own))
    if kind == FREE:
        inverse_mass = inverse_even(m)
        store(a, b + MI, inverse_mass)
        store(speeds, fast - 3, apply_even(inverse_mass, f))
        return
    reach = load3(a, b + REACH)
    mine = crossed(whole(m), reach)
    turned = cross_matrix(reach, mine)
    _give(a, p, m, times(-1.0, mine), times(-1.0, upper(turned)), f, cross(reach, f))


@compiled
def _gather_axis(a, speeds, b, p, fast, kind, armature, root):
    hj, jj, f, n = _at_joint(a, b)
    m, axis, twist = load6(a, b + M), load3(a, b + AXIS), load3(a, b + TWIST)
    if kind == HINGE:
        f, n = add(f, apply(hj, twist)), add(n, apply_even(jj, twist))
        uf, un = apply(hj, axis), apply_even(jj, axis)
        inverse = 1.0 / (dot(axis, un) + armature)
        own = -inverse * dot(axis, n)
    elif kind == SLIDER:
        uf, un = apply_even(m, axis), apply(transposed(hj), axis)
        inverse = 1.0 / (dot(axis, uf) + armature)
        own = -inverse * dot(axis, f)
    else:
        uf, un, inverse, own = zero(), zero(), spread(0.0), spread(0.0)
    if kind != FIXED:
        store(a, b + UF, uf)
        store(a, b + UN, un)
        store(a, b + DI, inverse)
        store(speeds, fast, own)
    if root:
        return
    kf, kn = times(inverse, uf), times(inverse, un)
    m, j = sub(m, upper(outer(kf, uf))), sub(jj, upper(outer(kn, un)))
    h = sub(hj, outer(kf, un))
    f, n, reach = add(f, times(own, uf)), add(n, times(own, un)), load3(a, b + REACH)
    out = sub(h, crossed(whole(m), reach))
    # J + Y H − Hᵀ Y − Y M Y, of which the first two terms and the last are J + Y (H − M Y).
    j = add(j, upper(cross_matrix(reach, out)))
    j = sub(j, upper(crossed(transposed(h), reach)))
    _give(a, p, m, out, j, f, add(n, cross(reach, f)))


@traced
def _give(a, p, m, h, j, f, n):
    """Add inertia and bias to those of the parent."""
    add_to(a, p + M, m)
    add_to(a, p + H, h)
    add_to(a, p + J, j)
    add_to(a, p + F, f)
    add_to(a, p + N, n)


@compiled
def spread_out(a, speeds, b, p, fast, kind):
    """Find the acceleration of a link from that of its parent."""
    if kind == FREE:
        linear = times(-1.0, load3(speeds, fast))
        turning = apply(load9(a, b + G), linear)
        store(a, b + A, linear)
        store(a, b + ALPHA, times(-1.0, add(turning, load3(speeds, fast + 3))))
        return
    beside = load3(a, p + ALPHA)
    linear = add(load3(a, p + A), cross(beside, load3(a, b + REACH)))
    if kind == BALL:
        turning = apply(load9(a, b + G), linear)
        turning = times(-1.0, add(turning, load3(speeds, fast)))
    else:
        turning = beside
        if kind != FIXED:
            bound = dot(load3(a, b + UF), linear) + dot(load3(a, b + UN), beside)
            free = load(speeds, fast) - load(a, b + DI) * bound
            # The speed's own acceleration, for `rates`.
            store(a, b + MI, free)
            moved = times(free, load3(a, b + AXIS))
            if kind == HINGE:
                turning = add(turning, add(moved, load3(a, b + TWIST)))
            else:
                linear = add(linear, moved)
    linear = add(linear, load3(a, b + BEND))
    store(a, b + ALPHA, turning)
    store(a, b + A, add(linear, cross(load3(a, b + ARM), turning)))


@compiled
def rates(t: Tree, work: Workspace, y, rate, first):
    """Write the time derivative of a state from the accelerations of the bodies."""
    a = work.link
    for i in range(len(t.kind)):
        b, kind, at, fast = i * PLACES, t.kind[i], t.at[i], t.speed_at[i]
        if kind == HINGE:
            half = 0.5 * load(y, fast)
            store(rate, first + at, -half * load(y, at + 1))
            store(rate, first + at + 1, half * load(y, at))
            store(rate, first + fast, load(a, b + MI))
        elif kind == SLIDER:
            store(rate, first + at, load(y, fast))
            store(rate, first + fast, load(a, b + MI))
        elif kind == FREE:
            store(rate, first + at, load3(y, fast))
            store(rate, first + fast, load3(a, b + A))
            _turning_rate(y, at + 3, fast + 3, rate, first)
            store(rate, first + fast + 3, load3(a, b + ALPHA))
        elif kind == BALL:
            _turning_rate(y, at, fast, rate, first)
            store(rate, first + fast, load3(a, b + ALPHA))
    for k in range(len(t.law)):
        if t.law_kind[k] == HINGE:
            p, c = t.law_ends[0, k] * PLACES, t.law_ends[1, k] * PLACES
            axis = apply(load9(a, p + R), number3(t.law_axis, k))
            store(rate, first + t.angle_at[k], dot(axis, sub(load3(a, c + W), load3(a, p + W))))


@traced
def _turning_rate(y, at, fast, rate, first):
    w, v, spin = load(y, at), load3(y, at + 1), times(0.5, load3(y, fast))
    store(rate, first + at, -dot(spin, v))
    store(rate, first + at + 1, add(times(w, spin), cross(spin, v)))


@traced
def _turn_freely(a, b, y, at, fast):
    turn = load(y, at), load(y, at + 1), load(y, at + 2), load(y, at + 3)
    store(a, b + R, rotation_of(turn))
    spin = load3(y, fast)
    store(a, b + W, spin)
    return spin


@compiled
def _hinged(t, i, c, s):
    """Return the rotation matrix from a hinge's child to its parent."""
    f = 2.0 / (c * c + s * s)
    # sin φ and 1 − cos φ.
    k, m = f * c * s, f * s * s
    return (
        t.fixed[i, 0] + k * t.odd[i, 0] + m * t.even[i, 0],
        t.fixed[i, 1] + k * t.odd[i, 1] + m * t.even[i, 1],
        t.fixed[i, 2] + k * t.odd[i, 2] + m * t.even[i, 2],
        t.fixed[i, 3] + k * t.odd[i, 3] + m * t.even[i, 3],
        t.fixed[i, 4] + k * t.odd[i, 4] + m * t.even[i, 4],
        t.fixed[i, 5] + k * t.odd[i, 5] + m * t.even[i, 5],
        t.fixed[i, 6] + k * t.odd[i, 6] + m * t.even[i, 6],
        t.fixed[i, 7] + k * t.odd[i, 7] + m * t.even[i, 7],
        t.fixed[i, 8] + k * t.odd[i, 8] + m * t.even[i, 8],
    )


@compiled
def _constant(m, i):
    # As a part of `move`, this changes which of its products are fused with sums: last bits.
    return number9(m, i)


@compiled
def zero():
    """Return the vector of zeros."""
    o = spread(0.0)
    return o, o, o

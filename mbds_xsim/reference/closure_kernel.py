"""Loop closures of a tree: few multipliers, eight states at once.

A row's unit load K is handed down its path by the recursion of `tree_kernel.gather`. At each speed
on the way it gives a generalised load w and causes an acceleration z = D⁻¹ w. The coupling G of
rows beyond a link is the sum of w · z over the speeds there. The least constraint of everything
that hangs on a link with acceleration a is then ½ a·H a + h·a + λ·(K a + k) − ½ λ·G λ, and a row
whose λ acts nowhere else is eliminated: H grows by K K/G, h by K k/G (Vereshchagin 1989; Brandl,
Johanni & Otter 1987), and K, k and G of the rows coupled with it change accordingly. If all rows
are kept up to the world, G is A = J M⁻¹ Jᵀ. `elimination` decides which row is eliminated where.
The load of a coupling acts on two coordinates only.
"""

from __future__ import annotations

from mbds_xsim.reference.compiling import compiled
from mbds_xsim.reference.elimination import BOTH, SECOND
from mbds_xsim.reference.lane_algebra import (
    add,
    add_to,
    apply,
    apply_even,
    cross,
    dot,
    load3,
    load6,
    load9,
    outer,
    sub,
    times,
    upper,
)
from mbds_xsim.reference.lanes import larger, positive, root, size, spread
from mbds_xsim.reference.load_kernel import act, still, weigh
from mbds_xsim.reference.row_kernel import ROW, along, contradiction, put_rows
from mbds_xsim.reference.traced import load, store
from mbds_xsim.reference.tree import BALL, COUPLED, FIXED, FREE, HINGE
from mbds_xsim.reference.tree_kernel import (
    ALPHA,
    ARM,
    AXIS,
    BEND,
    DI,
    HJ,
    JI,
    MI,
    PLACES,
    REACH,
    TWIST,
    UF,
    UN,
    A,
    F,
    H,
    J,
    M,
    N,
    V,
    W,
    gather,
    move,
    rates,
    spread_out,
    zero,
)

_TINY = 1e-300
_NOTHING = 1e-9  # acceleration that counts as none [m/s² or rad/s²]


@compiled
def accelerate(t, work, y, rate, first):
    """Write the time derivative of states."""
    move(t, work, y)
    act(t, work, y)
    weigh(t, work)
    if len(t.row.kind):
        put_rows(t, work, y)
        for k in range(t.loaded):
            store(work.goals, k, load(work.rows, ROW * k + 12))
    _inwards(t, work)
    _outwards(t, work)
    if len(t.row.kind):
        contradiction(t, work, y)
    rates(t, work, y, rate, first)


@compiled
def project(t, work, y):
    """Project states onto the closures by least mass-weighted changes; normalise quaternions."""
    if len(t.row.kind):
        for step in range(2):
            resist(t, work, y, step)
            _outwards(t, work)
            _change(t, work, y, step)
    _normalise(t, y)


@compiled
def resist(t, work, y, step):
    """Eliminate the rows in the absence of loads; goals are residuals in step 0, then rates."""
    move(t, work, y)
    still(t, work)
    weigh(t, work)
    put_rows(t, work, y)
    for k in range(t.loaded):
        off = load(work.rows, ROW * k + 13) if step == 0 else along(t, work, y, k, V, W)
        store(work.goals, k, off)
    still(t, work)
    for i in range(len(t.kind)):
        store(work.link, i * PLACES + BEND, zero())
        store(work.link, i * PLACES + TWIST, zero())
    _inwards(t, work)


@compiled
def _inwards(t, work):
    """Hand inertias, biases and the rows' loads down to the roots, and eliminate the rows."""
    plan, world = t.plan, len(t.kind)
    for k in range(t.loaded):
        for at in range(0, 12, 3):
            store(work.loads, 12 * k + at, load3(work.rows, ROW * k + at))
    for k in range(len(plan.pair_row)):
        store(work.couplings, k, spread(0.0))
    store(work.share, 0, spread(1.0))
    store(work.share, 1, spread(_NOTHING))
    for back in range(world):
        i = world - 1 - back
        if plan.drop[i, 0] < plan.drop[i, 1]:
            _eliminate(t, work, i)
        p, fast, kind = t.parent[i], t.speed_at[i], t.kind[i]
        root = p == world
        gather(work.link, work.own, i * PLACES, p * PLACES, fast, kind, t.armature[i], root)
        if plan.on_start[i] < plan.on_start[i + 1]:
            _pass_on(t, work, i)
    _eliminate(t, work, world)


@compiled
def _eliminate(t, work, i):
    """Eliminate the rows that meet at a link from those that they are coupled with."""
    for d in range(t.plan.drop[i, 0], t.plan.drop[i, 1]):
        _take_out(t.plan, work, d)
        if i < len(t.kind):
            _stiffen(work, i * PLACES, t.plan.drop_row[d])


@compiled
def _take_out(plan, work, d):
    loads, m, k = work.loads, work.couplings, plan.drop_row[d]
    whole = add(load6(loads, 12 * k), load6(loads, 12 * k + 6))
    store(loads, 12 * k, whole)
    pivot, least, goal = load(m, k), load(work.share, 0), load(work.goals, k)
    share = pivot / load(work.rows, ROW * k + 14)
    store(work.share, 0, positive(least - share, share, least))
    inverse = 1.0 / larger(pivot, spread(_TINY))
    store(m, k, inverse)
    first, at = plan.near_start[d], plan.fill_start[d]
    for q in range(first, plan.near_start[d + 1]):
        o = plan.near_row[q]
        weight = inverse * load(m, plan.near_pair[q])
        store(work.goals, o, load(work.goals, o) - weight * goal)
        o = 12 * o + (6 if plan.near_end[q] == SECOND else 0)
        add_to(loads, o, times(-1.0 * weight, whole))
        for r in range(first, q + 1):
            pair = plan.fill_pair[at]
            store(m, pair, load(m, pair) - weight * load(m, plan.near_pair[r]))
            at += 1


@compiled
def _stiffen(work, b, k):
    """Add the resistance of an eliminated row to a link's inertia and bias."""
    a, loads, goal = work.link, work.loads, load(work.goals, k)
    f, n, inverse = load3(loads, 12 * k), load3(loads, 12 * k + 3), load(work.couplings, k)
    x, y = times(inverse, f), times(inverse, n)
    add_to(a, b + M, upper(outer(x, f)))
    add_to(a, b + H, outer(f, y))
    add_to(a, b + J, upper(outer(y, n)))
    add_to(a, b + F, times(goal, x))
    add_to(a, b + N, times(goal, y))


@compiled
def _pass_on(t, work, i):
    """Pass the rows' loads through a link, and couple the rows by their effects on its speeds."""
    plan, a, b, fast = t.plan, work.link, i * PLACES, t.speed_at[i]
    first, last, speeds = plan.on_start[i], plan.on_start[i + 1], t.speed_at[i + 1] - t.speed_at[i]
    bend, twist, pair = load3(a, b + BEND), load3(a, b + TWIST), plan.pair_start[i]
    for q in range(first, last):
        k, end, at = plan.on_row[q], plan.on_end[q], 12 * plan.on_row[q]
        if end == SECOND:
            at += 6
        f, n = load3(work.loads, at), load3(work.loads, at + 3)
        if end == BOTH:
            f, n = add(f, load3(work.loads, at + 6)), add(n, load3(work.loads, at + 9))
            store(work.loads, at + 6, zero())
            store(work.loads, at + 9, zero())
        goal, w = load(work.goals, k) + dot(f, bend), 6 * (q - first)
        if t.kind[i] == HINGE:
            goal = goal + dot(sub(n, cross(load3(a, b + ARM), f)), twist)
        f, n = _respond_at(work, b, t.kind[i], w, plan.on_speed[q], f, n)
        if t.row.kind[k] == COUPLED:
            f, n = _drive(t, work, i, k, w, plan.on_speed[q], f, n)
        for s in range(speeds):
            goal = goal - load(work.through, w + s) * load(work.own, fast + s)
        store(work.goals, k, goal)
        store(work.loads, at, f)
        store(work.loads, at + 3, n)
        for r in range(first, q + 1):
            total = load(work.couplings, plan.on_pair[pair])
            z = plan.on_speed[r]
            for s in range(speeds):
                total = total + load(work.through, w + s) * load(work.response, z + s)
            store(work.couplings, plan.on_pair[pair], total)
            pair += 1
        if t.row.kind[k] == COUPLED:
            own, z = load(work.rows, ROW * k + 14), plan.on_speed[q]
            for s in range(speeds):  # a fixed joint has none
                own = own + load(work.through, w + s) * load(work.response, z + s)
            store(work.rows, ROW * k + 14, own)


@compiled
def _respond_at(work, b, kind, w, z, f, n):
    """Pass a load through a link, and store its parts and effects at the link's speeds."""
    a, out, response = work.link, work.through, work.response
    if kind == FREE:
        turn = apply_even(load6(a, b + JI), n)
        store(out, w + 3, n)
        store(response, z + 3, turn)
        f = sub(f, apply(load9(a, b + HJ), turn))
        store(out, w, f)
        store(response, z, apply_even(load6(a, b + MI), f))
        return zero(), zero()
    n = sub(n, cross(load3(a, b + ARM), f))
    reach = load3(a, b + REACH)
    if kind == BALL:
        turn = apply_even(load6(a, b + JI), n)
        store(out, w, n)
        store(response, z, turn)
        f = sub(f, apply(load9(a, b + HJ), turn))
        return f, cross(reach, f)
    if kind != FIXED:
        load_along = -dot(load3(a, b + AXIS), n if kind == HINGE else f)
        effect = load(a, b + DI) * load_along
        store(out, w, load_along)
        store(response, z, effect)
        f = add(f, times(effect, load3(a, b + UF)))
        n = add(n, times(effect, load3(a, b + UN)))
    return f, add(n, cross(reach, f))


@compiled
def _drive(t, work, i, k, w, z, f, n):
    """Let a coupling's load act on a link's coordinate if it is one of the coupling's two."""
    for end in range(2):
        if t.row.ends[k, end] == i:
            a, b, more = work.link, i * PLACES, -t.row.way[k, end]
            effect = more * load(a, b + DI)
            store(work.through, w, load(work.through, w) + more)
            store(work.response, z, load(work.response, z) + effect)
            pull = times(effect, load3(a, b + UF))
            f = add(f, pull)
            n = add(n, add(times(effect, load3(a, b + UN)), cross(load3(a, b + REACH), pull)))
    return f, n


@compiled
def _outwards(t, work):
    """Find multipliers and accelerations from the world outwards."""
    plan, world = t.plan, len(t.kind)
    _find_multipliers(t, work, world)
    for i in range(world):
        fast, speeds = t.speed_at[i], t.speed_at[i + 1] - t.speed_at[i]
        for q in range(plan.on_start[i], plan.on_start[i + 1]):
            weight = load(work.multipliers, plan.on_row[q])
            for s in range(speeds):
                more = weight * load(work.response, plan.on_speed[q] + s)
                store(work.own, fast + s, load(work.own, fast + s) + more)
        p = t.parent[i] * PLACES
        spread_out(work.link, work.own, i * PLACES, p, fast, t.kind[i])
        if plan.drop[i, 0] < plan.drop[i, 1]:
            _find_multipliers(t, work, i)


@compiled
def _find_multipliers(t, work, i):
    """Find the multipliers of the rows eliminated at a link, the last row first."""
    plan, a, b = t.plan, work.link, i * PLACES
    for back in range(plan.drop[i, 1] - plan.drop[i, 0]):
        d = plan.drop[i, 1] - 1 - back
        k = plan.drop_row[d]
        total = load(work.goals, k)
        if i < len(t.kind):
            total = total + dot(load3(work.loads, 12 * k), load3(a, b + A))
            total = total + dot(load3(work.loads, 12 * k + 3), load3(a, b + ALPHA))
        store(work.share, 1, larger(load(work.share, 1), size(total)))
        for q in range(plan.near_start[d], plan.near_start[d + 1]):
            coupling = load(work.couplings, plan.near_pair[q])
            total = total - coupling * load(work.multipliers, plan.near_row[q])
        store(work.multipliers, k, load(work.couplings, k) * total)


@compiled
def _change(t, work, y, speeds):
    """Change coordinates or speeds by the amounts that `spread_out` found."""
    a = work.link
    for i in range(len(t.kind)):
        b, kind, at, fast = i * PLACES, t.kind[i], t.at[i], t.speed_at[i]
        if kind == FIXED:
            continue
        if kind in (BALL, FREE):
            turn = load3(a, b + ALPHA)
            if kind == FREE:
                place = fast if speeds else at
                add_to(y, place, load3(a, b + A))
                at, fast = at + 3, fast + 3
            if speeds:
                add_to(y, fast, turn)
            else:
                w, v, half = load(y, at), load3(y, at + 1), times(0.5, turn)
                store(y, at, w - dot(half, v))
                store(y, at + 1, add(v, add(times(w, half), cross(half, v))))
            continue
        change = load(a, b + MI)
        if speeds:
            store(y, fast, load(y, fast) + change)
        elif kind == HINGE:
            c, s = load(y, at), load(y, at + 1)
            store(y, at, c - 0.5 * change * s)
            store(y, at + 1, s + 0.5 * change * c)
        else:
            store(y, at, load(y, at) + change)
    if not speeds:
        for k in range(len(t.law)):
            if t.angle_link[k] >= 0:
                change = load(a, t.angle_link[k] * PLACES + MI)
                store(y, t.angle_at[k], load(y, t.angle_at[k]) + change)


@compiled
def _normalise(t, y):
    for i in range(len(t.kind)):
        kind, at = t.kind[i], t.at[i]
        count = 2 if kind == HINGE else 4
        if kind == FREE:
            at += 3
        if kind in (HINGE, BALL, FREE):
            total = spread(0.0)
            for k in range(count):
                total = total + load(y, at + k) * load(y, at + k)
            f = 1.0 / root(total)
            for k in range(count):
                store(y, at + k, f * load(y, at + k))

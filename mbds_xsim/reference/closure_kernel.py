"""Loop closures of a tree: few multipliers, eight states at once.

With the rows' Jacobian J, A = J M⁻¹ Jᵀ (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter
8). A row's unit load, handed down its path to the roots by the recursion that `tree_kernel.gather`
prepared, gives at each speed a generalised load w and the acceleration z = D⁻¹ w that it brings
there (`response_kernel`), and A is the sum of w · z over the speeds, link by link. The multipliers'
loads go down once more, all together. Rows are those of `mbds_xsim.scene.constraints`, and behind
them couplings.
"""

from __future__ import annotations

from mbds_xsim.reference.lanes import (
    add,
    add_to3,
    apply,
    compiled,
    cross,
    dot,
    larger,
    load,
    load3,
    load9,
    number3,
    positive,
    root,
    size,
    spread,
    store,
    store3,
    sub,
    times,
)
from mbds_xsim.reference.load_kernel import act, still, weigh
from mbds_xsim.reference.response_kernel import ROW, load_own, respond
from mbds_xsim.reference.tree import (
    ALONG,
    BALL,
    COUPLED,
    DISTANCE,
    FIXED,
    FREE,
    HINGE,
    NORMAL,
    Tree,
)
from mbds_xsim.reference.tree_kernel import (
    ALPHA,
    MI,
    PLACES,
    A,
    R,
    V,
    W,
    Workspace,
    X,
    gather,
    move,
    rates,
    spread_out,
    zero,
)

_LOST = 1e-300
_NOTHING = 1e-9  # acceleration [m/s² or rad/s²]


@compiled
def accelerate(t: Tree, work: Workspace, y, rate, first):
    """Write the time derivative of states."""
    move(t, work, y)
    act(t, work, y)
    weigh(t, work)
    gather(t, work)
    spread_out(t, work, True)
    if len(t.row_kind):
        _rows(t, work, y)
        respond(t, work)
        _factor(t, work)
        most = spread(_NOTHING)
        for k in range(t.loaded):
            goal = _along(t, work, y, k, A, ALPHA) + load(work.rows, ROW * k + 12)
            most = larger(most, size(goal))
            store(work.multipliers, k, -goal)
        _solve(t, work)
        load_own(t, work)
        spread_out(t, work, True)
        _contradiction(t, work, y, most)
    rates(t, work, y, rate, first)


@compiled
def project(t: Tree, work: Workspace, y):
    """Put states onto the closures by least mass-weighted changes; unit quaternions."""
    if len(t.row_kind):
        for step in range(2):
            resist(t, work, y)
            _factor(t, work)
            for k in range(t.loaded):
                off = load(work.rows, ROW * k + 13) if step == 0 else _along(t, work, y, k, V, W)
                store(work.multipliers, k, -off)
            _solve(t, work)
            for k in range(t.place_count, t.size):
                store(work.own, k, spread(0.0))
            load_own(t, work)
            spread_out(t, work, False)
            _change(t, work, y, step)
    _normalise(t, y)


@compiled
def resist(t: Tree, work: Workspace, y):
    """Evaluate the rows of states, and A."""
    move(t, work, y)
    still(t, work)
    weigh(t, work)
    gather(t, work)
    _rows(t, work, y)
    respond(t, work)


@compiled
def _rows(t, work, y):
    """Evaluate all rows after `move`."""
    a, rows = work.link, work.rows
    for k in range(len(t.row_kind)):
        kind, p, c = t.row_kind[k], t.row_ends[0, k] * PLACES, t.row_ends[1, k] * PLACES
        if kind == COUPLED:
            for j in range(ROW):
                store(rows, ROW * k + j, spread(0.0))
            here, there = load(y, t.row_place[0, k]), load(y, t.row_place[1, k])
            store(rows, ROW * k + 13, here + t.row_way[k, 1] * there - t.row_length[k])
            continue
        turn, spin, other = load9(a, p + R), load3(a, p + W), load3(a, c + W)
        first = apply(turn, number3(t.row_points[0], k))
        second = apply(load9(a, c + R), number3(t.row_points[1], k))
        swing, roll = cross(spin, first), cross(other, second)
        line = sub(add(sub(load3(a, c + X), load3(a, p + X)), second), first)
        bend = sub(cross(other, roll), cross(spin, swing))
        speed = sub(add(load3(a, c + V), roll), add(load3(a, p + V), swing))
        way = number3(t.row_way, k)
        if kind == DISTANCE:
            length = root(dot(line, line))
            n = times(1.0 / length, line)
            along = dot(n, speed)
            grown = dot(n, bend) + (dot(speed, speed) - along * along) / length
            store(rows, ROW * k + 12, grown)
            store(rows, ROW * k + 13, length - t.row_length[k])
        else:
            n = apply(turn, way)
            n_rate = cross(spin, n)
            n_bend = cross(spin, n_rate)
            if kind == ALONG:
                grown = dot(n, bend) + 2.0 * dot(n_rate, speed) + dot(n_bend, line)
                store(rows, ROW * k + 12, grown)
                store(rows, ROW * k + 13, dot(n, line))
                first = add(first, line)
            else:
                grown = dot(cross(other, roll), n) + 2.0 * dot(roll, n_rate) + dot(second, n_bend)
                store(rows, ROW * k + 12, grown)
                store(rows, ROW * k + 13, dot(second, n))
        if kind == NORMAL:
            lever = cross(second, n)
            _put(t, rows, k, zero(), times(-1.0, lever), lever)
        else:
            _put(t, rows, k, n, cross(n, first), cross(second, n))


@compiled
def _put(t, rows, k, n, first, second):
    """Keep a row of opposite linear parts, and its size."""
    b = ROW * k
    store3(rows, b, times(-1.0, n))
    store3(rows, b + 3, first)
    store3(rows, b + 6, n)
    store3(rows, b + 9, second)
    p, c, linear = t.row_ends[0, k], t.row_ends[1, k], dot(n, n)
    total = (t.yielding[p, 0] + t.yielding[c, 0]) * linear
    total = total + t.yielding[p, 1] * dot(first, first)
    store(rows, b + 14, total + t.yielding[c, 1] * dot(second, second))


@compiled
def _along(t, work, y, k, linear, angular):
    """Multiply a row and vectors of the bodies, or what speeds and their accelerations are."""
    a, rows, b = work.link, work.rows, ROW * k
    p, c = t.row_ends[0, k] * PLACES, t.row_ends[1, k] * PLACES
    if t.row_kind[k] == COUPLED:
        first, second = load(a, p + MI), load(a, c + MI)
        if linear == V:
            first = load(y, t.speed_at[t.row_ends[0, k]])
            second = load(y, t.speed_at[t.row_ends[1, k]])
        return first + t.row_way[k, 1] * second
    one = dot(load3(rows, b), load3(a, p + linear)) + dot(load3(rows, b + 3), load3(a, p + angular))
    two = dot(load3(rows, b + 6), load3(a, c + linear))
    return one + two + dot(load3(rows, b + 9), load3(a, c + angular))


@compiled
def _factor(t, work):
    """Put A's Cholesky factor in its place, with the inverse pivots on the diagonal."""
    count, m, least = t.loaded, work.matrix, spread(1.0)
    for k in range(count):
        for j in range(k + 1):
            total = load(m, k * count + j)
            for s in range(j):
                total = total - load(m, k * count + s) * load(m, j * count + s)
            if j < k:
                store(m, k * count + j, total * load(m, j * count + j))
            else:
                share = total / load(work.rows, ROW * k + 14)
                least = positive(least - share, share, least)
                pivot = root(larger(total, spread(_LOST)))
                store(m, k * count + k, 1.0 / pivot)
    store(work.share, 0, least)


@compiled
def _solve(t, work):
    """Solve for the multipliers in place of the right-hand sides."""
    count, m, x = t.loaded, work.matrix, work.multipliers
    for k in range(count):
        total = load(x, k)
        for j in range(k):
            total = total - load(m, k * count + j) * load(x, j)
        store(x, k, total * load(m, k * count + k))
    for q in range(count):
        k = count - 1 - q
        total = load(x, k)
        for j in range(k + 1, count):
            total = total - load(m, j * count + k) * load(x, j)
        store(x, k, total * load(m, k * count + k))


@compiled
def _contradiction(t, work, y, most):
    """Measure by how much rows without loads do not follow from the others, over the goals."""
    off = spread(0.0)
    for k in range(t.loaded, len(t.row_kind)):
        bias = load(work.rows, ROW * k + 12)
        off = larger(off, size(_along(t, work, y, k, A, ALPHA) + bias))
    store(work.share, 1, off / most)


@compiled
def _change(t, work, y, speeds):
    """Move places, or change speeds, by what `spread_out` found."""
    a = work.link
    for i in range(len(t.kind)):
        b, kind, at, fast = i * PLACES, t.kind[i], t.at[i], t.speed_at[i]
        if kind == FIXED:
            continue
        if kind in (BALL, FREE):
            turn = load3(a, b + ALPHA)
            if kind == FREE:
                place = fast if speeds else at
                add_to3(y, place, load3(a, b + A))
                at, fast = at + 3, fast + 3
            if speeds:
                add_to3(y, fast, turn)
            else:
                w, v, half = load(y, at), load3(y, at + 1), times(0.5, turn)
                store(y, at, w - dot(half, v))
                store3(y, at + 1, add(v, add(times(w, half), cross(half, v))))
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

"""What loads of closure rows bring about on their way down a tree to its roots.

A row's unit load gives at each speed that it comes through a generalised load w and the
acceleration z = D⁻¹ w that it brings there. The load of a coupling acts on two coordinates alone.
"""

from __future__ import annotations

from mbds_xsim.reference.lanes import (
    add,
    add_to3,
    apply,
    apply_even,
    compiled,
    cross,
    dot,
    load,
    load3,
    load6,
    load9,
    spread,
    store,
    store3,
    sub,
    times,
)
from mbds_xsim.reference.load_kernel import still
from mbds_xsim.reference.tree import BALL, BOTH, COUPLED, FIXED, FREE, HINGE, SECOND, Tree
from mbds_xsim.reference.tree_kernel import (
    ARM,
    AXIS,
    DI,
    HJ,
    JI,
    MI,
    PLACES,
    REACH,
    UF,
    UN,
    F,
    N,
    Workspace,
)

ROW = 15
"""Numbers of a row: (v, ω) of the first end, of the second, bias, residual, size squared."""


@compiled
def respond(t: Tree, work: Workspace):
    """Hand each loaded row's unit load down to the roots, and sum up A, its lower half."""
    rows, loads, count = work.rows, work.loads, t.loaded
    for k in range(count):
        for end in range(2):
            for half in range(2):
                at = 6 * end + 3 * half
                store3(loads, 12 * k + at, times(-1.0, load3(rows, ROW * k + at)))
        for j in range(k + 1):
            store(work.matrix, k * count + j, spread(0.0))
    # Links outside, so that what is known of one is read once for all rows.
    for back in range(len(t.kind)):
        i = len(t.kind) - 1 - back
        for q in range(t.on_start[i], t.on_start[i + 1]):
            k, end = t.on_row[q], t.on_end[q]
            at = 12 * k + (6 if end == SECOND else 0)
            f, n = load3(loads, at), load3(loads, at + 3)
            if end == BOTH:
                f, n = add(f, load3(loads, at + 6)), add(n, load3(loads, at + 9))
            out = 12 * (q - t.on_start[i])
            f, n = _respond_at(work, i * PLACES, t.kind[i], out, f, n)
            if t.row_kind[k] == COUPLED:
                f, n = _drive(t, work, i, k, spread(1.0), out, f, n)
            store3(loads, at, f)
            store3(loads, at + 3, n)
        _couple(t, work, i)
    for k in range(count):
        if t.row_kind[k] == COUPLED:
            store(rows, ROW * k + 14, load(work.matrix, k * count + k))


@compiled
def _couple(t, work, i):
    """Add to A what the rows whose loads come through a link have in common there."""
    first, passed, m = t.on_start[i], work.passed, work.matrix
    speeds = t.speed_at[i + 1] - t.speed_at[i]
    for q in range(t.on_start[i + 1] - first):
        k = t.on_row[first + q] * t.loaded
        if speeds == 3:
            x, y, z = load(passed, 12 * q), load(passed, 12 * q + 2), load(passed, 12 * q + 4)
            for r in range(q + 1):
                at = k + t.on_row[first + r]
                total = load(m, at) + x * load(passed, 12 * r + 1)
                total = total + y * load(passed, 12 * r + 3)
                store(m, at, total + z * load(passed, 12 * r + 5))
        else:
            for r in range(q + 1):
                total = load(m, k + t.on_row[first + r])
                for s in range(0, 2 * speeds, 2):
                    total = total + load(passed, 12 * q + s) * load(passed, 12 * r + s + 1)
                store(m, k + t.on_row[first + r], total)


@compiled
def _respond_at(work, b, kind, at, f, n):
    """Take a load through one link; w and z stand at `at`, speed by speed."""
    a, out = work.link, work.passed
    if kind == FREE:
        z = apply_even(load6(a, b + JI), n)
        f = sub(f, apply(load9(a, b + HJ), z))
        _keep(out, at + 6, n, z)
        _keep(out, at, f, apply_even(load6(a, b + MI), f))
        return f, n
    n = sub(n, cross(load3(a, b + ARM), f))
    reach = load3(a, b + REACH)
    if kind == BALL:
        z = apply_even(load6(a, b + JI), n)
        _keep(out, at, n, z)
        f = sub(f, apply(load9(a, b + HJ), z))
        return f, cross(reach, f)
    if kind != FIXED:
        w = -dot(load3(a, b + AXIS), n if kind == HINGE else f)
        z = load(a, b + DI) * w
        store(out, at, w)
        store(out, at + 1, z)
        f = add(f, times(z, load3(a, b + UF)))
        n = add(n, times(z, load3(a, b + UN)))
    return f, add(n, cross(reach, f))


@compiled
def _drive(t, work, i, k, share, at, f, n):
    """Let a share of a coupling's load act on the coordinate of a link, if it is one of its own."""
    for end in range(2):
        if t.row_ends[end, k] == i:
            a, b, w = work.link, i * PLACES, share * t.row_way[k, end]
            z = load(a, b + DI) * w
            store(work.passed, at, load(work.passed, at) + w)
            store(work.passed, at + 1, load(work.passed, at + 1) + z)
            pull = times(z, load3(a, b + UF))
            f = add(f, pull)
            n = add(n, add(times(z, load3(a, b + UN)), cross(load3(a, b + REACH), pull)))
    return f, n


@compiled
def _keep(out, at, w, z):
    store(out, at, w[0])
    store(out, at + 1, z[0])
    store(out, at + 2, w[1])
    store(out, at + 3, z[1])
    store(out, at + 4, w[2])
    store(out, at + 5, z[2])


@compiled
def load_own(t: Tree, work: Workspace):
    """Add what the multipliers' loads do to the speeds' own parts; F and N are theirs then."""
    a, rows = work.link, work.rows
    still(t, work)
    for k in range(t.loaded):
        weight, b = -load(work.multipliers, k), ROW * k
        p, c = t.row_ends[0, k] * PLACES, t.row_ends[1, k] * PLACES
        add_to3(a, p + F, times(weight, load3(rows, b)))
        add_to3(a, p + N, times(weight, load3(rows, b + 3)))
        add_to3(a, c + F, times(weight, load3(rows, b + 6)))
        add_to3(a, c + N, times(weight, load3(rows, b + 9)))
    for back in range(len(t.kind)):
        i = len(t.kind) - 1 - back
        if t.on_start[i] == t.on_start[i + 1]:
            continue
        b, p, fast = i * PLACES, t.parent[i] * PLACES, t.speed_at[i]
        f, n = _respond_at(work, b, t.kind[i], 0, load3(a, b + F), load3(a, b + N))
        for q in range(t.on_start[i], t.on_start[i + 1]):
            k = t.on_row[q]
            if t.row_kind[k] == COUPLED:
                f, n = _drive(t, work, i, k, load(work.multipliers, k), 0, f, n)
        for s in range(t.speed_at[i + 1] - fast):
            store(work.own, fast + s, load(work.own, fast + s) + load(work.passed, 2 * s + 1))
        add_to3(a, p + F, f)
        add_to3(a, p + N, n)

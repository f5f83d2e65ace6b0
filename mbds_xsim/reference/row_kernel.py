"""Closure rows at states of a tree: Jacobians, biases and residuals.

Rows are those of `mbds_xsim.scene.constraints`, followed by couplings.
"""

from __future__ import annotations

from mbds_xsim.reference.compiling import compiled
from mbds_xsim.reference.lane_algebra import (
    add,
    apply,
    cross,
    dot,
    load3,
    load9,
    number3,
    sub,
    times,
)
from mbds_xsim.reference.lanes import larger, root, size, spread
from mbds_xsim.reference.traced import load, store
from mbds_xsim.reference.tree import ALONG, COUPLED, DISTANCE, NORMAL
from mbds_xsim.reference.tree_kernel import ALPHA, MI, PLACES, A, R, V, W, X, zero

ROW = 15
"""Numbers of a row: (v, ω) of the first end, of the second, bias, residual, size squared."""


@compiled
def put_rows(t, work, y):
    """Evaluate all rows after `move`."""
    a, rows = work.link, work.rows
    for k in range(len(t.row.kind)):
        kind, p, c = t.row.kind[k], t.row.ends[k, 0] * PLACES, t.row.ends[k, 1] * PLACES
        if kind == COUPLED:
            for j in range(ROW):
                store(rows, ROW * k + j, spread(0.0))
            here, there = load(y, t.row.place[k, 0]), load(y, t.row.place[k, 1])
            store(rows, ROW * k + 13, here + t.row.way[k, 1] * there - t.row.length[k])
            continue
        turn, spin, other = load9(a, p + R), load3(a, p + W), load3(a, c + W)
        first = apply(turn, number3(t.row.points[k], 0))
        second = apply(load9(a, c + R), number3(t.row.points[k], 1))
        swing, roll = cross(spin, first), cross(other, second)
        line = sub(add(sub(load3(a, c + X), load3(a, p + X)), second), first)
        bend = sub(cross(other, roll), cross(spin, swing))
        speed = sub(add(load3(a, c + V), roll), add(load3(a, p + V), swing))
        way = number3(t.row.way, k)
        if kind == DISTANCE:
            length = root(dot(line, line))
            n = times(1.0 / length, line)
            along = dot(n, speed)
            bias = dot(n, bend) + (dot(speed, speed) - along * along) / length
            off = length - t.row.length[k]
        else:
            n = apply(turn, way)
            n_rate = cross(spin, n)
            n_bend = cross(spin, n_rate)
            if kind == ALONG:
                bias = dot(n, bend) + 2.0 * dot(n_rate, speed) + dot(n_bend, line)
                off = dot(n, line)
                first = add(first, line)
            else:
                bias = dot(cross(other, roll), n) + 2.0 * dot(roll, n_rate) + dot(second, n_bend)
                off = dot(second, n)
        store(rows, ROW * k + 12, (bias, off))
        if kind == NORMAL:
            lever = cross(second, n)
            _put(t, rows, k, zero(), times(-1.0, lever), lever)
        else:
            _put(t, rows, k, n, cross(n, first), cross(second, n))


@compiled
def _put(t, rows, k, n, first, second):
    """Store a row with opposite linear parts, and its size."""
    b = ROW * k
    store(rows, b, times(-1.0, n))
    store(rows, b + 3, first)
    store(rows, b + 6, n)
    store(rows, b + 9, second)
    p, c, linear = t.row.ends[k, 0], t.row.ends[k, 1], dot(n, n)
    total = (t.yielding[p, 0] + t.yielding[c, 0]) * linear
    total = total + t.yielding[p, 1] * dot(first, first)
    store(rows, b + 14, total + t.yielding[c, 1] * dot(second, second))


@compiled
def along(t, work, y, k, linear, angular):
    """Multiply a row by vectors of its bodies; a coupling by its speeds or their accelerations."""
    a, rows, b = work.link, work.rows, ROW * k
    p, c = t.row.ends[k, 0] * PLACES, t.row.ends[k, 1] * PLACES
    if t.row.kind[k] == COUPLED:
        first, second = load(a, p + MI), load(a, c + MI)
        if linear == V:
            first = load(y, t.speed_at[t.row.ends[k, 0]])
            second = load(y, t.speed_at[t.row.ends[k, 1]])
        return first + t.row.way[k, 1] * second
    one = dot(load3(rows, b), load3(a, p + linear)) + dot(load3(rows, b + 3), load3(a, p + angular))
    two = dot(load3(rows, b + 6), load3(a, c + linear))
    return one + two + dot(load3(rows, b + 9), load3(a, c + angular))


@compiled
def contradiction(t, work, y):
    """Measure how far unloaded rows fail to follow from the others, over the largest goal."""
    off, most = spread(0.0), load(work.share, 1)
    for k in range(t.loaded, len(t.row.kind)):
        bias = load(work.rows, ROW * k + 12)
        off = larger(off, size(along(t, work, y, k, A, ALPHA) + bias))
    store(work.share, 1, off / most)

"""DOP853 over eight trajectories at once, each with its own steps, frames and inputs.

A lane whose trajectory has come to its end gets the next one. Steps, error estimate and restarts
at frames are those of `marching` and `dop853`.

`run` is the only kernel that Python calls, for all operations on a tree. An entry point is compiled
with everything that it calls, and most of that would be the same for several of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mbds_xsim.base.arrays import Array, Index, Mask
from mbds_xsim.reference.closure_kernel import accelerate, project, resist
from mbds_xsim.reference.compiling import compiled, entered
from mbds_xsim.reference.lane_algebra import add, hamilton, times
from mbds_xsim.reference.lanes import LANES, larger, positive, size, spread
from mbds_xsim.reference.load_kernel import hold
from mbds_xsim.reference.noted import noted
from mbds_xsim.reference.traced import load, store, traced
from mbds_xsim.reference.tree import BALL, FREE, HINGE, Tree
from mbds_xsim.reference.tree_kernel import PLACES, A, V, W, Workspace, X, move

MARCH, EVALUATE, ACCELERATE, PROJECT, RESIST, MOVE = range(6)
"""Operations of `run`: integrate the trajectories of a task; evaluate accelerations at its starts;
for the states in `Lane.y`, write their rates to `Lane.stages`, project them onto the closures,
eliminate the rows in the absence of loads, or place all bodies (in `Workspace`)."""

REACHED, STUCK, SINGULAR = 0, 1, 2
"""Status of a trajectory: complete, stopped by too many or too short steps, or singular."""

BLOCK = 4
"""Numbers of a state that are summed up at a time; arrays of them are padded to a multiple."""

_STAGES = 12
_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 6.0


class Scheme(NamedTuple):
    """Coefficients of the method, and its limits."""

    begin: Index
    """First index of each row's weights. Rows are stages 0 to 11, the step, and the estimates of
    its error of order 5 and 3, shape (16,)."""
    stage: Index
    """Stage of each weight; weights of zero are left out."""
    weight: Array
    rtol: float = 0.0
    first: float = 0.0
    smallest: float = 0.0
    most: int = 0
    companions: int = 1
    near: float = 0.0
    follows: float = 1e-4


class Lane(NamedTuple):
    """Integration under way in each lane."""

    row: Index
    """Trajectory, or −1 if the lane is idle."""
    at: Index
    remaining: Array
    step: Array
    tries: Index
    due: Mask
    """Whether a frame begins."""
    h: Array
    ratio: Array
    """Sums of the squared error estimates of order 5 and 3 in rows 1 and 2, shape (3, 8)."""
    worst: Array
    """Worst values of `Workspace.share` over the stages of a step."""
    y: Array
    new: Array
    stages: Array


class Problems(NamedTuple):
    """Trajectories to compute, or states to evaluate."""

    start: Array
    """Coordinates and speeds at the start, shape (trajectory, number)."""
    force: Array
    torque: Array
    frame: float
    states: Array
    """Results, as states, shape (trajectory, frame + 1, body + world, 13), or as accelerations,
    shape (state, 1, body, 6)."""
    status: Index
    grip: Array = np.zeros((0, 0))
    """Dry friction of states whose accelerations are evaluated, shape (state, law)."""


@entered
def run(operation, t: Tree, work: Workspace, method: Scheme, lane: Lane, task: Problems):
    """Carry out one operation, such as `MARCH`."""
    t, work, method, lane, task = noted(t), noted(work), noted(method), noted(lane), noted(task)
    if operation == MARCH:
        _march(t, work, method, lane, task)
    elif operation == EVALUATE:
        _evaluate(t, work, lane, task)
    elif operation == ACCELERATE:
        accelerate(t, work, lane.y, lane.stages, np.int64(0))
    elif operation == PROJECT:
        project(t, work, lane.y)
    elif operation == RESIST:
        resist(t, work, lane.y, np.int64(0))
    else:
        move(t, work, lane.y)


@compiled
def _evaluate(t, work, lane, task):
    """Find accelerations of the bodies at independent states."""
    last = len(task.start) - 1
    for first in range(0, len(task.start), LANES):
        for k in range(LANES):
            row = min(first + k, last)
            for j in range(task.start.shape[1]):
                lane.y[j, k] = task.start[row, j]
            for j in range(task.grip.shape[1]):
                work.grip[j, k] = task.grip[row, j]
            hold(t, work, k, task.force[row, 0], task.torque[row, 0])
        accelerate(t, work, lane.y, lane.stages, np.int64(0))
        for i in range(len(t.kind)):
            for j in range(6):
                for k in range(min(LANES, len(task.start) - first)):
                    task.states[first + k, 0, t.body[i], j] = work.link[i * PLACES + A + j, k]


@compiled
def _march(t, work, method, lane, task):
    """Compute all trajectories of a task: at least one, with at least one frame."""
    following = np.int64(0)
    for k in range(LANES):
        lane.row[k] = -1
    while True:
        following = _begin(method, lane, task, following)
        if _any(lane.due):
            _start_frames(t, work, lane, task)
        under_way = False
        for k in range(LANES):
            under_way = under_way or lane.row[k] >= 0
            if lane.row[k] < 0:
                lane.h[0, k] = 0.0
            else:
                lane.h[0, k] = lane.remaining[k] / math.ceil(lane.remaining[k] / lane.step[k])
        if not under_way:
            return
        _try_step(t, work, method, lane)
        _measure(method, lane)
        _accept(t, method, lane, task)
        _start_frames(t, work, lane, task)


@compiled
def _any(flags):
    any_flag = False
    for k in range(LANES):
        any_flag = any_flag or flags[k]
    return any_flag


@compiled
def _begin(method, lane, task, following):
    """Start the next trajectories in lanes that have finished theirs."""
    companions, count = method.companions, len(task.start)
    for first in range(0, LANES, companions):
        if lane.row[first] < 0 or lane.at[first] == task.force.shape[1]:
            for k in range(first, first + companions):
                lane.row[k] = -1
                if following < count or lane.h[0, k] < 0.0:
                    row = min(following, count - 1)
                    for j in range(task.start.shape[1]):
                        lane.y[j, k] = task.start[row, j]
                if following < count:
                    lane.row[k], lane.due[k] = following, True
                    following += 1
                lane.at[k], lane.tries[k] = 0, 0
                lane.remaining[k], lane.step[k] = task.frame, method.first
    return following


@compiled
def _start_frames(t, work, lane, task):
    """Project states that are due onto the closures, set their loads, and record them.

    The rates of all states are evaluated.
    """
    if _any(lane.due):
        for j in range(t.size):
            store(lane.new, j, load(lane.y, j))
        project(t, work, lane.new)
        for k in range(LANES):
            if lane.due[k]:
                for j in range(t.size):
                    lane.y[j, k] = lane.new[j, k]
                if lane.at[k] < task.force.shape[1]:
                    row, at = lane.row[k], lane.at[k]
                    hold(t, work, k, task.force[row, at], task.torque[row, at])
    accelerate(t, work, lane.y, lane.stages, np.int64(0))
    store(lane.worst, 0, load(work.share, 0))
    store(lane.worst, 1, load(work.share, 1))
    for k in range(LANES):
        if lane.due[k]:
            _record(t, work, lane, k, task.states[lane.row[k], lane.at[k]])
            lane.due[k] = False


@compiled
def _record(t, work, lane, k, out):
    """Write the states of all bodies, shape (body + world, 13)."""
    y, a, world = lane.y, work.link, len(t.kind)
    for j in range(13):
        out[world, j] = 1.0 if j == 3 else 0.0
    for i in range(world):
        kind, at, body = t.kind[i], t.at[i], t.body[i]
        for j in range(3):
            out[body, j] = a[i * PLACES + X + j, k]
            out[body, 7 + j] = a[i * PLACES + V + j, k]
            out[body, 10 + j] = a[i * PLACES + W + j, k]
        if kind in (BALL, FREE):
            first = at + 3 if kind == FREE else at
            for j in range(4):
                out[body, 3 + j] = y[first + j, k]
            continue
        parent = world if t.parent[i] == world else t.body[t.parent[i]]
        turn = (out[parent, 3], out[parent, 4], out[parent, 5], out[parent, 6])
        if kind == HINGE:
            c, s = y[at, k], y[at + 1, k]
            turn = hamilton(turn, (c, s * t.axis[i, 0], s * t.axis[i, 1], s * t.axis[i, 2]))
        turn = hamilton(turn, (t.still[i, 0], t.still[i, 1], t.still[i, 2], t.still[i, 3]))
        out[body, 3], out[body, 4], out[body, 5], out[body, 6] = turn


@compiled
def _try_step(t, work, method, lane):
    """Fill in the stages and the new states of a step."""
    h, count = load(lane.h, 0), len(lane.y)
    for stage in range(1, _STAGES + 1):
        for j in range(0, count, BLOCK):
            change = times(h, _combined(method, stage, lane.stages, count, j))
            store(lane.new, j, add(_block(lane.y, j), change))
        if stage < _STAGES:
            accelerate(t, work, lane.new, lane.stages, stage * count)
            share, off = load(work.share, 0), load(work.share, 1)
            least = load(lane.worst, 0)
            store(lane.worst, 0, positive(least - share, share, least))
            store(lane.worst, 1, larger(load(lane.worst, 1), off))


@compiled
def _combined(method, row, stages, count, j):
    """Sum up the stages with the weights of a row, for a block of numbers at once."""
    o = spread(0.0)
    total = o, o, o, o
    for k in range(method.begin[row], method.begin[row + 1]):
        stage = _block(stages, method.stage[k] * count + j)
        total = add(total, times(method.weight[k], stage))
    return total


@traced
def _block(a, k):
    return tuple(load(a, k + q) for q in range(BLOCK))


@compiled
def _measure(method, lane):
    """Sum up the squares of the two error estimates."""
    fifth, third = spread(0.0), spread(0.0)
    for j in range(0, len(lane.y), BLOCK):
        a = _combined(method, _STAGES + 1, lane.stages, len(lane.y), j)
        b = _combined(method, _STAGES + 2, lane.stages, len(lane.y), j)
        for q in range(BLOCK):
            most = larger(size(load(lane.y, j + q)), size(load(lane.new, j + q)))
            scale = 1.0 / (method.rtol * (1.0 + most))
            one, two = a[q] * scale, b[q] * scale
            fifth, third = fifth + one * one, third + two * two
    store(lane.ratio, 1, fifth)
    store(lane.ratio, 2, third)


@compiled
def _accept(t, method, lane, task):
    """Accept the steps whose error is small enough, and choose the next ones."""
    companions = method.companions
    for first in range(0, LANES, companions):
        if lane.row[first] < 0:
            continue
        ratio, sick = 0.0, False
        for k in range(first, first + companions):
            fifth = lane.ratio[1, k]
            combined = math.sqrt((fifth + 0.01 * lane.ratio[2, k]) * t.size)
            one = lane.h[0, k] * fifth / combined if combined > 0.0 else 0.0 * fifth
            sick = sick or not one < math.inf
            ratio = max(ratio, one)
        factor = _SHRINK
        if not sick:
            factor = _GROW if ratio == 0.0 else _SAFETY * ratio**-0.125
            factor = min(max(factor, _SHRINK), _GROW)
        status = REACHED
        for k in range(first, first + companions):
            lane.tries[k] += 1
            lane.step[k] = factor * lane.h[0, k]
            if lane.tries[k] > method.most:
                status = STUCK
            if not sick and ratio <= 1.0:
                if lane.worst[0, k] < method.near or lane.worst[1, k] > method.follows:
                    status = SINGULAR
                for j in range(t.size):
                    lane.y[j, k] = lane.new[j, k]
                if lane.h[0, k] >= lane.remaining[k]:
                    lane.at[k] += 1
                    lane.remaining[k], lane.tries[k], lane.due[k] = task.frame, 0, True
                else:
                    lane.remaining[k] -= lane.h[0, k]
            elif lane.step[k] < method.smallest:
                status = STUCK
        if status != REACHED:
            for k in range(first, first + companions):
                task.status[lane.row[k]] = status
                lane.row[k], lane.due[k] = -1, False

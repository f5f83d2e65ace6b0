"""Softness of loops between bodies whose centres of mass hardly move.

MuJoCo makes a point constraint as soft as its bodies' centres of mass yield (`body_invweight0`).
Balanced shafts and the cross of a universal joint turn about one point, so that nothing is left of
the softness. The two points of a hinge then contradict each other by rounding without bound, and
the motion is wrong, mostly without a warning. There the points' own yield takes its place.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

# Least share of the points' yield; the loops of the scenes of this package have 0.15 and more.
_LEAST = 0.01
_POINTS = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


def soften_loops(model: Any, data: Any) -> str:
    """Raise `body_invweight0` where centres hardly move, and return a remark on what was set.

    Args:
        model: The compiled model, which is changed.
        data: Its state after `mj_forward` at the reference pose.
    """
    changes: dict[int, float] = {}
    for number in np.flatnonzero(np.isin(model.eq_type, _POINTS)).tolist():
        sites = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
        bodies, yields = model.site_bodyid[sites], [_yield(model, data, site) for site in sites]
        if model.body_invweight0[bodies, 0].sum() < _LEAST * sum(yields):
            for body, own in zip(bodies.tolist(), yields, strict=True):
                changes[body] = max(changes.get(body, 0.0), own)
    changes.pop(0, None)  # the world, which yields nothing
    for body, own in changes.items():
        model.body_invweight0[body, 0] = own
    listed = ", ".join(f"{model.body(body).name!r}: {own:.9g}" for body, own in changes.items())
    return f" Once loaded, model.body_invweight0[body, 0] is set: {listed}." if listed else ""


def _yield(model: Any, data: Any, site: int) -> float:
    """Return a site's speed per impulse, the mean of all directions [1/kg]."""
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, site)
    moved = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, moved, jacobian)
    return float(np.vdot(moved, jacobian)) / 3.0

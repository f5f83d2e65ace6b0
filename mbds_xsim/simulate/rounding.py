"""Rounding errors in the values that an engine holds: no check can demand more accuracy.

Each operation leaves a relative error of half a unit in the last place, u = 2⁻²⁴ in single
precision and 2⁻⁵³ in double (Higham, Accuracy and Stability of Numerical Algorithms, 2002, 2.2).
"""

from __future__ import annotations

from mbds_xsim.scene.mechanism import WORLD_INDEX, Mechanism
from mbds_xsim.simulate.claims import Method

_UNIT = {True: 2.0**-24, False: 2.0**-53}
# Operations on a number from a body's parent to the body: a product of quaternions, their
# normalisation, a vector rotated and added.
_OF_LINK = 16


def state_error(mechanism: Mechanism, method: Method | None) -> float:
    """Return the relative error of a state that is read back from an engine's coordinates.

    Rounding errors of a link carry over to all its descendants, so the longest chain counts.
    """
    return _OF_LINK * _longest_chain(mechanism) * _unit(method)


def step_error(method: Method | None, steps: int) -> float:
    """Return the relative error accumulated in steps, each of which rounds the state once."""
    return steps * _unit(method)


def _unit(method: Method | None) -> float:
    return _UNIT[method is not None and method.single]


def _longest_chain(mechanism: Mechanism) -> int:
    depth = {WORLD_INDEX: 0}
    for link in mechanism.links:
        depth[link.body] = depth[link.parent] + 1
    return max(depth.values())

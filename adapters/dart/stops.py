"""Stops of joints in scenes with rotors.

DART's own are impulses, which go by the inertia of bodies alone and pass rotors by. Here a stop is
an implicit damper of the joint, as a rotor is, that leaves no rate. Which joints past their limits
are held in a step is Murty's scheme: as long as one goes on that is free, or one is pulled that is
held, the first such one is let go or held.

K. G. Murty, Opsearch 11 (1974), Note on a Bard-type scheme for solving the complementarity problem
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mbds_xsim.scene.joint_inertia import moved_inertias, poses

from .model import SkeletonModel

# Of a joint's rate that its stop leaves, from the sign of which follows whether it pulls.
_LEFT = 1e-9
# The scheme ends, but for rounding.
_MOST_CHANGES = 1000


@dataclass
class _Stop:
    joint: Any
    low: float
    high: float
    free: float
    """Damping of the joint between its limits, and held [N·m·s/rad or N·s/m]."""
    holding: float
    held: bool = False

    def let(self, held: bool) -> None:
        """Hold the joint, or let it go."""
        if held != self.held:
            self.held = held
            self.joint.setDampingCoefficient(0, self.holding if held else self.free)

    def is_past(self) -> bool:
        """Tell whether the joint is at its limits or past them."""
        return not self.low < self.joint.getPosition(0) < self.high

    def is_wrong(self, step: float) -> bool:
        """Tell whether it is to be held, or to be let go, by its rate after the step."""
        rate = self.joint.getVelocity(0) + step * self.joint.getAcceleration(0)
        outward = rate if self.joint.getPosition(0) >= self.high else -rate
        return bool(outward > 0.0) != self.held


class ImplicitStops:
    """The stops of a scene with rotors; none of another's.

    Args:
        model: At any state.
        step: Of the stepper [s].
    """

    def __init__(self, model: SkeletonModel, step: float) -> None:
        self._skeleton, self._step = model.skeleton, step
        self.all: list[_Stop] = []
        limited = model.mechanism.limited if model.mechanism.rotors else ()
        if not limited:
            return
        _, inertia = moved_inertias(model.mechanism, limited, poses(model.mechanism))
        carried = model.mechanism.carried
        for placed, moved in zip(limited, inertia.max(axis=0).tolist(), strict=True):
            joint = model.joints[carried[placed.index]]
            assert placed.limits is not None
            damping = joint.getDampingCoefficient(0), moved / (_LEFT * step)
            self.all.append(_Stop(joint, *placed.limits, *damping))

    def release(self) -> None:
        """Let all joints go."""
        for stop in self.all:
            stop.let(held=False)

    def hold(self) -> None:
        """Hold joints in the step to come, under the loads as they are."""
        self.release()
        past = [stop for stop in self.all if stop.is_past()]
        for _ in range(_MOST_CHANGES if past else 0):
            self._skeleton.computeForwardDynamics()
            wrong = next((stop for stop in past if stop.is_wrong(self._step)), None)
            if wrong is None:
                return
            wrong.let(held=not wrong.held)

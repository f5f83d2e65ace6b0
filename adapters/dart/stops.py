"""Stops of joints in scenes with rotors.

DART's own stops are impulses from the inertia of bodies alone, which leaves rotors out. Here a stop
is an implicit damper of the joint, as a rotor is, so strong that it leaves no rate. Murty's scheme
decides which joints past their limits are held in a step: as long as a free one moves outward, or
a held one is pulled by its stop, the first such one is held or released.

K. G. Murty, Opsearch 11 (1974), Note on a Bard-type scheme for solving the complementarity problem
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mbds_xsim.scene.joint_inertia import moved_inertias, poses

from .model import SkeletonModel

# Share of a joint's rate that its stop leaves; its sign shows whether the stop pulls.
_REMAINING_RATE = 1e-9
# The scheme always ends, unless rounding keeps it going.
_MOST_CHANGES = 1000


@dataclass
class _Stop:
    joint: Any
    low: float
    high: float
    free: float
    """Damping of the joint while free; `holding` is that while held [N·m·s/rad or N·s/m]."""
    holding: float
    active: bool = False

    def switch(self, active: bool) -> None:
        """Hold the joint or release it."""
        if active != self.active:
            self.active = active
            self.joint.setDampingCoefficient(0, self.holding if active else self.free)

    def is_past(self) -> bool:
        """Return whether the joint is at or past a limit."""
        return not self.low < self.joint.getPosition(0) < self.high

    def is_wrong(self, step: float) -> bool:
        """Return whether its rate after the step asks for holding or releasing it."""
        rate = self.joint.getVelocity(0) + step * self.joint.getAcceleration(0)
        outward = rate if self.joint.getPosition(0) >= self.high else -rate
        return bool(outward > 0.0) != self.active


class ImplicitStops:
    """The stops of a scene with rotors; without rotors, there are none.

    Args:
        model: The model in any state.
        step: Step of the stepper [s].
    """

    def __init__(self, model: SkeletonModel, step: float) -> None:
        self._skeleton, self._step = model.skeleton, step
        self.all: list[_Stop] = []
        limited = model.mechanism.limited if model.mechanism.rotors else ()
        if not limited:
            return
        _, inertia = moved_inertias(model.mechanism, limited, poses(model.mechanism))
        carried = model.mechanism.carried
        for placed, largest in zip(limited, inertia.max(axis=0).tolist(), strict=True):
            joint = model.joints[carried[placed.index]]
            assert placed.limits is not None
            damping = joint.getDampingCoefficient(0), largest / (_REMAINING_RATE * step)
            self.all.append(_Stop(joint, *placed.limits, *damping))

    def release(self) -> None:
        """Release all joints."""
        for stop in self.all:
            stop.switch(active=False)

    def hold(self) -> None:
        """Decide which joints to hold in the coming step under the present loads."""
        self.release()
        past = [stop for stop in self.all if stop.is_past()]
        for _ in range(_MOST_CHANGES if past else 0):
            self._skeleton.computeForwardDynamics()
            wrong = next((stop for stop in past if stop.is_wrong(self._step)), None)
            if wrong is None:
                return
            wrong.switch(active=not wrong.active)

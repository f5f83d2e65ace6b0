"""What the scene's equations of motion make of recorded states in the next moment."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from mbds_xsim.base import rotation
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import Mechanism

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False)
class Flow:
    """The flow of a mechanism outside contact."""

    mechanism: Mechanism
    moment: float
    """Over which rates are differences [s]."""

    def accelerations(self, states: BodyStates, force: Array, torque: Array) -> tuple[Array, Array]:
        """Linear and angular accelerations, shapes (state, body, 3)."""
        # The reference loads the compiled parts of scipy, which most uses do without.
        from mbds_xsim.reference import accelerations

        return accelerations(self.mechanism, states, force, torque)

    def later(self, states: BodyStates, pull: Array, push: Array) -> BodyStates:
        """Give states a moment later, by their linear and angular accelerations."""
        moment = self.moment
        turn = moment * (states.angular_velocity + moment / 2 * push)
        return BodyStates(
            states.position + moment * (states.velocity + moment / 2 * pull),
            rotation.multiply(rotation.from_vector(turn), states.native),
            states.velocity + moment * pull,
            states.angular_velocity + moment * push,
        )

    def of_rates(self, states: BodyStates, pull: Array, push: Array) -> tuple[Array, Array]:
        """Give the part of accelerations that the velocity coordinates make by their change.

        These are joint rates, and velocities of free bodies. The rest comes from places that
        change while the coordinates stand still. Shapes (state, body, 3).
        """
        here = to_links(self.mechanism, states)
        then = to_links(self.mechanism, self.later(states, pull, push))
        changes = dataclasses.replace(
            here,
            angular_velocity=(then.angular_velocity - here.angular_velocity) / self.moment,
            rate=(then.rate - here.rate) / self.moment,
            velocity=(then.velocity - here.velocity) / self.moment,
        )
        found = to_bodies(self.mechanism, changes)
        return found.velocity, found.angular_velocity

    def closed(self, states: BodyStates) -> BodyStates:
        """Close the joints of mechanisms whose loops may hold their bodies twice.

        Where constraints depend on one another, gaps as small as engines leave tear them apart,
        and accelerations jump. The tree's joints are closed first, so that a flat loop is flat.
        Ball joints alone never depend on one another, but at single configurations.
        """
        mechanism = self.mechanism
        if not mechanism.loops or all(joint.kind == "ball" for joint in mechanism.joints):
            return states
        from mbds_xsim.reference.dynamics import dynamics_of

        known, dynamics = known_states(states), dynamics_of(mechanism)
        tree = to_bodies(mechanism, to_links(mechanism, states[known]))
        found = dynamics.unpack(dynamics.project(dynamics.pack(tree)))
        filled = BodyStates(*(np.full_like(values, np.nan) for values in vars(states).values()))
        for name, values in vars(filled).items():
            values[known] = getattr(found, name)
        return filled


def known_states(states: BodyStates) -> Mask:
    """Tell which states are not lost, shape of the leading axes."""
    return np.asarray(np.isfinite(states.position).all(axis=(-1, -2)))

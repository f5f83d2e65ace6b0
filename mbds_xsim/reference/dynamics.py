"""Newton–Euler equations in maximal coordinates with constraints at acceleration level.

M a = f + Jᵀ λ and J a + bias = 0 give (J M⁻¹ Jᵀ) λ = −(J M⁻¹ f + bias). Accelerations and Jacobian
are scaled by the roots of masses and principal moments, so that M is the identity.

A state is one array of shape (batch, body + world, 13): position of the centre of mass,
orientation of the principal frame (wxyz), velocity, angular velocity in W.
"""

from __future__ import annotations

import functools

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Indices
from mbds_xsim.base.errors import SceneError
from mbds_xsim.reference.multipliers import POOR, Multipliers
from mbds_xsim.reference.singular import interpolated, projected_onto_branch, typical_states
from mbds_xsim.reference.topology import topology_of
from mbds_xsim.scene.assembly import assemble
from mbds_xsim.scene.constraints import Moving, evaluate, motion_of
from mbds_xsim.scene.joint_space import BodyStates, joint_loads
from mbds_xsim.scene.mechanism import Mechanism

# Largest error of left-out rows, over the goals: a stage is slightly off the constraints.
_FOLLOWS = 1e-4
# Part of the usual independent share of rows below which a pose may be singular.
_FEWER = 0.1

_X, _Q, _V, _W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)


def _turn_map() -> Array:
    """Linear map from the products of a quaternion's components to (R − 1) · |q|² / 2."""
    products = np.zeros((3, 3, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[i, i, 1 + j, 1 + j] = products[i, i, 1 + k, 1 + k] = -1.0
        products[i, j, 1 + i, 1 + j] = products[j, i, 1 + i, 1 + j] = 1.0
        products[j, i, 0, 1 + k], products[i, j, 0, 1 + k] = 1.0, -1.0
    return np.ascontiguousarray(products.reshape(9, 16).T)


_TURN = _turn_map()


@functools.lru_cache(maxsize=64)
def maximal_of(mechanism: Mechanism) -> Dynamics:
    """Prepare equations of a mechanism (once each) without effects on its tree's coordinates."""
    return Dynamics(mechanism)


class Dynamics:
    """Equations of motion of one mechanism, vectorised over a batch."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self.topology = topology_of(mechanism)
        self.length = mechanism.scene.length
        self._multipliers = Multipliers(self.topology)
        damping = [joint.damping for joint in mechanism.compliant]
        damping += [drive.servo.damping for drive in mechanism.drives]
        self.damped = bool(np.any(self.topology.spring[:, 2]) or any(damping))
        self._constrains = bool(self.topology.layout.row_count)
        self._inverse_mass_root = self.topology.weight / self.topology.mass_root[:, None]
        self._inverse_inertia_root = self.topology.weight / self.topology.inertia_root
        self._closes = bool(mechanism.loops or mechanism.distances)
        self.near = 0.0
        if self._closes:
            states = typical_states(self, self.pack(pose_of(mechanism)))
            usual = self._multipliers.choose(self._rows(self._motion(states))[2])
            self.near = min(POOR, _FEWER * usual)

    def pack(self, bodies: BodyStates) -> Array:
        """Convert body states with one leading axis to states."""
        count = self.topology.body_count
        state = np.zeros((len(bodies.position), count + 1, 13))
        state[:, -1, 3] = 1.0
        state[:, :count, _X], state[:, :count, _V] = bodies.position, bodies.velocity
        state[:, :count, _Q] = rotation.multiply(bodies.native, self.topology.principal[:count])
        state[:, :count, _W] = bodies.angular_velocity
        return state

    def unpack(self, state: Array) -> BodyStates:
        """Convert states with any leading axes to body states."""
        state = state[..., :-1, :]
        native = state[..., _Q]
        if (self.topology.principal != rotation.IDENTITY).any():
            back = rotation.conjugate(self.topology.principal[:-1])
            native = rotation.multiply(native, back)
        return BodyStates(state[..., _X], native, state[..., _V], state[..., _W])

    def derivative(self, state: Array, force: Array, torque: Array) -> Array:
        """Time derivative of states under forces (batch, body, 3) and torques (batch, hinge).

        The torques are followed by the pushes of drives.
        """
        rate, share = self.rate(state, force, torque)
        for k in np.flatnonzero(share < self.near):
            rate[k] = interpolated(self, state[k], force[k], torque[k], rate[k], float(share[k]))
        return rate

    def rate(self, state: Array, force: Array, torque: Array) -> tuple[Array, Array]:
        """Time derivative of states without regard to singular poses.

        Returns:
            The derivative, and the independent share of the rows, squared, shape (batch,).
        """
        q, w = state[..., _Q], state[..., _W]
        rate = np.empty_like(state)
        rate[..., _X] = state[..., _V]
        rate[..., 3] = -0.5 * np.einsum("bni,bni->bn", w, q[..., 1:])
        rate[..., 4:7] = 0.5 * (w * q[..., :1] + rotation.cross(w, q[..., 1:]))
        rate[..., _V], rate[..., _W], share = self.accelerations(state, force, torque)
        return rate, share

    def accelerations(
        self, state: Array, force: Array, torque: Array
    ) -> tuple[Array, Array, Array]:
        """Accelerations, angular accelerations in W, and independent shares, as in `rate`."""
        motion = self._motion(state)
        applied = self._applied(motion, state, force, torque)
        acceleration, share = self._constrained(motion, applied)
        return *self._unscaled(motion, acceleration), share

    def project(self, state: Array) -> Array:
        """Project states onto the constraints by least mass-weighted changes; unit quaternions.

        Near a singular pose they are projected onto the branch that their velocities follow.
        """
        if not self._constrains:
            return _normalised(state)
        projected, share = self.closest(state)
        for k in np.flatnonzero(share < self.near):
            projected[k] = projected_onto_branch(self, state[k], projected[k], float(share[k]))
        return _normalised(projected)

    def closest(self, state: Array) -> tuple[Array, Array]:
        """Project states onto the constraints without regard to singular poses.

        Returns:
            The states, and the independent share of the rows, squared, shape (batch,).
        """
        motion, state = self._motion(state), state.copy()
        residual, _, jacobian = self._rows(motion)
        change, share = self._least(jacobian, residual)
        shift, turn = self._unscaled(motion, change)
        state[..., _X] -= shift
        state[..., _Q] = rotation.multiply(rotation.from_vector(-turn), state[..., _Q])
        motion = self._motion(state)
        jacobian = self._rows(motion)[2]
        change, _ = self._least(jacobian, self._rates(jacobian, motion, state))
        slowing, spin = self._unscaled(motion, change)
        state[..., _V] -= slowing
        state[..., _W] -= spin
        return _normalised(state), share if self._closes else np.ones(len(state))

    def residual(self, state: Array) -> Array:
        """Constraint residuals [m or rad], shape (batch, row), as `mbds_xsim.scene.constraints`."""
        return self._rows(self._motion(state))[0]

    def is_singular(self, state: Array) -> bool:
        """Whether the constraints of one state have lost rank, or nearly so."""
        return bool(self._constrains and self.closest(state[None])[1][0] < self.near)

    def gaps(self, state: Array) -> tuple[Array, Array]:
        """Gaps of contact spheres [m] and their rates [m/s], each (batch, grounded + pair).

        Gaps to the plane z = 0 come first, then those between spheres. The latter are
        (d² − R²) / 2R, with d the distance of the centres and R its value at a touch. Near a touch
        this is the gap, and it is a parabola in time if spheres pass at constant velocity.
        """
        mechanism, top = self.mechanism, self.topology
        carrier = state[:, mechanism.sphere_body]
        arm = rotation.rotate(carrier[..., _Q], top.sphere)
        place, radius = carrier[..., _X] + arm, mechanism.sphere_radius
        speed = carrier[..., _V] + rotation.cross(carrier[..., _W], arm)
        one, other = mechanism.sphere_pairs.T
        reach = radius[one] + radius[other]
        apart, parting = place[:, one] - place[:, other], speed[:, one] - speed[:, other]
        between = (rotation.dot(apart, apart) - reach**2) / (2.0 * reach)
        height = (place[..., 2] - radius)[:, top.grounded]
        rates = [speed[:, top.grounded, 2], rotation.dot(apart, parting) / reach]
        return np.concatenate([height, between], axis=1), np.concatenate(rates, axis=1)

    def _motion(self, state: Array) -> Moving:
        q = state[..., _Q]
        outer = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 16)
        turn = outer @ _TURN
        turn *= (2.0 / np.einsum("bni,bni->bn", q, q))[..., None]
        turn[..., ::4] += 1.0
        turn = turn.reshape(*q.shape[:-1], 3, 3)
        layout, (x, v, w) = self.topology.layout, (state[..., k] for k in (_X, _V, _W))
        return motion_of(layout, turn, x, v, w, bodies_first=True)

    def _applied(self, motion: Moving, state: Array, force: Array, torque: Array) -> Array:
        """Scaled accelerations without constraints, shape (batch, body + world, 6)."""
        top = self.topology
        push = np.zeros((*state.shape[:-1], 3))
        push[:, :-1] = force
        twist = np.zeros_like(push)
        torque, pushes = np.split(torque, [len(self.mechanism.hinges)], axis=-1)
        if top.hinge_incidence.size:
            twist += top.hinge_incidence @ (
                motion.vector[0][:, top.layout.hinge] * torque[..., None]
            )
        if len(top.spring):
            self._add_springs(motion, push, twist)
        if self.mechanism.compliant or self.mechanism.drives:
            loads = joint_loads(self.mechanism, self.unpack(state), pushes)
            push[:, :-1] += loads[0]
            twist[:, :-1] += loads[1]
        spin = _times(motion.turn.swapaxes(-1, -2), state[..., _W])
        moment = _times(motion.turn.swapaxes(-1, -2), twist)
        moment -= rotation.cross(spin, top.inertia_root**2 * spin)
        scaled = np.empty((*state.shape[:-1], 6))
        scaled[..., :3] = push * self._inverse_mass_root
        scaled[..., :3] += top.gravity * top.mass_root[:, None] * top.weight
        scaled[..., 3:] = moment * self._inverse_inertia_root
        return scaled

    def _add_springs(self, motion: Moving, push: Array, twist: Array) -> None:
        top = self.topology
        d, d_rate = (motion.span[k][:, top.layout.springs] for k in (0, 1))
        distance = np.sqrt(np.einsum("bsi,bsi->bs", d, d))
        along = d / distance[..., None]
        stretch = np.einsum("bsi,bsi->bs", along, d_rate)
        rest_length, stiffness, damping = top.spring.T
        tension = stiffness * (distance - rest_length) + damping * stretch
        pull = tension[..., None] * along
        spans = top.layout.span_body.shape[1]
        for end, sign in ((0, 1.0), (1, -1.0)):
            first = end * spans + top.layout.springs.start
            arm = motion.vector[0][:, first : first + len(top.spring)]
            push += top.spring_incidence[end] @ (sign * pull)
            twist += top.spring_incidence[end] @ rotation.cross(arm, sign * pull)

    def _constrained(self, motion: Moving, applied: Array) -> tuple[Array, Array]:
        if not self._constrains:
            return applied, np.ones(len(applied))
        _, bias, jacobian = self._rows(motion)
        goal = self._sum(jacobian, applied) + bias
        change, share = self._least(jacobian, goal)
        for k in self._broken(jacobian, goal, change):
            load, share[k] = self._multipliers.solve_anew(jacobian[k], goal[k])
            change[k] = self._loaded(jacobian[k], load)
        return applied - change, share if self._closes else np.ones(len(applied))

    def _broken(self, jacobian: Array, goal: Array, change: Array) -> Indices:
        """States at which left-out rows do not follow from the others, as they should."""
        left_out = self._multipliers.left_out
        if not len(left_out):
            return left_out
        off = np.abs(self._sum(jacobian, change) - goal)[:, left_out].max(axis=1)
        return np.flatnonzero(off > _FOLLOWS * np.abs(goal).max(axis=1))

    def _least(self, jacobian: Array, goal: Array) -> tuple[Array, Array]:
        """Scaled change of least norm with J · change = goal, shape (batch, body + world, 6).

        The second result is the independent share of the rows, shape (batch,).
        """
        load, share = self._multipliers.solve(jacobian, goal)
        return self._loaded(jacobian, load), share

    def _loaded(self, jacobian: Array, multipliers: Array) -> Array:
        load = multipliers[..., self._multipliers.slot_row]
        return np.asarray(np.matmul(load[..., None, :], jacobian)[..., 0, :])

    def _sum(self, jacobian: Array, scaled: Array) -> Array:
        """J · scaled, shape (batch, row)."""
        values = np.matmul(jacobian, scaled[..., None]).reshape(len(jacobian), -1)
        first, second = self._multipliers.row_slot
        return values[:, first] + values[:, second]

    def _unscaled(self, motion: Moving, scaled: Array) -> tuple[Array, Array]:
        """Linear and angular parts in W of scaled changes or accelerations."""
        turn = _times(motion.turn, scaled[..., 3:] * self._inverse_inertia_root)
        return scaled[..., :3] * self._inverse_mass_root, turn

    def _rates(self, jacobian: Array, motion: Moving, state: Array) -> Array:
        top = self.topology
        scaled = np.empty((*state.shape[:-1], 6))
        scaled[..., :3] = state[..., _V] * top.mass_root[:, None]
        scaled[..., 3:] = _times(motion.turn.swapaxes(-1, -2), state[..., _W]) * top.inertia_root
        return self._sum(jacobian, scaled)

    def _rows(self, motion: Moving) -> tuple[Array, Array, Array]:
        """Residuals and biases (batch, row), and the scaled Jacobian slot by slot."""
        residual, bias, halves = evaluate(self.topology.layout, motion)
        slots = halves.reshape(len(halves), -1, 6)[:, self._multipliers.slot_half]
        slots[..., :3] *= self._inverse_mass_root[:, None]
        scale = motion.turn * self._inverse_inertia_root[:, None]
        slots[..., 3:] = np.matmul(slots[..., 3:], scale)
        return residual, bias, slots


def pose_of(mechanism: Mechanism) -> BodyStates:
    """Return the start pose at rest, or the reference pose if no start can be found."""
    still = np.zeros((1, mechanism.body_count, 3))
    turn = np.broadcast_to(rotation.IDENTITY, (1, mechanism.body_count, 4))
    try:
        start = assemble(mechanism)
    except SceneError:
        return BodyStates(mechanism.com[None], turn, still, still)
    return BodyStates(start.position[None], start.native[None], still, still)


def _normalised(state: Array) -> Array:
    state = state.copy()
    state[..., _Q] /= np.linalg.norm(state[..., _Q], axis=-1, keepdims=True)
    return state


def _times(matrix: Array, vector: Array) -> Array:
    return np.einsum("bnij,bnj->bni", matrix, vector)

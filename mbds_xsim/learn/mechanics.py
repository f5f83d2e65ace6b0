"""A mechanism as nodes with constraints, in torch: M q̈ + Aᵀ λ = f, A q̈ = −Ȧ q̇.

Tensors are (batch, node, 3) over the free nodes of `mechanics_points`, float64, in W. LGNN and
HGNN know this much of a scene: topology, lengths, masses and known forces.

Jacobians are sums of outer products, not dense matrices. The gradient of a constraint
(U x) · (W x) by the nodes is U ⊗ (W x) + W ⊗ (U x). Each of these *terms* is constant weights of
the nodes times a direction that depends on the state. So A M⁻¹ Aᵀ is the elementwise product of a
constant matrix and inner products of directions, at a cost of rows², not rows² · nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.autograd.function import once_differentiable

from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import Unsupported
from mbds_xsim.learn.graph import instead
from mbds_xsim.learn.layers import TensorModule, factorised, keep, mixed, summed
from mbds_xsim.learn.mechanics_points import PointRows, points_of, rows_of
from mbds_xsim.learn.rigid import Q, V, W, X
from mbds_xsim.learn.turning import rotate
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.scene.mechanism import Mechanism
from mbds_xsim.scene.scene import Scene


class NodeMatrix(Protocol):
    """Batch of symmetric matrices, each (3 · node, 3 · node)."""

    def times(self, v: Tensor) -> Tensor:
        """Return the products with v, shape (batch, node, 3); differentiable."""

    def dense(self) -> Tensor:
        """Return new dense matrices by columns, shape (batch, 3 · node, 3 · node)."""


def constrained(
    mass: NodeMatrix, load: Tensor, jacobian: Jacobian, bias: Tensor, redundant: int = 0
) -> Tensor:
    """Compute accelerations (batch, node, 3) under constraints, by a Schur complement.

    Args:
        mass: M, positive definite.
        load: Applied forces f, shape (batch, node, 3).
        jacobian: A.
        bias: Ȧ q̇, shape (batch, row).
        redundant: Number of rows of A beyond its rank.
    """
    with torch.no_grad():
        factor, failed = factorised(mass.dense())
        # The transpose of a contiguous matrix has the layout of LAPACK and is not copied.
        sides = torch.cat([jacobian.dense(), load.flatten(1)[:, None]], dim=1).mT
        half, side = torch.linalg.solve_triangular(factor, sides, upper=False).split(
            [bias.shape[1], 1], dim=-1
        )
        schur, failed_too = torch.linalg.cholesky_ex(_filled(half.mT @ half, redundant))
        value, multiplier = _saddle(factor, half, schur, side, bias)
        value = torch.where((failed + failed_too > 0)[:, None], torch.nan, value).view_as(load)
    if not torch.is_grad_enabled():
        return value
    residual = load - mass.times(value) - jacobian.back(multiplier)
    gap = -bias - jacobian.along(value)
    return _Held.apply(residual, gap, value, factor, half, schur)  # type: ignore[no-untyped-call]


class _Held(torch.autograd.Function):
    """Accelerations as a function of the residuals of M q̈ + Aᵀ λ = f and A q̈ = −Ȧ q̇.

    The residuals are zero, but change by df − dM q̈ − dAᵀ λ and −d(Ȧ q̇) − dA q̈; accelerations
    change by the same system's solution for these. So no matrix derivative has to be written out.
    Differentiable once.
    """

    @staticmethod
    def forward(ctx: Any, residual: Tensor, gap: Tensor, value: Tensor, *factors: Tensor) -> Tensor:
        del residual, gap
        ctx.save_for_backward(*factors)
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        factor, half, schur = ctx.saved_tensors
        side = torch.linalg.solve_triangular(factor, slope.flatten(1)[..., None], upper=False)
        by_residual, by_gap = _saddle(factor, half, schur, side, slope.new_zeros(schur.shape[:2]))
        return by_residual.view_as(slope), by_gap, None, None, None, None


def _filled(matrix: Tensor, redundant: int) -> Tensor:
    """Fill the null space that redundant rows leave in A M⁻¹ Aᵀ, so that it can be factorised.

    Multipliers in that space exert no force: Aᵀ maps them to zero. Its dimension is given, so that
    it is the same at states that violate constraints a little. Derivatives treat the filling as
    constant, since the multipliers that it changes exert no force either.
    """
    if not redundant:
        return matrix
    with torch.no_grad():
        size = matrix.diagonal(dim1=-2, dim2=-1).sqrt()[..., None]
        unit = matrix / size / size.mT
        finite = unit.isfinite().all(-1).all(-1)[:, None, None]  # others have no spectrum and fail
        eye = torch.eye(unit.shape[-1]).to(unit)
        _, axes = torch.linalg.eigh(torch.where(finite, unit, eye))
        rest = size * axes[..., :redundant]
        fill = rest @ rest.mT
    return matrix + fill


def _saddle(
    factor: Tensor, half: Tensor, schur: Tensor, side: Tensor, bias: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve M x + Aᵀ λ = f, A x = −bias, given L (M = L Lᵀ), L⁻¹ Aᵀ, A M⁻¹ Aᵀ's factor, L⁻¹ f."""
    multiplier = torch.cholesky_solve(half.mT @ side + bias[..., None], schur)
    value = torch.linalg.solve_triangular(factor.mT, side - half @ multiplier, upper=True)
    return value[..., 0], multiplier[..., 0]


class _Solved(torch.autograd.Function):
    """Solution with a factorised symmetric matrix; its adjoint is one more solution.

    Autograd would go through the factorisation, which takes several times as long. Differentiable
    once.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, goal: Tensor, factor: Tensor) -> Tensor:
        del matrix
        value = torch.cholesky_solve(goal[..., None], factor)
        ctx.save_for_backward(factor, value)
        return value[..., 0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        factor, value = ctx.saved_tensors
        by_goal = torch.cholesky_solve(slope[..., None], factor)
        return -by_goal @ value.mT, by_goal[..., 0], None


class Mechanics(TensorModule):
    """Nodes, constraints, mass matrix and known forces of one scene, without contact.

    Springs, dampers, rotors, friction, limits, couplings and servos in joints raise Unsupported.
    """

    moved_mass: Tensor
    """Masses of free nodes, then of rods [kg], (node + rod,): both have kinetic energy."""
    speed_map: Tensor
    """Map from velocities of free nodes to those of nodes and rods, (node + rod, node)."""
    coupling: Tensor
    """Share of each node and rod in the nonzero blocks of the mass matrix, (block, node + rod)."""
    block: Tensor
    """Places of the nine numbers of these blocks in the mass matrix by columns, (9 · block,)."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.mechanism = Mechanism.of(scene)
        loaded = [joint.name for joint in self.mechanism.joints if joint.is_loaded]
        if loaded:
            raise Unsupported(
                f"joint {loaded[0]!r}: got a spring, damper, rotor, friction, limits, coupling or "
                "servo, allowed is none: HGNN and LGNN know points and no joint coordinates; "
                + instead(scene)
            )
        self.points = points = points_of(self.mechanism)
        self.free, springs = points.free, self.mechanism.springs
        rows = rows_of(self.mechanism, points)
        self.redundant = rows.redundant
        # Terms of the kinetic energy: nodes, then rods.
        moved_mass = np.concatenate([points.mass[: self.free], points.rod_mass])
        ends = np.eye(points.count)[points.rods, : self.free]
        speed_map = np.concatenate([np.eye(self.free), ends[:, 0] - ends[:, 1]])
        mass = speed_map.T @ (moved_mass[:, None] * speed_map)
        mass_inverse = np.asarray(np.linalg.inv(mass), dtype=np.float64)
        self.terms = Terms(rows, points.fixed, mass_inverse)
        coupling, block = _blocks(speed_map)
        hinges = self.mechanism.hinges
        axes = [points.of_body(j.child).vector(j.axis, points.count) for j in hinges]
        # Action of torques: hinge, tip, centre of mass, ±1 / (2 d²).
        turning = [
            (k, tip, body.com, sign / (2.0 * distance**2))
            for k, hinge in enumerate(hinges)
            for end, sign in ((hinge.child, 1.0), (hinge.parent, -1.0))
            for body in (points.of_body(end),)
            for tip, distance in zip(body.tips, body.distances, strict=True)
        ]
        keep(
            self,
            fixed=points.fixed,
            mass=mass,
            mass_inverse=mass_inverse,
            first=rows.first,
            second=rows.second,
            goal=rows.goal,
            spring=_table([points.span(s.bodies, s.in_body) for s in springs], points.count),
            spring_law=_table([(s.stiffness, s.length, s.damping) for s in springs], 3),
            com=np.array([body.com for body in points.bodies]),
            hinge_axis=_table(axes, points.count),
            turning=_table(turning, 4),
            moved_mass=moved_mass,
            speed_map=speed_map,
            coupling=coupling,
            block=block,
        )

    def all_nodes(self, q: Tensor) -> Tensor:
        """Append the fixed nodes to the free ones, shape (batch, all nodes, 3)."""
        return torch.cat([q, self.fixed.expand(len(q), -1, -1)], dim=1)

    def residual(self, q: Tensor) -> Tensor:
        """Return the constraint residuals [m², m or 1], shape (batch, row)."""
        x = self.all_nodes(q)
        return (mixed(self.first, x) * mixed(self.second, x)).sum(-1) - self.goal

    def jacobian(self, q: Tensor) -> Jacobian:
        """Return A, the derivative of the residuals by the free nodes."""
        return Jacobian(self.terms, mixed(self.terms.moving, q) + self.terms.still)

    def jacobian_rate(self, v: Tensor) -> Jacobian:
        """Return the time derivative of A at velocities v."""
        return Jacobian(self.terms, mixed(self.terms.moving, v))

    def bias(self, v: Tensor) -> Tensor:
        """Return Ȧ q̇, shape (batch, row)."""
        first, second = (mixed(each[:, : self.free], v) for each in (self.first, self.second))
        return 2.0 * (first * second).sum(-1)

    def applied(self, q: Tensor, v: Tensor, inputs: KnownInputs) -> Tensor:
        """Return known forces on nodes, without gravity and elastic ones [N], (batch, node, 3)."""
        load = summed(inputs.force, self.com, self.points.count)
        if len(self.hinge_axis):
            load = self._add_torques(load, self.all_nodes(q), inputs.torque)
        if len(self.spring):
            load = load + self._damping(q, v)
        return load[:, : self.free]

    def placed(self, state: Tensor, carried: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bodies' nodes and velocities on the constraints, each (batch, node, 3).

        Args:
            state: State of the body that carries each node, (batch, node, 13).
            carried: Position of each node on its body, (node, 3) [m].
        """
        arm = rotate(state[..., Q], carried)
        velocity = state[..., V] + torch.linalg.cross(state[..., W], arm)
        return self.project(state[..., X] + arm, velocity)

    def project(self, q: Tensor, v: Tensor, passes: int = 2) -> tuple[Tensor, Tensor]:
        """Project states onto the constraints by least mass-weighted changes (Newton's method)."""
        for _ in range(passes):
            q = q - self._least(self.jacobian(q), self.residual(q))
        jacobian = self.jacobian(q)
        return q, v - self._least(jacobian, jacobian.along(v))

    def factored(self, jacobian: Jacobian) -> Callable[[Tensor], Tensor]:
        """Factorise A M⁻¹ Aᵀ and return a function that solves with it for (batch, row).

        Without a factor the solution is NaN, so that one batch member fails alone.
        """
        matrix = _filled(jacobian.over_mass(), self.redundant)
        factor, info = torch.linalg.cholesky_ex(matrix.detach())
        factor.masked_fill_((info > 0)[:, None, None], torch.nan)
        return lambda goal: _Solved.apply(matrix, goal, factor)  # type: ignore[no-untyped-call]

    def _least(self, jacobian: Jacobian, goal: Tensor) -> Tensor:
        """Return the least mass-weighted change with A · change = goal, (batch, node, 3)."""
        return mixed(self.mass_inverse, jacobian.back(self.factored(jacobian)(goal)))

    def _add_torques(self, load: Tensor, x: Tensor, torque: Tensor) -> Tensor:
        """Add torques t as pairs of forces ±t × r / (2 d²) on each tip and the centre of mass."""
        hinge, tip, com = self.turning[:, :3].long().T
        share = self.turning[:, 3:]
        couple = (self.hinge_axis @ x * torque[..., None])[:, hinge]
        pair = share * torch.linalg.cross(couple, x[:, tip] - x[:, com])
        return load.index_add(1, tip, pair).index_add(1, com, -pair)

    def _damping(self, q: Tensor, v: Tensor) -> Tensor:
        span = self.spring @ self.all_nodes(q)
        along = span / torch.linalg.vector_norm(span, dim=-1, keepdim=True)
        stretch = (along * (self.spring[:, : self.free] @ v)).sum(-1, keepdim=True)
        return -self.spring.T @ (self.spring_law[:, 2:] * stretch * along)


def _blocks(speed_map: Array) -> tuple[Array, Index]:
    """Return `Mechanics.coupling` and `Mechanics.block`."""
    coupling = np.einsum("ki,kj->ijk", speed_map, speed_map)
    i, j = coupling.any(axis=-1).nonzero()
    down, across = np.indices((3, 3)).reshape(2, 9)
    row, column = 3 * i[:, None] + down, 3 * j[:, None] + across
    return coupling[i, j], (3 * speed_map.shape[1] * column + row).reshape(-1)


def _table(rows: Sequence[ArrayLike], width: int) -> Array:
    """Convert rows, of which there may be none, to an array."""
    return np.array(rows, dtype=np.float64).reshape(-1, width)


class Terms(TensorModule):
    """Constant part of the terms: the first of each row, then the second of some rows."""

    weight: Tensor
    """Weights of the free nodes, shape (term, node)."""
    moving: Tensor
    """Weights of the free nodes in the directions, shape (term, node)."""
    still: Tensor
    """Part of the fixed nodes in the directions [m], shape (term, 3)."""
    coupling: Tensor
    """Weights times M⁻¹ times weights [1/kg], shape (term, term)."""
    again: Tensor
    """Row of each second term."""

    def __init__(self, rows: PointRows, fixed: Array, mass_inverse: Array) -> None:
        super().__init__()
        free = len(mass_inverse)
        moves = rows.first[:, :free].any(axis=1, keepdims=True)
        first, second = np.where(moves, [rows.first, rows.second], [rows.second, rows.first])
        # A squared length has two equal terms; a product with a fixed vector has only one.
        alike = (first == second).all(axis=1)
        again = (~alike & second[:, :free].any(axis=1)).nonzero()[0]
        weight = np.concatenate([np.where(alike, 2.0, 1.0)[:, None] * first, second[again]])
        weight = weight[:, :free]
        other = np.concatenate([second, first[again]])
        self.row_count = len(rows.goal)
        keep(
            self,
            weight=weight,
            moving=other[:, :free].copy(),
            still=other[:, free:] @ fixed,
            coupling=weight @ mass_inverse @ weight.T,
            again=again,
        )

    def summed(self, values: Tensor, dim: int) -> Tensor:
        """Sum the terms of each row."""
        if not len(self.again):
            return values
        first = values.narrow(dim, 0, self.row_count)
        second = values.narrow(dim, self.row_count, len(self.again))
        return first.index_add(dim, self.again, second)

    def spread(self, values: Tensor) -> Tensor:
        """Copy each row's value to its terms, (batch, row) to (batch, term)."""
        return torch.cat([values, values[:, self.again]], 1) if len(self.again) else values


@dataclass(frozen=True, eq=False)
class Jacobian:
    """Batch of Jacobians A, each (row, 3 · node)."""

    terms: Terms
    direction: Tensor
    """Direction of each term, shape (batch, term, 3)."""

    def along(self, v: Tensor) -> Tensor:
        """Return A v, shape (batch, row), of v (batch, node, 3)."""
        return self.terms.summed((mixed(self.terms.weight, v) * self.direction).sum(-1), 1)

    def back(self, multiplier: Tensor) -> Tensor:
        """Return Aᵀ λ, shape (batch, node, 3), of λ (batch, row)."""
        pull = self.terms.spread(multiplier)[..., None] * self.direction
        return mixed(self.terms.weight.T, pull)

    def over_mass(self) -> Tensor:
        """Return A M⁻¹ Aᵀ, shape (batch, row, row)."""
        products = self.terms.coupling * (self.direction @ self.direction.mT)
        return self.terms.summed(self.terms.summed(products, 1), 2)

    def dense(self) -> Tensor:
        """Return A as a dense matrix, shape (batch, row, 3 · node)."""
        outer = self.terms.weight[:, :, None] * self.direction[:, :, None]
        return self.terms.summed(outer.flatten(2), 1)

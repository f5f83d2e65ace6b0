"""Rigid bodies on joints in torch: smooth motion, projection onto joints, motions these allow.

The step is RATTLE (Andersen, J. Comput. Phys. 52 (1983) 24): impulses at the step's start put
positions onto the joints, impulses at its end put velocities there. It is of second order, exact
for flight without tumbling, and turns a body by its angular momentum, so that a wheel may turn by
whole radians in a step. It includes neither contact nor random forces.

A state is (batch, body, 13): centre of mass [m], rotation of the native frame (wxyz), velocity
[m/s], angular velocity [rad/s], in W.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mbds_xsim.base.errors import Unsupported
from mbds_xsim.learn import turning
from mbds_xsim.learn.graph import Graph, instead
from mbds_xsim.learn.layers import TensorModule, factorised, keep, summed
from mbds_xsim.learn.mechanics_points import models_of_points
from mbds_xsim.learn.window import KnownInputs
from mbds_xsim.scene.constraints import layout_of
from mbds_xsim.scene.mechanism import Link, Mechanism

X, Q, TWIST, V, W = slice(0, 3), slice(3, 7), slice(7, 13), slice(7, 10), slice(10, 13)
"""Parts of a state: position, rotation, twist, velocity, angular velocity."""
_PASSES = 2  # Newton iterations with the matrix of the step's start
_REST = 1e-10  # relative to a row's own size: redundant rows have a factor, too


class JointRows(TensorModule):
    """Residuals of all joints and distance links, and their Jacobian by the twists of the bodies.

    `mbds_xsim.scene.constraints` defines them. A row along a direction e between two points p of
    its bodies has the rate e · (ṗ_child − ṗ_parent); the rate of a row that keeps two directions at
    a right angle depends on angular velocities alone.
    """

    ends: Tensor
    """Body at the parent's end of each row, then at the child's, shape (2 · row,)."""
    pairs: Tensor
    """Pairs of ends at the same body (not the world), the first's row not before the second's,
    shape (2, pair)."""
    place: Tensor
    """Place of the product of each pair in a flat matrix (row, row) by columns, shape (pair,)."""

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        self.layout = layout = layout_of(mechanism)
        self.body_count = mechanism.body_count
        ends = torch.from_numpy(layout.row_body % (mechanism.body_count + 1)).flatten()
        moves = ends < mechanism.body_count
        count = layout.row_count
        row = torch.arange(2 * count) % count
        shared = (ends[:, None] == ends) & moves[:, None] & (row[:, None] >= row)
        first, second = torch.nonzero(shared, as_tuple=True)
        keep(
            self,
            vector_body=layout.vector_body,
            vector=layout.vector,
            first=layout.span_body[0],
            second=layout.span_body[1],
            length=layout.length,
            ends=ends,
            pairs=torch.stack([first, second]),
            place=count * row[second] + row[first],
            axes=torch.eye(3).double().repeat(layout.points.stop, 1),
        )

    def __len__(self) -> int:
        return self.layout.row_count

    def vectors(self, turn: Tensor) -> Tensor:
        """Rotate all body-fixed vectors with their bodies, shape (batch, vector, 3).

        `turn` has the rotation matrices of the bodies, then of the world.
        """
        return (turn[:, self.vector_body] @ self.vector[..., None])[..., 0]

    def halves(self, vectors: Tensor, span: Tensor) -> Tensor:
        """Return the derivatives of the rows by the twists of the bodies at their ends (`ends`).

        Shape (batch, 2 · row, 6): by the parents' twists first, then by the children's; arguments
        are as `spans` returns them.
        """
        layout, count = self.layout, len(self.first)
        points, along, links = layout.points, layout.along, layout.distances
        begin, end = vectors[:, :count], vectors[:, count : 2 * count]
        axes, normals = self.axes.expand(len(span), -1, -1), vectors[:, layout.along_normal]
        lever, unit = vectors[:, layout.lever], nn.functional.normalize(span[:, links], dim=-1)
        move = torch.cat([axes, normals, torch.zeros_like(lever), unit], dim=1)
        about = torch.cat([axes, normals, vectors[:, layout.normal], unit], dim=1)
        parents = [_thrice(begin[:, points]), (begin + span)[:, along], lever, begin[:, links]]
        children = [_thrice(end[:, points]), end[:, along], lever, end[:, links]]
        halves = [
            sign * torch.cat([move, torch.linalg.cross(torch.cat(arms, dim=1), about)], dim=-1)
            for arms, sign in ((parents, -1.0), (children, 1.0))
        ]
        return torch.cat(halves, dim=1)

    def spans(self, x: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotated body-fixed vectors and spans from parents to children.

        `x` has centres of mass [m], `turn` rotation matrices; the world follows the bodies.
        """
        vectors, count = self.vectors(turn), len(self.first)
        begin, end = vectors[:, :count], vectors[:, count : 2 * count]
        return vectors, x[:, self.second] + end - x[:, self.first] - begin

    def residual(self, vectors: Tensor, span: Tensor) -> Tensor:
        """Return how far the joints are open [m or rad], (batch, row), given `spans`."""
        layout = self.layout
        residual = [
            span[:, layout.points].flatten(1),
            (vectors[:, layout.along_normal] * span[:, layout.along]).sum(-1),
            (vectors[:, layout.lever] * vectors[:, layout.normal]).sum(-1),
            span[:, layout.distances].norm(dim=-1) - self.length,
        ]
        return torch.cat(residual, dim=1)


def _thrice(arms: Tensor) -> Tensor:
    return arms.repeat_interleave(3, dim=1)


@dataclass(frozen=True, eq=False)
class JointHold:
    """Joints at one pose, which project changes of twists and displacements onto allowed motion.

    Each row involves two bodies, so matrices are stored by ends of rows (`JointRows.halves`).
    Where nothing is held, all from `vectors` on are empty.
    """

    rows: JointRows
    turn: Tensor
    """Rotation matrices of the bodies, shape (batch, body, 3, 3)."""
    lightness: Tensor
    """Inverse inertias in W, same shape."""
    vectors: Tensor
    """All body-fixed vectors in W (`JointRows.vectors`)."""
    jacobian: Tensor
    """Jacobian J by the twist at each end, shape (batch, 2 · row, 6)."""
    over_mass: Tensor
    """Product J M⁻¹, same shape."""
    factor: Tensor
    """Cholesky factor of J M⁻¹ Jᵀ."""
    lost: Tensor
    """NaN if the factorisation failed, else 0, shape (batch, 1)."""

    def least(self, goal: Tensor) -> Tensor:
        """Return the least mass-weighted change c with J c = goal, shape (batch, body, 6)."""
        # Two triangular solves, because `cholesky_solve` would copy the factor.
        side = (goal + self.lost)[..., None]
        side = torch.linalg.solve_triangular(self.factor, side, upper=False)
        multiplier = torch.linalg.solve_triangular(self.factor.mT, side, upper=True)
        pull = self.over_mass * multiplier.repeat(1, 2, 1)
        world = self.rows.body_count
        return summed(pull, self.rows.ends, world + 1)[:, :world]

    def kept(self, change: Tensor) -> Tensor:
        """Return the part of changes (batch, body, 6) that the joints allow."""
        if not len(self.jacobian):
            return change
        whole = nn.functional.pad(change, (0, 0, 0, 1))  # the world does not change
        along = (self.jacobian * whole.index_select(1, self.rows.ends)).sum(-1)
        return change - self.least(along[:, : len(self.rows)] + along[:, len(self.rows) :])


class BodyMechanics(TensorModule):
    """Masses, joints, gravity and driven hinges of one scene.

    Springs, and dampers, rotors, friction, limits, couplings and servos in joints, raise
    Unsupported.
    """

    moves: Tensor
    """Mask of the six components of a twist: 1 where the scene moves, else 0."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        mechanism = graph.mechanism
        loaded = [f"joint {joint.name!r}" for joint in mechanism.joints if joint.is_loaded]
        loaded += [f"spring {spring.name!r}" for spring in mechanism.springs]
        if loaded:
            raise Unsupported(
                f"{loaded[0]}: got a spring, damper, rotor, friction, limits, coupling or servo, "
                "allowed is none: models of bodies know rigid joints alone; "
                + instead(graph.scene, *models_of_points(mechanism))
            )
        self.rows = JointRows(mechanism)
        spatial = graph.scene.dimension == 3
        moves = torch.cat([graph.moving, torch.tensor([spatial, True, spatial])])
        inertia = torch.from_numpy(mechanism.inertia)
        ends = [*(h.child for h in mechanism.hinges), *(h.parent for h in mechanism.hinges)]
        keep(
            self,
            mass=torch.from_numpy(mechanism.mass)[:, None],
            inertia=inertia,
            lightness=torch.linalg.inv(inertia),
            gravity=graph.gravity,
            moves=moves.to(graph.gravity),
            still=torch.eye(3, dtype=torch.float64)[None],
            hinge_ends=torch.tensor(ends, dtype=torch.int64) % (mechanism.body_count + 1),
        )

    def moved(self, state: Tensor, change: Tensor) -> Tensor:
        """Displace bodies: shift centres of mass by a change's first half, turn by its second."""
        orientation = turning.multiply(turning.from_vector(change[..., 3:]), state[..., Q])
        orientation = orientation / orientation.norm(dim=-1, keepdim=True)
        return torch.cat([state[..., X] + change[..., :3], orientation, state[..., TWIST]], dim=-1)

    def apart(self, state: Tensor, other: Tensor) -> Tensor:
        """Return the change that leads from one pose to another, shape (batch, body, 6)."""
        turn = turning.multiply(other[..., Q], turning.conjugate(state[..., Q]))
        return torch.cat([other[..., X] - state[..., X], turning.to_vector(turn)], dim=-1)

    def of_impulse(self, state: Tensor, impulse: Tensor) -> Tensor:
        """Return the change of twists by linear and angular impulses, (batch, body, 6).

        Linear impulses are in N·s, angular ones in N·m·s.
        """
        spin = _turned(self.lightness, turning.matrix(state[..., Q])) @ impulse[..., 3:, None]
        return torch.cat([impulse[..., :3] / self.mass, spin[..., 0]], dim=-1) * self.moves

    def square(self, state: Tensor, change: Tensor) -> Tensor:
        """Return the mass-weighted mean square of a displacement or twist, shape (batch,)."""
        spin = _times(_turned(self.inertia, turning.matrix(state[..., Q])), change[..., 3:])
        terms = self.mass * change[..., :3].square() + change[..., 3:] * spin
        return terms.sum((-2, -1)) / self.mass.sum()

    def unheld(self, state: Tensor) -> JointHold:
        """Return joints that allow every change; only `kept` may be called."""
        return JointHold(self.rows, *[state.new_zeros(0)] * 7)

    def hold(self, state: Tensor) -> JointHold:
        """Return the joints at a pose; where there are none, `kept` alone may be called."""
        rows, count = self.rows, len(self.rows)
        turn = turning.matrix(state[..., Q])
        lightness = _turned(self.lightness, turn)
        if not count:
            return JointHold(rows, turn, lightness, *[state.new_zeros(0)] * 5)
        vectors, span = rows.spans(*self._placed(state, turn))
        jacobian = rows.halves(vectors, span)
        # Any mass of the world will do: its ends are in no pair, and `least` drops them.
        ends = rows.ends.clamp(max=rows.body_count - 1)
        angular = (jacobian[..., None, 3:] @ lightness.index_select(1, ends))[..., 0, :]
        over_mass = torch.cat([jacobian[..., :3] / self.mass[ends], angular], dim=-1)
        first, second = rows.pairs
        product = jacobian.index_select(1, first) * over_mass.index_select(1, second)
        matrix = jacobian.new_zeros(len(state), count * count)
        matrix = matrix.index_add_(1, rows.place, product.sum(-1)).view(-1, count, count).mT
        matrix.diagonal(dim1=-2, dim2=-1).mul_(1.0 + _REST)
        factor, failed = factorised(matrix)  # reads the lower half alone
        lost = torch.where(failed > 0, torch.nan, 0.0)[:, None].to(matrix)
        return JointHold(rows, turn, lightness, vectors, jacobian, over_mass, factor, lost)

    def residual(self, state: Tensor) -> Tensor:
        """Return how far the joints are open [m or rad], shape (batch, row)."""
        placed = self._placed(state, turning.matrix(state[..., Q]))
        return self.rows.residual(*self.rows.spans(*placed))

    def smooth(
        self, state: Tensor, inputs: KnownInputs, frame_s: float, substeps: int
    ) -> tuple[list[Tensor], JointHold]:
        """Move bodies on their joints over a frame, without contact.

        Returns:
            The states at the start and after each step, and the joints at the last state.
        """
        hold = self.hold(state)
        states = [torch.cat([state[..., :7], hold.kept(state[..., TWIST])], dim=-1)]
        for _ in range(substeps):
            state, hold = self._step(states[-1], hold, inputs, frame_s / substeps)
            states.append(state)
        return states, hold

    def _step(
        self, state: Tensor, hold: JointHold, inputs: KnownInputs, step: float
    ) -> tuple[Tensor, JointHold]:
        """Take a RATTLE step: half a kick, a drift that ends on the joints, half a kick."""
        half = 0.5 * step
        inertia = _turned(self.inertia, hold.turn)
        pull = (self.gravity + inputs.force / self.mass) * self.moves[:3]
        v = state[..., V] + half * pull
        spin = _times(inertia, state[..., W]) + half * self._couples(hold, inputs.torque)
        midway = turning.multiply(turning.from_vector(half * state[..., W]), state[..., Q])
        lightness = _turned(self.lightness, turning.matrix(midway))
        passes = _PASSES if len(self.rows) else 0
        for k in range(passes + 1):
            twist = torch.cat([v, _times(lightness, spin)], dim=-1) * self.moves
            after = self.moved(state, step * twist)
            if k == passes:
                break
            kick = hold.least(self.residual(after)) / step
            v, spin = v - kick[..., :3], spin - _times(inertia, kick[..., 3:])
        v = v + half * pull
        hold = self.hold(after)
        spin = spin + half * self._couples(hold, inputs.torque)
        twist = torch.cat([v, _times(hold.lightness, spin)], dim=-1) * self.moves
        return torch.cat([after[..., :7], hold.kept(twist)], dim=-1), hold

    def _couples(self, hold: JointHold, torque: Tensor) -> Tensor:
        """Return the torques of the driven hinges on the bodies [N·m], shape (batch, body, 3)."""
        couple = hold.turn.new_zeros(len(hold.turn), self.rows.body_count + 1, 3)
        if torque.shape[-1]:
            along = hold.vectors[:, self.rows.layout.hinge] * torque[..., None]
            couple = couple.index_add(1, self.hinge_ends, torch.cat([along, -along], dim=1))
        return couple[:, :-1]

    def _placed(self, state: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
        """Return centres of mass and rotation matrices, the world's after the bodies'."""
        centre = nn.functional.pad(state[..., X], (0, 0, 0, 1))
        return centre, torch.cat([turn, self.still.expand(len(turn), -1, -1, -1)], dim=1)


def _turned(tensor: Tensor, turn: Tensor) -> Tensor:
    """Rotate a tensor from the native frames to W, shape (batch, body, 3, 3)."""
    return turn @ tensor @ turn.mT


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


class Links(TensorModule):
    """Tree of bodies that carry each other, and the motion of each on its joint.

    A body moves with the body that carries it, and in addition as its own joint allows: in any way
    if it is free, about any axis on a ball joint, about one axis on a hinge, along one on a slider.
    """

    carried: Tensor
    """Matrix whose row i is 1 at body i and at all bodies that carry it, shape (body, body)."""
    parent: Tensor
    """Body that carries each body; the world follows the bodies, shape (body,)."""
    arm: Tensor
    """Vector from the centre of mass to the joint in the native frame [m]; 0 for free bodies."""

    def __init__(self, mechanism: Mechanism) -> None:
        super().__init__()
        count = mechanism.body_count
        links = sorted(mechanism.links, key=lambda link: link.body)
        carried = torch.eye(count).double()
        for link in mechanism.links:  # parents come before children
            if link.parent >= 0:
                carried[link.body] += carried[link.parent]
        # Others than free bodies and ball joints shift or turn at most along an axis.
        free = torch.tensor([[link.joint is None] for link in links])
        balls = torch.tensor([[bool(link.joint and link.joint.kind == "ball")] for link in links])
        keep(
            self,
            carried=carried,
            parent=torch.tensor([link.parent % (count + 1) for link in links]),
            arm=_joint_vectors(links, "in_child"),
            shift_axis=_joint_vectors(links, "axis", "slider"),
            turn_axis=_joint_vectors(links, "axis", "hinge"),
            shifts=free.double(),
            turns=(free | balls).double(),
        )

    def forward(self, state: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
        """Return the twists (batch, body, 6) of bodies with these motions on their joints.

        States are (batch, body, 13); shifts and turns, relative to the parent's, (batch, body, 3).
        """
        shift = self.shifts * shift + _along(self._turned(self.shift_axis, state), shift)
        turn = self.turns * turn + _along(self._turned(self.turn_axis, state), turn)
        pivot = state[..., X] + self._turned(self.arm, state)
        spin = self.carried @ turn
        lever = self.carried @ (shift - torch.linalg.cross(turn, pivot))
        return torch.cat([lever + torch.linalg.cross(spin, state[..., X]), spin], dim=-1)

    def beside(self, values: Tensor) -> Tensor:
        """Subtract the parent's vector from each body's, (batch, body, 3); the world's is 0."""
        return values - nn.functional.pad(values, (0, 0, 0, 1))[:, self.parent]

    def _turned(self, vectors: Tensor, state: Tensor) -> Tensor:
        return turning.rotate(state[..., Q], vectors)


def _joint_vectors(links: list[Link], name: str, kind: str = "") -> Tensor:
    """Return a vector of each link's joint; 0 for joints of another kind and free bodies."""
    rows = [
        list(getattr(link.joint, name))
        if link.joint and kind in ("", link.joint.kind)
        else [0.0] * 3
        for link in links
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _along(axis: Tensor, vectors: Tensor) -> Tensor:
    return (axis * vectors).sum(-1, keepdim=True) * axis

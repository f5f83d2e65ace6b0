"""A scene loaded into Pinocchio: its rollouts, and the readback of its native model."""

from __future__ import annotations

import inspect
import re
from typing import Any

import numpy as np
import pinocchio as pin

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.scene import mechanism as mechanisms
from mbds_xsim.scene.joint_space import BodyStates, to_bodies, to_links
from mbds_xsim.scene.mechanism import WORLD_INDEX, Link, Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import Batch, Trajectory
from mbds_xsim.simulate import turning_rk4
from mbds_xsim.simulate.adapter import ModelSize, Readback, Run, Settings, until_blow_up
from mbds_xsim.simulate.readback import joint_anchors, joint_axes, joint_laws

from . import dynamics
from .dynamics import PinocchioDynamics
from .model import PinocchioLayout, columns, listing


class PinocchioRun(Run):
    """A run of one native model that steps trajectories side by side.

    Args:
        scene: The scene to simulate.
        settings: Method, step and options.
        drift_time: Time in which loops that have drifted open are closed [s]; 0 for never.
        softness: Softness of the proximal steps.
    """

    def __init__(
        self, scene: Scene, settings: Settings, drift_time: float, softness: float
    ) -> None:
        self._mechanism = mechanism = Mechanism.of(scene)
        self._count = settings.substeps(scene.clock.frame)
        self._step = scene.clock.frame / self._count
        self._layout = layout = PinocchioLayout.of(mechanism)
        self._listing = listing(mechanism, layout, drift_time)
        names: dict[str, Any] = {}
        # The listing that users are shown is the program that builds the model.
        exec(compile(self._listing, "<Pinocchio model>", "exec"), names)
        self._model = model = names["model"]
        self._frames = [names["bodies"][k] for k in range(mechanism.body_count)]
        places, speeds = list(model.idx_qs), list(model.idx_vs)
        self._columns, self._turns = columns(mechanism, layout, model)
        native = layout.native
        at = {index: (places[joint], speeds[joint]) for index, joint in native.items()}
        laws = [(*at[j.index], j.stiffness, j.damping, j.rest, np.inf) for j in mechanism.compliant]
        laws += [
            (*at[drive.joint.index], drive.servo.stiffness, drive.servo.damping, 0.0, drive.limit)
            for drive in mechanism.drives
        ]
        self._laws = np.array(laws).reshape(-1, 6)
        # The targets' pushes by every law of a joint, 0 for springs.
        pushes = with_pushes(mechanism.drives, np.zeros((scene.clock.steps, 0)))
        self._pushes = np.pad(pushes, ((0, 0), (len(mechanism.compliant), 0)))
        self._ends = [tuple(zip(s.bodies, s.in_body, strict=True)) for s in mechanism.springs]
        self._softness = softness
        more = mechanism.springs, self._ends, self._laws, softness
        self._dynamics = PinocchioDynamics(model, self._frames, names["constraints"], *more)
        self._rk4 = turning_rk4.TurningRK4(model.nv, self._turns, np.ones(len(self._turns)))
        hinges = list(enumerate(mechanism.hinges))
        self._driven = [k for k, hinge in hinges if hinge.index in native]
        self._driven_at = [at[mechanism.hinges[k].index][1] for k in self._driven]
        self._looped = [(k, hinge) for k, hinge in hinges if hinge.index not in native]
        rows = sum(constraint.residualSize() for constraint in names["constraints"])
        self.size = ModelSize(model.nv, rows)

    def rollout(self, batch: Batch) -> Trajectory:
        start_q, start_u = self._start(batch)
        frames = batch.steps + 1
        q, u = (
            np.full((len(batch), frames, part.shape[-1]), np.nan) for part in (start_q, start_u)
        )
        q[:, 0], u[:, 0] = start_q, start_u
        rows, system = np.arange(len(batch)), self._dynamics
        for k in range(batch.steps):
            if not len(rows):
                break
            here, rate = q[rows, k], u[rows, k]
            self._hold(batch, rows, k)
            # A motion that blows up may overflow before it is left out.
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(self._count):
                    here, rate = self._rk4.step(self._step, here, rate, system.rate, system.moved)
            q[rows, k + 1], u[rows, k + 1] = here, rate
            rows = rows[np.isfinite(here).all(axis=1) & np.isfinite(rate).all(axis=1)]
        return self._trajectory(q, u)

    def _trajectory(self, q: Array, u: Array) -> Trajectory:
        bodies = to_bodies(self._mechanism, self._columns.to_links(q, u))
        return until_blow_up(self._mechanism, bodies)

    def _hold(self, batch: Batch, rows: Index, frame: int) -> None:
        """Set the inputs of a frame for some trajectories."""
        force, torque = batch.force[rows, frame], batch.torque[rows, frame]
        load = np.zeros((len(rows), self._model.nv))
        load[:, self._driven_at] = torque[:, self._driven]
        self._dynamics.torque, self._dynamics.push = load, self._pushes[frame]
        self._dynamics.force = force if force.any() else None
        turning = np.zeros_like(force)
        for k, hinge in self._looped:
            for body, sign in ((hinge.child, 1.0), (hinge.parent, -1.0)):
                if body != WORLD_INDEX:  # the axis is fixed in both bodies
                    turning[:, body] += sign * torque[:, [k]] * hinge.axis
        self._dynamics.turning = turning if turning.any() else None

    def readback(self, batch: Batch) -> Readback:
        model, data = self._model, self._dynamics.data
        q, u = self._start(batch[:1])
        pin.forwardKinematics(model, data, q[0], u[0])
        pin.computeJointJacobians(model, data, q[0])
        pin.updateFramePlacements(model, data)
        inertias = [model.frames[k].inertia for k in self._frames]
        places = [data.oMf[k] for k in self._frames]
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        rates = [pin.getFrameVelocity(model, data, k, world) for k in self._frames]
        native = rotation.from_matrix(np.array([place.rotation for place in places]))
        rotors = [self._layout.native[joint.index] for joint in self._mechanism.rotors]
        return Readback(
            mass=np.array([inertia.mass for inertia in inertias]),
            inertia=np.array([inertia.inertia for inertia in inertias]),
            com=np.array([p.act(i.lever) for p, i in zip(places, inertias, strict=True)]),
            orientation=self._mechanism.body_orientation(native),
            velocity=np.array([rate.linear for rate in rates]),
            angular_velocity=np.array([rate.angular for rate in rates]),
            gravity=np.array(model.gravity.linear),
            step=self._step,
            joint_axis=joint_axes(self._mechanism, self._axis),
            damping=np.concatenate([model.damping, model.upperDryFrictionLimit]),
            anchor=joint_anchors(self._mechanism, self._anchors),
            spring=self._springs(),
            law=joint_laws(self._mechanism, lambda _, j: (j.stiffness, j.damping, j.rest)),
            drive=np.array([drive.as_read() for drive in self._mechanism.drives]),
            armature=np.array([model.armature[model.idx_vs[joint]] for joint in rotors]),
        )

    def _axis(self, link: Link) -> Array:
        """Return the axis of a link's joint in W from its column of the Jacobian."""
        joint = self._layout.carrier[link.body]
        data = self._dynamics.data
        columns = pin.getJointJacobian(self._model, data, joint, pin.ReferenceFrame.LOCAL)
        linear, angular = np.split(columns.reshape(6, -1)[:, self._model.idx_vs[joint]], 2)
        hinge = link.joint is not None and link.joint.kind == "hinge"
        return np.asarray(data.oMi[joint].rotation @ (angular if hinge else linear))

    def _anchors(self, link: Link) -> tuple[Array, Array] | None:
        joint, data = self._layout.carrier.get(link.body), self._dynamics.data
        if joint is None:
            return None
        above = data.oMi[self._model.parents[joint]]
        point = self._model.jointPlacements[joint].translation
        return above.act(point), data.oMi[joint].translation

    def _springs(self) -> Array:
        data, springs = self._dynamics.data, self._mechanism.springs
        ends = [
            [point if k < 0 else data.oMf[self._frames[k]].act(point) for k, point in pair]
            for pair in self._ends
        ]
        rows = [s.as_read(last - first) for s, (first, last) in zip(springs, ends, strict=True)]
        return np.array(rows).reshape(-1, 4)

    def native(self, batch: Batch) -> str:
        q, u = self._start(batch[:1])
        springs = [
            f"PointPair({s.name!r}, {s.bodies}, (), {s.length!r}, {s.stiffness!r}, {s.damping!r})"
            for s in self._mechanism.springs
        ]
        ends = [[(body, point.tolist()) for body, point in pair] for pair in self._ends]
        return _SCRIPT.format(
            listing=self._listing,
            pair=inspect.getsource(mechanisms.PointPair),
            rk4=_bare(inspect.getsource(turning_rk4)),
            dynamics=_bare(inspect.getsource(dynamics)),
            springs=", ".join(springs),
            ends=ends,
            laws=self._laws.tolist(),
            push=self._pushes[0].tolist(),
            softness=self._softness,
            turns=self._turns.tolist(),
            q=q.tolist(),
            u=u.tolist(),
            count=self._count * self._mechanism.scene.clock.steps,
            step=self._step,
        )

    def _start(self, batch: Batch) -> tuple[Array, Array]:
        links = to_links(self._mechanism, BodyStates.of(self._mechanism, batch))
        return self._columns.of_links(links)

    def close(self) -> None:
        vars(self).clear()


def _bare(source: str) -> str:
    """Strip a module's docstring and imports."""
    rest = source.partition('"""\n\n')[2] if '"""\n\n' in source else source
    return re.sub(r"^(from|import) .*\n", "", rest, flags=re.M).strip()


_SCRIPT = """\
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

{listing}

Array = Index = np.ndarray


{pair}

{rk4}


{dynamics}


inf = np.inf
springs, laws = [{springs}], np.array({laws}).reshape(-1, 6)
ends = [[(body, np.array(point)) for body, point in pair] for pair in {ends}]
frames = [bodies[k] for k in sorted(bodies)]
held = PinocchioDynamics(model, frames, constraints, springs, ends, laws, {softness})
turns = np.array({turns}, dtype=int).reshape(-1, 3)
rk4 = TurningRK4(model.nv, turns, np.ones(len(turns)))
q, u = np.array({q}), np.array({u})
held.push = np.array({push})
# Inputs are left out. Of a frame: held.torque on the coordinates, held.force on the bodies.
for _ in range({count}):
    q, u = rk4.step({step!r}, q, u, held.rate, held.moved)
data = model.createData()
pin.forwardKinematics(model, data, q[0], u[0])
pin.updateFramePlacements(model, data)
world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
for frame in frames:
    rate = pin.getFrameVelocity(model, data, frame, world)
    parts = data.oMf[frame].translation, data.oMf[frame].rotation, rate.linear, rate.angular
    print(model.frames[frame].name, *(part.tolist() for part in parts))
"""

"""Adapter of the reference, so that it is run, timed, checked and published like an engine.

It chooses its steps by a tolerance. It has to be named and does not count as an engine: if none is
named, it takes part in trade-offs only.
"""

from __future__ import annotations

from typing import ClassVar

import msgspec
import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array
from mbds_xsim.base.versions import PHYSICS
from mbds_xsim.reference.dynamics import pose_of
from mbds_xsim.reference.equations import dynamics_of
from mbds_xsim.reference.marching import Problem
from mbds_xsim.reference.solution import LOOSEST, TIGHTEST, solve, start_states
from mbds_xsim.reference.tree import tree_of
from mbds_xsim.scene.collisions import count_pairs
from mbds_xsim.scene.constraints import degrees_of_freedom
from mbds_xsim.scene.mechanism import Link, Mechanism
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.servo import with_pushes
from mbds_xsim.scene.state import STATES, Batch, Trajectory
from mbds_xsim.simulate.adapter import Adapter, ModelSize, Profile, Readback, Run, Settings
from mbds_xsim.simulate.claims import (
    RTOL,
    TRUTH,
    ContactLaw,
    ContactScales,
    Feature,
    Method,
    Option,
    named,
)
from mbds_xsim.simulate.readback import joint_anchors, joint_axes

_METHOD = "adaptive"
_MATCHED, _NATIVE = 1e-9, 1e-11


class Reference(Adapter):
    """Reference: DOP853 on a spanning tree with closures, Radau IIA if stiff, balls by events."""

    name = "reference"
    package = "mbds-xsim"
    revision = PHYSICS
    methods: ClassVar = named(Method(_METHOD, TRUTH, 8, own=False, adaptive=True))
    options: ClassVar = {
        RTOL: Option(
            _MATCHED,
            "error allowed in a step, relative to 1 plus the size of each component; a ball on "
            "the ground does not depend on it",
            least=TIGHTEST,
            most=LOOSEST,
        )
    }
    limits: ClassVar = {
        Feature.LINKED_CONTACT: "rigid contact at several points, or off a centre of mass, has no "
        "unique motion after the first impact",
    }
    coordinates = "reduced"
    contact_law = ContactLaw(
        normal="rigid: impacts and rests are events, located to rounding error",
        restitution="Newton's law, at every impact",
        friction="Coulomb's cone, also during impacts",
        mixing="none: the scene gives the pair's coefficients",
        adapter="Follows a ball through flight, impacts, sliding and rolling, by formulas if its "
        "inertia is isotropic; and isotropic balls that touch each other, two at a time, without "
        "ground.",
    )

    def settings(self, scene: Scene, profile: Profile) -> Settings:
        rtol = _MATCHED if profile == "matched" else _NATIVE
        return Settings(_METHOD, scene.clock.frame, {RTOL: rtol})

    def contact_scales(self, settings: Settings) -> ContactScales:
        del settings
        return ContactScales(0.0)

    def load(self, scene: Scene, settings: Settings) -> Run:
        return ReferenceRun(Mechanism.of(scene), float(self.option(settings, RTOL)))


class ReferenceRun(Run):
    """Run of one mechanism at one tolerance."""

    def __init__(self, mechanism: Mechanism, rtol: float) -> None:
        self._mechanism, self._rtol, self._tree = mechanism, rtol, tree_of(mechanism)
        if not mechanism.scene.contacts:
            _load_kernels(mechanism)
        speeds = self._tree.size - self._tree.place_count
        self.size = ModelSize(
            coordinates=speeds,
            constraints=speeds - degrees_of_freedom(mechanism),
            contact_pairs=count_pairs(mechanism),
        )

    def rollout(self, batch: Batch) -> Trajectory:
        return solve(self._mechanism.scene, batch, rtol=self._rtol, cache=False)

    def readback(self, batch: Batch) -> Readback:
        mechanism, tree = self._mechanism, self._tree
        order = np.argsort(tree.body)
        states = start_states(mechanism, batch[:1])
        start = dynamics_of(mechanism).unpack(states)
        axes = rotation.matrix(dynamics_of(mechanism).topology.principal[:-1])
        mass, moment = tree.mass[order], tree.moment[order]
        return Readback(
            mass=mass,
            inertia=np.einsum("kij,kj,klj->kil", axes, moment, axes),
            com=start.position[0],
            orientation=mechanism.body_orientation(start.native)[0],
            velocity=start.velocity[0],
            angular_velocity=start.angular_velocity[0],
            gravity=tree.gravity,
            step=None,
            joint_axis=joint_axes(mechanism, lambda link: self._axis(link, states[0])),
            damping=None,
            contact=self._contact(),
            collision=self._collisions(),
            sphere=start.position[0][mechanism.sphere_body] if mechanism.scene.contacts else None,
            anchor=joint_anchors(mechanism, lambda link: self._anchors(link, states[0])),
            spring=self._springs(states[0]),
        )

    def native(self, batch: Batch) -> str:
        scene = self._mechanism.scene
        start = {key: getattr(batch, key)[:1].tolist() for key in STATES}
        return _SCRIPT.format(
            scene=msgspec.json.encode(scene).decode(),
            start=start,
            force=(1, scene.clock.steps, len(scene.bodies), 3),
            torque=(1, scene.clock.steps, len(self._mechanism.hinges)),
            rtol=self._rtol,
        )

    def close(self) -> None:
        pass

    def _axis(self, link: Link, state: Array) -> Array:
        place = self._mechanism.links.index(link)
        return np.asarray(rotation.rotate(state[link.parent, 3:7], self._tree.axis[place]))

    def _anchors(self, link: Link, state: Array) -> tuple[Array, Array]:
        place = self._mechanism.links.index(link)
        return (
            _placed(state[link.parent], self._tree.in_parent[place]),
            _placed(state[link.body], self._tree.in_child[place]),
        )

    def _springs(self, state: Array) -> Array:
        tree = self._tree
        bodies = np.append(tree.body, len(tree.body))[tree.spring_ends]
        ends = _placed(state[bodies], tree.spring_points)
        length, stiffness, damping = tree.spring.T
        return np.stack([stiffness, damping, length, rotation.norm(ends[1] - ends[0])], axis=1)

    def _contact(self) -> Array | None:
        ground = self._mechanism.scene.ground
        radii = self._mechanism.sphere_radius
        law = (ground.friction, ground.restitution) if ground else (np.nan, np.nan)
        return np.array([(radius, *law) for radius in radii]) if len(radii) else None

    def _collisions(self) -> Array:
        collisions, pairs = self._mechanism.scene.collisions, self._mechanism.sphere_pairs
        law = (collisions.friction, collisions.restitution) if collisions else (np.nan, np.nan)
        return np.array([law] * len(pairs)).reshape(-1, 2)


def _load_kernels(mechanism: Mechanism) -> None:
    """Move the reference pose through a frame, so that rollouts spend no time loading kernels."""
    from mbds_xsim.reference.compiled import march_compiled  # imports a compiler

    torque = with_pushes(mechanism.drives, np.zeros((1, 1, len(mechanism.hinges))))
    still = np.zeros((1, 1, mechanism.body_count, 3)), torque
    dynamics = dynamics_of(mechanism)
    march_compiled(Problem(dynamics, dynamics.pack(pose_of(mechanism)), *still, rtol=LOOSEST))


def _placed(state: Array, point: Array) -> Array:
    """Transform points from principal frames to W."""
    return np.asarray(state[..., :3] + rotation.rotate(state[..., 3:7], point))


_SCRIPT = """\
import msgspec
import numpy as np

from mbds_xsim.reference import solve
from mbds_xsim.scene.scene import Scene
from mbds_xsim.scene.state import Batch

scene = msgspec.json.decode(r'''{scene}''', type=Scene)
start = {start!r}
batch = Batch(
    index=np.zeros(1, dtype=np.int64),
    force=np.zeros({force}),
    torque=np.zeros({torque}),
    **{{key: np.array(values) for key, values in start.items()}},
)
motion = solve(scene, batch, rtol={rtol!r}, cache=False)
for body, *state in zip(scene.bodies, *(getattr(motion, key)[0, -1] for key in start)):
    print(body.name, *(part.tolist() for part in state))
"""

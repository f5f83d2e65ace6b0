"""The scene as arrays, with its spanning tree and the joints that close loops.

At the reference pose every body gets a *native frame* N: at its centre of mass, parallel to W.
In it joints, spheres and attachment points are plain differences of world positions, and every
joint's zero rotation is the identity. An adapter that uses N as its body frame needs no other
frame; `Mechanism.body_orientation` turns rotations of N into published orientations.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mbds_xsim.base import rotation
from mbds_xsim.base.arrays import Array, Index
from mbds_xsim.base.errors import SceneError
from mbds_xsim.scene.collisions import sphere_pairs
from mbds_xsim.scene.coupling import PlacedCoupling
from mbds_xsim.scene.mass import mass_properties
from mbds_xsim.scene.scene import WORLD, DistanceLink, Joint, Scene, SpringDamper
from mbds_xsim.scene.servo import PlacedDrive, Servo, by_joint, law_of
from mbds_xsim.scene.spanning import spanning_tree

JointKind = Literal["fixed", "hinge", "slider", "ball"]

WORLD_INDEX = -1

_CENTRED = 1e-9  # [m]

CUT: tuple[JointKind, ...] = ("ball", "hinge", "slider", "fixed")
"""Joint kinds, those preferred for closing loops first. Those that constrain most stay in the tree,
so that loops are closed by the joints that engines close best."""


@dataclass(frozen=True, eq=False)
class PlacedJoint:
    """A joint between two bodies given by index (−1 is the world)."""

    name: str
    kind: JointKind
    parent: int
    child: int
    anchor: Array
    """Anchor in W at the reference pose [m], shape (3,)."""
    axis: Array
    """Unit axis in W at the reference pose, shape (3,); zero if the kind has none."""
    in_parent: Array
    """Anchor in the parent's native frame [m]; in W if the parent is the world."""
    in_child: Array
    """Anchor in the child's native frame [m]."""
    index: int
    """Position in `scene.joints`."""
    stiffness: float = 0.0
    """Stiffness of spring and servos [N·m/rad or N/m]; the damping likewise includes servos."""
    damping: float = 0.0
    rest: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    limits: tuple[float, float] | None = None
    restitution: float = 0.0
    coupled: bool = False
    """Whether it follows another joint or is followed."""
    driven: bool = False
    """Whether a drive acts on it."""

    def turned_round(self) -> PlacedJoint:
        """Return the same joint with parent and child exchanged."""
        return dataclasses.replace(
            self,
            parent=self.child,
            child=self.parent,
            axis=-self.axis,
            in_parent=self.in_child,
            in_child=self.in_parent,
        )

    @property
    def complies(self) -> bool:
        """Whether a spring or damper acts on the coordinate."""
        return self.stiffness > 0.0 or self.damping > 0.0

    @property
    def is_loaded(self) -> bool:
        """Whether it has a spring, damper, drive, rotor, friction or limits, or is coupled."""
        return self.complies or self.in_tree

    @property
    def in_tree(self) -> bool:
        """Whether it has a property that only a joint of the spanning tree can have."""
        return bool(self.armature or self.friction or self.limits or self.coupled or self.driven)

    def effort(self, coordinate: Array, rate: Array) -> Array:
        """Return the torque [N·m] or force [N] of spring and damper along the axis on the child.

        The parent gets the opposite.
        """
        spring = self.stiffness * (coordinate - self.rest)
        return np.asarray(-spring - self.damping * rate)

    def beyond(self, coordinate: Array) -> Array:
        """Return how far coordinates exceed the joint's limits [rad or m]; 0 within them."""
        assert self.limits is not None
        low, high = self.limits
        return np.maximum(np.maximum(low - coordinate, coordinate - high), 0.0)


@dataclass(frozen=True, eq=False)
class Link:
    """A body's place in the spanning tree: its parent body and the joint between them.

    The joint points from the tree parent to the body. If the scene's joint points the other
    way, its axis is negated here, which leaves its coordinate, rate and torque unchanged.
    """

    body: int
    parent: int
    joint: PlacedJoint | None
    """Joint from the parent to the body; None if the body is free."""


@dataclass(frozen=True, eq=False)
class PointPair:
    """Two attachment points of a distance link or spring, in native frames (W for the world)."""

    name: str
    bodies: tuple[int, int]
    in_body: tuple[Array, Array]
    length: float
    """Length of the link or rest length of the spring [m]."""
    stiffness: float = 0.0
    damping: float = 0.0

    def pull(self, line: Array, rate: Array) -> Array:
        """Return the force on the first end [N]; the second end gets the opposite.

        Args:
            line: Vector from the first end to the second in W [m], shape (3,).
            rate: Rate of that vector [m/s].
        """
        length = float(np.linalg.norm(line))
        along = line / length
        tension = self.stiffness * (length - self.length) + self.damping * float(along @ rate)
        return np.asarray(tension * along)

    def as_read(self, line: Array) -> tuple[float, float, float, float]:
        """Return stiffness, damping, rest length and present length, as in `Readback.spring`."""
        return self.stiffness, self.damping, self.length, float(np.linalg.norm(line))


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Arrays of a scene and its spanning tree; bodies are in scene order."""

    scene: Scene
    mass: Array
    """Masses [kg], shape (body,)."""
    com: Array
    """Centres of mass in W at the reference pose [m], shape (body, 3)."""
    inertia: Array
    """Inertia about the centre of mass in the native frame [kg·m²], shape (body, 3, 3)."""
    reference_orientation: Array
    """Rotation from body frame to W at the reference pose, shape (body, 4)."""
    joints: tuple[PlacedJoint, ...]
    links: tuple[Link, ...]
    """The spanning tree, parents before children; one link per body."""
    loops: tuple[PlacedJoint, ...]
    """The joints that close loops, in scene order."""
    distances: tuple[PointPair, ...]
    springs: tuple[PointPair, ...]
    particle_body: Index
    """Body of each particle, shape (particle,)."""
    particle_offset: Array
    """Particle centres in the native frame of their body [m], shape (particle, 3)."""
    particles_per_body: Index
    sphere_body: Index
    sphere_offset: Array
    """Centres of the contact spheres in native frames [m], shape (sphere, 3)."""
    sphere_radius: Array
    sphere_pairs: Index
    """Contact spheres that may touch each other, shape (pair, 2)."""
    hinges: tuple[PlacedJoint, ...]
    """The joints that torques can drive, in scene order; the order of `Batch.torque`."""

    @functools.cached_property
    def carried(self) -> dict[int, int]:
        """Body that each joint of the spanning tree carries, by the joint's index."""
        return {link.joint.index: link.body for link in self.links if link.joint}

    @functools.cached_property
    def compliant(self) -> tuple[PlacedJoint, ...]:
        """The joints with a spring or damper, in scene order."""
        return tuple(joint for joint in self.joints if joint.complies)

    @functools.cached_property
    def counted(self) -> tuple[PlacedJoint, ...]:
        """The joints whose coordinate, including whole turns, matters; in scene order."""
        return tuple(
            j for j in self.joints if j.complies or j.friction or j.limits or j.coupled or j.driven
        )

    @functools.cached_property
    def frictional(self) -> tuple[PlacedJoint, ...]:
        """The joints with dry friction, in scene order."""
        return tuple(joint for joint in self.joints if joint.friction)

    @functools.cached_property
    def limited(self) -> tuple[PlacedJoint, ...]:
        """The joints with limits, in scene order."""
        return tuple(joint for joint in self.joints if joint.limits)

    @property
    def braked(self) -> bool:
        """Whether joints have dry friction or limits, so that motions have events."""
        return bool(self.frictional or self.limited)

    @property
    def has_impacts(self) -> bool:
        """Whether a sphere can hit the ground or another body, or a joint its stop."""
        return bool(self.scene.contacts or self.limited)

    @functools.cached_property
    def couplings(self) -> tuple[PlacedCoupling, ...]:
        """Couplings in scene order."""
        joints = {joint.name: joint for joint in self.joints}
        return tuple(
            PlacedCoupling(c.name, joints[c.joint], joints[c.follows], c.ratio, c.offset)
            for c in self.scene.couplings
        )

    @functools.cached_property
    def drives(self) -> tuple[PlacedDrive, ...]:
        """Servos that no spring, damper and held input can replace, in scene order."""
        joints = {joint.name: joint for joint in self.joints}
        return tuple(
            PlacedDrive(joints[servo.joint], servo)
            for servo in self.scene.servos
            if servo.is_drive(self.scene.joints[joints[servo.joint].index])
        )

    @property
    def saturates(self) -> bool:
        """Whether a drive has a limit, so that motions have kinks."""
        return any(drive.servo.limit is not None for drive in self.drives)

    @functools.cached_property
    def rotors(self) -> tuple[PlacedJoint, ...]:
        """The joints with armature, in scene order."""
        return tuple(joint for joint in self.joints if joint.armature)

    @property
    def body_count(self) -> int:
        """Number of bodies."""
        return len(self.mass)

    @property
    def has_only_balls(self) -> bool:
        """Whether every body is free and has one contact sphere, around its centre of mass."""
        scene = self.scene
        return (
            not (scene.joints or scene.distance_links or scene.springs)
            and sorted(self.sphere_body) == list(range(self.body_count))
            and bool(np.abs(self.sphere_offset).max() <= _CENTRED)
        )

    @staticmethod
    def of(scene: Scene, cut: tuple[JointKind, ...] = CUT) -> Mechanism:
        """Build (once per scene) the arrays and the tree; raise SceneError if impossible.

        Args:
            scene: The scene.
            cut: All joint kinds, those preferred for closing loops first.
        """
        return _build(scene, cut)

    def native_rotation(self, orientation: Array) -> Array:
        """Convert published orientations (…, body, 4) to rotations of the native frames."""
        if (self.reference_orientation == rotation.IDENTITY).all():
            return orientation.copy()
        return rotation.multiply(orientation, rotation.conjugate(self.reference_orientation))

    def body_orientation(self, native: Array) -> Array:
        """Convert rotations of the native frames (…, body, 4) to published orientations."""
        if (self.reference_orientation == rotation.IDENTITY).all():
            return native.copy()
        return rotation.multiply(native, self.reference_orientation)

    def particle_positions(self, position: Array, orientation: Array) -> Array:
        """Return particle centres in W [m], (…, particle, 3), from body states (…, body, 3|4)."""
        turn = self.native_rotation(orientation)[..., self.particle_body, :]
        return position[..., self.particle_body, :] + rotation.rotate(turn, self.particle_offset)

    def sphere_heights(self, position: Array, native: Array) -> Array:
        """Return the heights of the contact spheres' centres [m], shape (…, sphere).

        Args:
            position: Centres of mass, shape (…, body, 3).
            native: Rotations of the native frames, shape (…, body, 4).
        """
        arm = rotation.rotate(native[..., self.sphere_body, :], self.sphere_offset)
        return np.asarray(position[..., self.sphere_body, 2] + arm[..., 2])


@functools.lru_cache(maxsize=64)
def _build(scene: Scene, cut: tuple[JointKind, ...]) -> Mechanism:
    index = {body.name: k for k, body in enumerate(scene.bodies)} | {WORLD: WORLD_INDEX}
    masses, coms, inertias = zip(*(mass_properties(body) for body in scene.bodies), strict=True)
    com = np.array(coms)
    origin = np.concatenate([com, np.zeros((1, 3))])  # of native frames, the world's last
    coupled = {name for each in scene.couplings for name in (each.joint, each.follows)}
    servos = by_joint(scene.servos)
    joints = tuple(
        _place(k, joint, servos[joint.name], joint.name in coupled, index, origin)
        for k, joint in enumerate(scene.joints)
    )
    tree, loops = spanning_tree(len(scene.bodies), joints, cut)
    for joint in loops:
        if joint.in_tree:
            keys = [key for key in ("armature", "friction", "limits") if getattr(joint, key)]
            label = (keys or ["a coupling" if joint.coupled else "a servo with a limit"])[0]
            where = f"joints[{joint.name!r}]: got {label} on a joint that closes a loop"
            raise SceneError(f"{where}, allowed only on others; let another joint close it")
    counts = np.array([len(body.particles) for body in scene.bodies])
    particle_body = np.repeat(np.arange(len(counts)), counts)
    place = np.array([body.position for body in scene.bodies])[particle_body]
    reference_orientation = np.array([body.orientation for body in scene.bodies])
    arm = np.array([p.position for body in scene.bodies for p in body.particles]).reshape(-1, 3)
    particle = place + rotation.rotate(reference_orientation[particle_body], arm)
    sphere_body = np.array([index[sphere.body] for sphere in scene.contacts], dtype=np.int64)
    sphere = np.array([sphere.center for sphere in scene.contacts]).reshape(-1, 3)
    return Mechanism(
        scene=scene,
        mass=np.array(masses),
        com=com,
        inertia=np.array(inertias),
        reference_orientation=reference_orientation,
        joints=joints,
        links=tuple(Link(*link) for link in tree),
        loops=loops,
        distances=tuple(_pair(link, link.length, index, origin) for link in scene.distance_links),
        springs=tuple(
            _pair(spring, spring.rest_length, index, origin, spring.stiffness, spring.damping)
            for spring in scene.springs
        ),
        particle_body=particle_body,
        particle_offset=particle - com[particle_body],
        particles_per_body=counts,
        sphere_body=sphere_body,
        sphere_offset=sphere - com[sphere_body],
        sphere_radius=np.array([sphere.radius for sphere in scene.contacts]),
        sphere_pairs=sphere_pairs(scene),
        hinges=tuple(joint for joint in joints if joint.kind == "hinge"),
    )


def _place(
    k: int, joint: Joint, servos: list[Servo], coupled: bool, index: dict[str, int], origin: Array
) -> PlacedJoint:
    stiffness, damping, rest = law_of(joint, servos)
    # hypot neither underflows nor overflows, whatever the axis's length.
    axis = np.zeros(3) if joint.axis is None else np.array(joint.axis) / math.hypot(*joint.axis)
    parent, child, anchor = index[joint.parent], index[joint.child], np.array(joint.anchor)
    return PlacedJoint(
        name=joint.name,
        kind=joint.kind,
        parent=parent,
        child=child,
        anchor=anchor,
        axis=axis,
        in_parent=anchor - origin[parent],
        in_child=anchor - origin[child],
        index=k,
        stiffness=stiffness,
        damping=damping,
        rest=rest,
        armature=joint.armature,
        friction=joint.friction,
        limits=joint.limits,
        restitution=joint.restitution,
        coupled=coupled,
        driven=any(servo.is_drive(joint) for servo in servos),
    )


def _pair(
    item: DistanceLink | SpringDamper,
    length: float | None,
    index: dict[str, int],
    origin: Array,
    *law: float,
) -> PointPair:
    (a, b), (here, there) = (index[name] for name in item.bodies), map(np.array, item.points)
    if length is None:
        length = float(np.linalg.norm(here - there))
    return PointPair(item.name, (a, b), (here - origin[a], there - origin[b]), length, *law)

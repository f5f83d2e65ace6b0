"""The neutral description of a scene: bodies, joints, loads and initial state.

SI units, radians, z up, quaternions wxyz. Everything is placed in the world frame W at the
*reference pose*; a body may carry a frame of its own (`position`, `orientation`) in which its
particles, centre of mass and inertia are given. By default that frame is W itself, so that a
mechanism can be written down in one coordinate system.

Each type checks its own values; `Scene` checks that the parts fit together. All types are
immutable, comparable and hashable.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Annotated, Literal

from mbds_xsim.base import bounds
from mbds_xsim.base.bounds import Neutral
from mbds_xsim.base.errors import SceneError, UnknownName
from mbds_xsim.scene.budget import Budget, Positive
from mbds_xsim.scene.collisions import Collisions, check_collisions
from mbds_xsim.scene.coupling import Coupling, Finite, check_couplings
from mbds_xsim.scene.sampling_terms import Draw, Lift, Pose, Roll, Throw
from mbds_xsim.scene.servo import Servo

Vector = tuple[float, float, float]
FiniteVector = Annotated[Vector, bounds.finite]
Place = Annotated[Vector, bounds.place]
Direction = Annotated[Vector, bounds.direction]
Quaternion = Annotated[tuple[float, float, float, float], bounds.unit]
Name = Annotated[str, bounds.name]
NotNegative = Annotated[float, bounds.at_least_zero]
Size = Annotated[float, bounds.size]
Count = Annotated[int, bounds.at_least_one]

WORLD = "world"
GRAVITY: Vector = (0.0, 0.0, -9.81)
MOST_PARTS = 20_000
"""Largest number of bodies, of joints etc.; reading a scene of this size takes 8 s."""
_LISTS = (
    "bodies", "joints", "distance_links", "springs", "forces", "torques", "servos", "couplings",
    "contacts", "sampling",
)  # fmt: skip
MOST_STATES = 10_000_000
"""Largest product of bodies and steps; a trajectory of so many states takes 1 GB."""
PARTICLE_MASS = 1.0
PARTICLE_INERTIA = 6.17e-4
PARTICLE_RADIUS = math.sqrt(2.5 * PARTICLE_INERTIA / PARTICLE_MASS)
"""Radius of the solid sphere that has this mass and inertia [m]."""


class Particle(Neutral):
    """A solid sphere rigidly fixed in its body."""

    position: Place
    """Centre in the body frame [m]."""
    mass: Positive = PARTICLE_MASS
    """Mass [kg]."""
    inertia: NotNegative = PARTICLE_INERTIA
    """Moment of inertia about any axis through the centre [kg·m²]."""


class Inertia(Neutral):
    """Mass, centre of mass and inertia given directly, for a body without particles."""

    mass: Positive
    """Mass [kg]."""
    moments: FiniteVector
    """Ixx, Iyy, Izz about the centre of mass, along the body frame's axes [kg·m²]."""
    products: FiniteVector = (0.0, 0.0, 0.0)
    """Tensor elements Ixy, Ixz, Iyz (so Ixy = −∫xy dm) [kg·m²]."""
    com: Place = (0.0, 0.0, 0.0)
    """Centre of mass in the body frame [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        bounds.physical_inertia(self.moments, self.products)


class Body(Neutral):
    """A rigid body: a cluster of particles, or mass properties given directly (exactly one)."""

    name: Name
    particles: tuple[Particle, ...] = ()
    inertia: Inertia | None = None
    position: Place = (0.0, 0.0, 0.0)
    """Origin of the body frame in W at the reference pose [m]."""
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Rotation from the body frame to W at the reference pose, a unit quaternion wxyz."""
    velocity: FiniteVector | None = None
    """Initial velocity of the centre of mass in W [m/s]; if omitted, it follows from the joints."""
    angular_velocity: FiniteVector | None = None
    """Initial angular velocity in W [rad/s]; if omitted, it follows from the joints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name or self.name == WORLD:
            raise SceneError(f"name: got {self.name!r}, allowed is any text but '' and {WORLD!r}")
        if bool(self.particles) == (self.inertia is not None):
            msg = f"body {self.name!r} needs either particles or inertia, got " + (
                "both" if self.particles else "neither"
            )
            raise SceneError(msg)


class Joint(Neutral):
    """A holonomic joint between two bodies, placed in W at the reference pose.

    Its coordinate (hinge angle or slider displacement) is zero at that pose and grows as the child
    turns about, or moves along, the axis relative to the parent.
    """

    name: Name
    kind: Literal["fixed", "hinge", "slider", "ball"]
    parent: str
    child: str
    anchor: Place
    """A point of the joint in W at the reference pose [m]."""
    axis: Direction | None = None
    """Axis of a hinge or slider in W at the reference pose; need not be a unit vector."""
    start: Finite | None = None
    """Initial coordinate of a hinge [rad] or slider [m]; if omitted, it follows from the others."""
    rate: Finite | None = None
    """Initial rate of a hinge [rad/s] or slider [m/s]; if omitted, it follows from the others."""
    stiffness: NotNegative = 0.0
    """Stiffness of a spring on the coordinate of a hinge [N·m/rad] or slider [N/m]."""
    damping: NotNegative = 0.0
    """Damping coefficient on the coordinate [N·m·s/rad] or [N·s/m]."""
    rest: Finite = 0.0
    """Coordinate at which the spring is relaxed [rad] or [m]."""
    armature: NotNegative = 0.0
    """Rotor inertia times the gear ratio squared [kg·m²] or [kg]."""
    friction: NotNegative = 0.0
    """Dry friction: its size in motion and its largest size at rest [N·m] or [N]."""
    limits: Annotated[tuple[float, float], bounds.span] | None = None
    """Coordinates of the lower and upper stop [rad] or [m]."""
    restitution: Annotated[float, bounds.share] = 0.0
    """Newton's coefficient of restitution e at a stop, in [0, 1]."""

    added = ("stiffness", "damping", "rest", "armature", "friction", "limits", "restitution")

    def __post_init__(self) -> None:
        super().__post_init__()
        has_axis = self.kind in ("hinge", "slider")
        if has_axis and self.axis is None:
            raise SceneError(f"a {self.kind} joint needs an axis, got none")
        keys = [key for key in ("axis", "start", "rate") if getattr(self, key) is not None]
        keys += [key for key in self.added if getattr(self, key)]
        if not has_axis and keys:
            msg = f"{keys[0]}: got it on a {self.kind} joint, allowed only on a hinge or slider"
            raise SceneError(msg)
        if self.kind == "hinge" and abs(self.start or 0.0) > 2 * math.pi:
            msg = f"start: got {self.start}, allowed is −2π to 2π; hinge angles are in radians"
            raise SceneError(msg)
        if self.restitution and not self.limits:
            msg = f"restitution: got {self.restitution} without limits, allowed only with them"
            raise SceneError(msg)
        if self.parent == self.child:
            raise SceneError(f"joint {self.name!r} joins {self.parent!r} to itself")


class _Between(Neutral):
    name: Name
    bodies: tuple[str, str]
    """Two bodies, or a body and "world"."""
    points: tuple[Place, Place]
    """The attachment points in W at the reference pose [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bodies[0] == self.bodies[1]:
            raise SceneError(f"{self.name!r} joins {self.bodies[0]!r} to itself")
        if not math.dist(*self.points) > 0:
            msg = f"points: got {list(self.points[0])} twice, the two ends must be apart"
            raise SceneError(msg)


class DistanceLink(_Between):
    """A massless rigid link: keeps two points at a constant distance."""

    length: Size | None = None
    """Length [m]; by default the distance at the reference pose."""


class SpringDamper(_Between):
    """A massless linear spring and damper along the line between two points."""

    stiffness: NotNegative = 0.0
    """Stiffness [N/m]."""
    damping: NotNegative = 0.0
    """Damping [N·s/m]."""
    rest_length: Annotated[float, bounds.rest_length] | None = None
    """Rest length [m]; by default the distance at the reference pose."""


class Force(Neutral):
    """A force in W on a body's centre of mass, the same in every trajectory."""

    body: str
    series: Annotated[tuple[Vector, ...], bounds.rows]
    """One row per stretch of `hold` frames [N]; a single row is a constant force."""
    hold: Count = 1
    """Number of frames that each row lasts; the last row continues to the end."""


class Torque(Neutral):
    """A torque about a hinge's axis on the child, with the opposite torque on the parent."""

    joint: str
    series: Annotated[tuple[float, ...], bounds.rows]
    """One value per stretch of `hold` frames [N·m]; a single value is a constant torque."""
    hold: Count = 1
    """Number of frames that each value lasts; the last value continues to the end."""


class ContactSphere(Neutral):
    """A sphere fixed in a body that can touch the ground plane and spheres of other bodies."""

    body: str
    center: Place
    """Centre in W at the reference pose [m]."""
    radius: Size
    """Radius [m]."""


class Ground(Neutral):
    """The plane z = 0, with the coefficients of contact between it and the spheres."""

    friction: NotNegative
    """Coulomb's coefficient μ, isotropic."""
    restitution: Annotated[float, bounds.share]
    """Newton's coefficient e of the normal velocity, in [0, 1]."""


class Clock(Neutral):
    """Recording times: frame k at k · `frame`, k = 0 … `steps`."""

    frame: Annotated[float, bounds.interval] = 0.02
    """Interval between recorded frames [s]; inputs are constant over it."""
    steps: Count = 200
    """Number of intervals."""

    @property
    def duration(self) -> float:
        """Length of a trajectory [s]."""
        return self.frame * self.steps


class Scene(Neutral):
    """A complete scene; `mbds_xsim.scene.mechanism.Mechanism.of` builds its arrays and tree."""

    name: Name
    bodies: tuple[Body, ...]
    length: Size
    """Characteristic size of the scene, the unit of its error budgets [m]."""
    description: str = ""
    source: str = ""
    """Source of the numbers."""
    dimension: Literal[1, 2, 3] = 3
    """Dimension of the motion: 1 along x, 2 in x and z, 3 in space."""
    gravity: FiniteVector = GRAVITY
    """Gravity in W [m/s²]."""
    joints: tuple[Joint, ...] = ()
    distance_links: tuple[DistanceLink, ...] = ()
    springs: tuple[SpringDamper, ...] = ()
    forces: tuple[Force, ...] = ()
    torques: tuple[Torque, ...] = ()
    servos: tuple[Servo, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    contacts: tuple[ContactSphere, ...] = ()
    ground: Ground | None = None
    collisions: Collisions | None = None
    clock: Clock = Clock()
    sampling: tuple[Draw, ...] = ()
    """Rules for drawing starts and inputs; without any, all trajectories start alike."""
    noise: NotNegative = 0.0
    """Standard deviation of the random force per component and particle [N]; see docs."""
    anchors: tuple[Place, ...] = ()
    """Fixed points of the drawn skeleton and the learned graph; numbered after the particles."""
    edges: tuple[tuple[int, int], ...] = ()
    """Pairs of particles (numbered body by body) or anchors that skeleton and graph connect."""
    budget: Budget = Budget()

    added = ("servos", "couplings", "collisions")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name:
            raise SceneError("name: got '', allowed is any text")
        if not self.bodies:
            raise SceneError("bodies: got none, a scene needs at least one")
        for key in _LISTS:
            bounds.count(key, len(getattr(self, key)), MOST_PARTS, "larger scenes are not tested")
        frames = self.clock.steps * len(self.bodies)
        bounds.count("clock.steps · bodies", frames, MOST_STATES, "a trajectory of more takes 1 GB")
        self._check_names()
        self._check_references()
        self._check_edges()

    def _check_names(self) -> None:
        for table in ("bodies", "joints", "distance_links", "springs"):
            names = Counter(item.name for item in getattr(self, table))
            duplicates = [name for name, count in names.items() if count > 1]
            if duplicates:
                raise SceneError(f"{table}: got {duplicates[0]!r} twice, each name is allowed once")

    def _check_references(self) -> None:
        bodies = {body.name for body in self.bodies}
        ends = bodies | {WORLD}
        hinges = {joint.name for joint in self.joints if joint.kind == "hinge"}
        coordinates = hinges | {joint.name for joint in self.joints if joint.kind == "slider"}
        self._check_keys("joints", ("parent", "child"), ends, "body")
        for table in ("distance_links", "springs"):
            for k, item in enumerate(getattr(self, table)):
                for end in (0, 1):
                    _known(f"{table}[{k}].bodies[{end}]", item.bodies[end], ends)
        self._check_keys("forces", ("body",), bodies, "body")
        self._check_keys("torques", ("joint",), hinges, "hinge")
        self._check_keys("servos", ("joint",), coordinates, "hinge or slider")
        self._check_keys("couplings", ("joint", "follows"), coordinates, "hinge or slider")
        check_couplings(self.couplings)
        self._check_keys("contacts", ("body",), bodies, "body")
        self._check_contacts()
        for k, draw in enumerate(self.sampling):
            for body in getattr(draw, "bodies", ()):
                _known(f"sampling[{k}].bodies", body, bodies)
            posed = isinstance(draw, Pose)
            for joint_name in getattr(draw, "joints", ()):
                allowed, kind = (coordinates, "hinge or slider") if posed else (hinges, "hinge")
                _known(f"sampling[{k}].joints", joint_name, allowed, kind=kind)
            if isinstance(draw, Throw | Roll | Lift):
                _known(f"sampling[{k}].body", draw.body, bodies)

    def _check_keys(self, table: str, keys: tuple[str, ...], allowed: set[str], kind: str) -> None:
        for k, item in enumerate(getattr(self, table)):
            for key in keys:
                _known(f"{table}[{k}].{key}", getattr(item, key), allowed, kind=kind)

    def _check_contacts(self) -> None:
        if bool(self.contacts) != bool(self.ground or self.collisions):
            msg = f"ground: got {self.ground}, with {len(self.contacts)} contact spheres; " + (
                "they need a [ground] or [collisions]"
                if self.contacts
                else "a ground, or collisions, need contact spheres"
            )
            raise SceneError(msg)
        if self.collisions is not None:
            check_collisions(self.collisions, [sphere.body for sphere in self.contacts])

    def _check_edges(self) -> None:
        count = self.particle_count + len(self.anchors)
        for k, edge in enumerate(self.edges):
            if not all(0 <= node < count for node in edge) or edge[0] == edge[1]:
                raise SceneError(
                    f"edges[{k}]: got {list(edge)}, allowed are two different numbers from 0 to "
                    f"{count - 1} ({self.particle_count} particles, {len(self.anchors)} anchors)"
                )

    @property
    def particle_count(self) -> int:
        """Number of particles over all bodies."""
        return sum(len(body.particles) for body in self.bodies)


def _known(where: str, got: str, allowed: set[str], *, kind: str = "body") -> None:
    if got not in allowed:
        listed = sorted(allowed)[:12] + ["…"] * (len(allowed) > 12)
        raise SceneError(f"{where}: {UnknownName.of(kind, got, listed)}")

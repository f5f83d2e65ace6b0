"""Claims of an adapter: features, methods, options, and its engine's contact law."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from mbds_xsim.base.errors import InputError, UnknownName
from mbds_xsim.scene.collisions import has_known_impacts
from mbds_xsim.scene.mechanism import CUT, JointKind, Mechanism
from mbds_xsim.scene.scene import Scene

TRUTH = "reference"
"""Family of the reference itself, which is compared only with itself."""
FAMILIES = (
    "semi-implicit Euler", "implicit Euler", "RK4", "Runge-Kutta 3", "Runge-Kutta 3(2)",
    "Runge-Kutta 5", "Runge-Kutta 5(4)", "Runge-Kutta 6(7)", "generalised-alpha", "trapezoidal",
    "toolkit RK4", TRUTH,
)  # fmt: skip
"""Known families of methods; `own_family` names another one."""
RTOL = "rtol"
"""Option of adaptive methods: the tolerance that decides their steps."""
_OWN = " (own)"
_KINKED = 2  # highest order if forces have kinks


def own_family(name: str) -> str:
    """Name a family to which no other engine's methods are known to belong."""
    return name + _OWN


class Feature(Enum):
    """Features that a scene can require of an engine."""

    BALL = "ball joint"
    HINGE = "hinge joint"
    SLIDER = "slider joint"
    FIXED = "fixed joint"
    FREE_BODY = "free body"
    LOOP_BALL = "loop closed by a ball joint"
    LOOP_HINGE = "loop closed by a hinge"
    LOOP_SLIDER = "loop closed by a slider"
    LOOP_FIXED = "loop closed by a fixed joint"
    DISTANCE_LINK = "distance link"
    SPRING_DAMPER = "spring–damper"
    JOINT_SPRING = "spring in a joint"
    JOINT_DAMPER = "damper in a joint"
    ARMATURE = "armature of a joint"
    HELD_ARMATURE = "armature beside loops, links, couplings, dry friction or contact"
    COUPLING = "joint that follows another"
    JOINT_FRICTION = "dry friction in a joint"
    JOINT_LIMITS = "limits of a joint"
    JOINT_REBOUND = "rebound from the limits of a joint"
    DRIVE = "servo with a limit, or along a slider between two bodies"
    CLOSING_LOAD = "spring or damper in a joint that closes a loop"
    FORCE = "force at the centre of mass"
    HINGE_TORQUE = "hinge torque"
    FULL_INERTIA = "inertia not along the body frame"
    CONTACT = "sphere on the ground"
    COLLISION = "sphere on another body's sphere"
    LINKED_CONTACT = "spheres of joined bodies, or off centre"
    """Also balls that touch the ground and each other: all contact without a unique solution."""


LOOPS = frozenset(feature for feature in Feature if feature.name.startswith("LOOP_"))
"""Every way of closing a loop."""
CONTACTS = (Feature.CONTACT, Feature.COLLISION, Feature.LINKED_CONTACT)
"""Every kind of contact."""


def features_of(scene: Scene, cut: tuple[JointKind, ...] = CUT) -> frozenset[Feature]:
    """List the features a scene needs; forces count if sampling, noise or tables can cause one.

    Args:
        scene: The scene.
        cut: All joint kinds, those preferred for closing loops first.
    """
    mechanism = Mechanism.of(scene, cut)
    tree = [link.joint for link in mechanism.links]
    kinds = {Feature[joint.kind.upper()] for joint in tree if joint is not None}
    kinds |= {Feature[f"LOOP_{joint.kind.upper()}"] for joint in mechanism.loops}
    diagonal = np.einsum("kii->ki", mechanism.inertia)[:, :, None] * np.eye(3)
    draws = {draw.__struct_config__.tag for draw in scene.sampling}
    hinges = {joint.name for joint in mechanism.hinges}
    drives = [drive.servo for drive in mechanism.drives]
    servos = [servo for servo in scene.servos if servo not in drives]
    driven = {load.joint for load in scene.torques} | {servo.joint for servo in servos}
    holds = bool(mechanism.frictional or scene.contacts)
    needs = {
        Feature.FREE_BODY: None in tree,
        Feature.DISTANCE_LINK: bool(scene.distance_links),
        Feature.SPRING_DAMPER: bool(scene.springs),
        Feature.JOINT_SPRING: any(joint.stiffness for joint in mechanism.joints),
        Feature.JOINT_DAMPER: any(joint.damping for joint in mechanism.joints),
        Feature.ARMATURE: bool(mechanism.rotors),
        Feature.HELD_ARMATURE: bool(mechanism.rotors) and (_constrained(scene) or holds),
        Feature.COUPLING: bool(mechanism.couplings),
        Feature.JOINT_FRICTION: bool(mechanism.frictional),
        Feature.JOINT_LIMITS: bool(mechanism.limited),
        Feature.JOINT_REBOUND: any(joint.restitution for joint in mechanism.limited),
        Feature.DRIVE: bool(mechanism.drives),
        Feature.CLOSING_LOAD: any(joint.complies for joint in mechanism.loops),
        Feature.FORCE: bool(scene.forces)
        or scene.noise > 0
        or "wind" in draws
        or any(servo.needs_input and servo.joint not in hinges for servo in servos),
        Feature.HINGE_TORQUE: bool(driven & hinges) or "hinge_torque" in draws,
        Feature.FULL_INERTIA: not np.allclose(mechanism.inertia, diagonal, rtol=0, atol=1e-14),
        Feature.CONTACT: scene.ground is not None,
        Feature.COLLISION: scene.collisions is not None,
        Feature.LINKED_CONTACT: bool(scene.contacts) and not has_known_impacts(mechanism),
    }
    return frozenset(kinds | {feature for feature, needed in needs.items() if needed})


@dataclass(frozen=True)
class Method:
    """A stepping method, with the claims that the contract suite measures."""

    name: str
    family: str
    """Family of methods: one of `FAMILIES` or an `own_family`. A family has one vote, as agreement
    within it is no evidence. Other names are refused, as a misspelling would add a vote."""
    order: int
    """Order of convergence on smooth scenes that the method can run; for an adaptive method,
    the order of its steps, which no test can see."""
    refuses: Mapping[Feature, str] = field(default_factory=dict)
    """Features that this method, unlike the engine, cannot do, with the reason."""
    loop_order: int | None = None
    """Order when constraints are solved in addition to the coordinates; None if the same."""
    loop_velocity_order: int | None = None
    """Order of the velocities in that case; None if the same as that of the positions."""
    velocity_lag: float = 0.0
    """Lag of recorded velocities, which belong to (frame time + lag · step): −½ for leapfrog and
    semi-implicit Euler. In contact its size may be smaller, if an adapter divides steps."""
    own: bool = True
    """Whether the engine itself steps. A search for matched settings never takes a method that the
    toolkit steps, since it says nothing about the engine's stepping."""
    adaptive: bool = False
    """Whether it controls its error: it chooses its steps by the option `rtol`, which is then
    required, and is run at a step of one frame."""

    single: bool = False
    """Whether it holds and steps states in single precision: checks then allow for rounding to 24
    significant bits, while the scene's budgets stay the same."""

    def __post_init__(self) -> None:
        if self.family not in FAMILIES and not self.family.endswith(_OWN):
            raise UnknownName.of(
                f"family of {self.name}", self.family, [*FAMILIES, "own_family(…)"]
            )

    @property
    def is_truth(self) -> bool:
        """Whether it is the reference, whose distance to itself is no figure of accuracy."""
        return self.family == TRUTH

    def order_for(self, scene: Scene) -> int:
        """Return the order for a scene: 1 if friction or limits stop joints within steps.

        It is at most 2 if servos saturate, as forces then have kinks. Adaptive methods keep theirs.
        """
        mechanism = Mechanism.of(scene)
        if mechanism.braked and not self.adaptive:
            return 1
        loop_order = self.loop_order if _constrained(scene) else None
        order = self.order if loop_order is None else loop_order
        return min(order, _KINKED) if mechanism.saturates and not self.adaptive else order

    def velocity_order_for(self, scene: Scene) -> int:
        """Return the order of a scene's velocities, which constraints may lower."""
        order = self.order_for(scene)
        lower = self.loop_velocity_order
        return min(order, lower) if lower is not None and _constrained(scene) else order


def named(*methods: Method) -> dict[str, Method]:
    """Return methods by their names, as in `Adapter.methods`."""
    return {method.name: method for method in methods}


def _constrained(scene: Scene) -> bool:
    mechanism = Mechanism.of(scene)
    return bool(mechanism.loops or mechanism.distances or mechanism.couplings)


@dataclass(frozen=True)
class Option:
    """An option of an adapter: its default, its meaning and the values allowed.

    Values are of the default's type: true or false, a whole number, a finite number or a name.
    """

    default: float | int | bool | str
    meaning: str
    least: float | None = None
    """Smallest number allowed; None sets no bound, here and below."""
    most: float | None = None
    above: float | None = None
    """Bound that numbers must exceed."""
    names: tuple[str, ...] = ()
    """All names allowed."""
    or_zero: bool = False
    """Whether 0 is allowed, whatever the bounds."""

    def check(self, label: str, value: object) -> None:
        """Raise InputError, naming the option as `label`, unless the value is allowed."""
        if self.names:
            if value not in self.names:
                raise UnknownName.of(label, str(value), list(self.names))
        elif not (self._kind_fits(value) and self._is_within(value)):
            raise InputError(f"{label}: got {value!r}, allowed is {self._allowed()}")

    def _kind_fits(self, value: object) -> bool:
        if isinstance(self.default, bool | str):
            return isinstance(value, type(self.default))
        number = int if isinstance(self.default, int) else int | float
        return isinstance(value, number) and not isinstance(value, bool) and math.isfinite(value)

    def _is_within(self, value: Any) -> bool:
        return (self.or_zero and value == 0) or (
            (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
        )

    def _allowed(self) -> str:
        if isinstance(self.default, bool | str):
            return "true or false" if isinstance(self.default, bool) else "a text"
        kind = "a whole number" if isinstance(self.default, int) else "a finite number"
        bounds = {"more than": self.above, "at least": self.least, "at most": self.most}
        limits = [f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None]
        zero = "0, or " if self.or_zero else ""
        return ", ".join([kind, *([zero + " and ".join(limits)] if limits else [])])


@dataclass(frozen=True)
class Sweep:
    """Values of an option that are worth trying, one at a time, in place of the one in use."""

    values: tuple[float | int | bool | str, ...]
    methods: tuple[str, ...] = ()
    """Methods that the option affects; empty for all."""
    needs: frozenset[Feature] = frozenset()
    """Features of which a scene must need one for the option to act; empty if it always acts."""


def check_claims(
    methods: Mapping[str, Method],
    options: Mapping[str, Option],
    sweeps: Mapping[str, Sweep],
    cut: tuple[JointKind, ...],
) -> None:
    """Raise ValueError if claims of an adapter contradict each other."""
    if not methods:
        raise ValueError("it has no methods")
    for name, method in methods.items():
        if name != method.name:
            raise ValueError(f"its method {method.name} stands under the name {name}")
        if method.adaptive and RTOL not in options:
            raise ValueError(f"its method {name} is adaptive, and it has no option {RTOL}")
    if unknown := set(sweeps) - set(options):
        raise ValueError(f"it sweeps {sorted(unknown)[0]}, which is not one of its options")
    if sorted(cut) != sorted(CUT):
        raise ValueError(f"its cut is {cut}, allowed is each of {', '.join(CUT)} once")


@dataclass(frozen=True)
class ContactScales:
    """Contact resolution of an engine, from which the contract suite derives its tolerances."""

    time: float
    """Duration of an impact [s]: one step if contact is rigid, or the time that a spring needs to
    push a sphere out if it is compliant."""
    slip: float = 0.0
    """Slip up to which friction is less than Coulomb's [m/s]."""


@dataclass(frozen=True)
class ContactLaw:
    """An engine's contact law in words; `mbds-xsim contact` measures it."""

    normal: str
    """Law that keeps a sphere from penetrating."""
    restitution: str
    """Law that decides the rebound."""
    friction: str
    """Set of possible friction forces, such as a cone or a box."""
    mixing: str
    """Rule that combines the coefficients of two bodies."""
    adapter: str
    """Measures that the adapter takes, in sentences."""
